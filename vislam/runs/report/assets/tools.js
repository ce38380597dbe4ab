// The buttons over the view: from where one looks, how far it is between two points, and a picture to keep.
import { element } from "./data.js";

const BEHIND = 0.45; // of the scene's radius, from which a body is followed

// How far it is between two points that are clicked one after the other.
class Measure {
  constructor(view, parent) {
    this.view = view;
    this.said = element("output", "measured");
    this.said.hidden = true;
    parent.append(this.said);
  }

  set(on) {
    this.ends = [];
    this.said.hidden = !on;
    this.said.textContent = "Click two points.";
    this.view.onPoint = on ? (point) => this.take(point) : null;
    this.view.span([]);
  }

  take(point) {
    this.ends = this.ends.length === 2 ? [point] : [...this.ends, point];
    this.view.span(this.ends);
    const [a, b] = this.ends;
    if (!b) {
      this.said.textContent = `From ${a.toArray().map((value) => value.toFixed(2)).join(", ")} m to …`;
      return;
    }
    const [across, up] = [Math.hypot(b.x - a.x, b.y - a.y), b.z - a.z];
    this.said.textContent = `${a.distanceTo(b).toFixed(3)} m: ${across.toFixed(3)} across, ${up.toFixed(3)} up`;
  }
}

// Keep the picture as it is on the screen, with all points.
function save(view) {
  view.rest();
  view.draw();
  const link = element("a");
  link.href = view.canvas.toDataURL("image/png");
  link.download = "map.png";
  link.click();
}

// Buttons of a view; `touched` hears whether one looks from a place of one's own.
export function viewTools(view, parent, touched = () => {}) {
  const measure = new Measure(view, parent.parentElement);
  const switched = (act) => (button) => {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    act(on);
  };
  const tools = {
    home: ["Whole", () => (touched(false), view.overview())],
    above: ["From above", () => (touched(true), view.fromAbove())],
    follow: ["Follow", switched((on) => (touched(true), view.follow(on ? BEHIND : 0)))],
    measure: ["Measure", switched((on) => measure.set(on))],
    picture: ["Picture", () => save(view)],
  };
  for (const [name, [label, act]] of Object.entries(tools)) {
    const button = element("button", "", label);
    button.type = "button";
    button.id = `view-${name}`;
    button.addEventListener("click", () => act(button));
    parent.append(button);
  }
}
