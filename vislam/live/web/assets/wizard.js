// Calibration step by step: what to do, what was seen so far, and what came of it.
import { element } from "./data.js";

const NAMES = { camera: "Camera", imu: "IMU", mag: "Magnetometer", noise: "Noise of the IMU", run: "The run" };
const HOW = {
  camera: "Show the printed board to the camera from all sides, and hold it still each time.",
  imu: "Hold the sensor still for two seconds in twelve poses, up to upside down.",
  mag: "Turn the sensor in figures of eight about all axes, or the cart once around on the floor.",
  noise: "Let the sensor stand still, five minutes at least; an hour is good.",
};
const BOARD = [["pattern", "Pattern", "charuco"], ["size", "Squares", "9x6"], ["square_mm", "Side [mm]", "30"]];
const DISC = 62; // radius of half a sphere, in units of its picture

function svg(tag, attributes) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}

// Both halves of the sphere, from above and from below.
function sphere(ways) {
  const picture = svg("svg", { viewBox: "0 0 280 150", role: "img", "aria-label": "Directions that were seen" });
  [70, 210].forEach((x, half) => {
    picture.append(svg("circle", { cx: x, cy: 68, r: DISC, class: "half" }));
    const text = svg("text", { x, y: 146, "text-anchor": "middle" });
    text.textContent = half ? "−z" : "+z";
    picture.append(text);
  });
  for (const [x, y, z, seen] of ways) {
    const r = Math.min(1, Math.sqrt(Math.max(0, 1 - Math.abs(z))));
    const length = Math.hypot(x, y) || 1;
    const cx = (z >= 0 ? 70 : 210) + (DISC * r * x) / length;
    picture.append(svg("circle", { cx, cy: 68 - (DISC * r * y) / length, r: 4.5, class: seen ? "seen" : "lacks" }));
  }
  return picture;
}

function grid(cells) {
  const parent = element("div", "cells");
  parent.setAttribute("aria-label", "Parts of the image that have seen the board");
  parent.style.gridTemplateColumns = `repeat(${cells[0].length}, 1fr)`;
  for (const value of cells.flat()) {
    const cell = element("i", value > 0 ? "seen" : "");
    cell.style.opacity = value > 0 ? String(0.3 + 0.6 * value) : "1";
    parent.append(cell);
  }
  return parent;
}

export class Wizard {
  constructor(parent, command) {
    this.parent = parent;
    this.command = command;
    this.made = "";
    this.picture = element("img", "seen-now");
    this.picture.alt = "What the camera sees";
    this.picture.hidden = true;
  }

  show(state) {
    const wizard = state.wizard || {};
    this.parent.hidden = state.phase !== "waiting";
    if (this.parent.hidden) return;
    const made = `${wizard.kind} ${wizard.stage} ${wizard.lines || ""} ${Object.keys(state.steps || {})}`;
    if (made !== this.made) {
      this.made = made;
      this.picture.hidden = true;
      if (wizard.stage === "going") this.makeStep(wizard);
      else this.makeChoice(state.steps || {}, wizard);
    }
    if (wizard.stage === "going") this.update(wizard);
  }

  button(text, className, act) {
    const button = element("button", className, text);
    button.type = "button";
    button.addEventListener("click", act);
    return button;
  }

  makeChoice(steps, wizard) {
    const parts = [];
    if (wizard.stage) {
      const said = element("div", `said ${wizard.stage}`);
      const titles = { done: "calibrated", failed: "not calibrated", computing: "computing" };
      const title = wizard.kind === "run" ? "not begun" : titles[wizard.stage];
      said.append(element("h3", "", `${NAMES[wizard.kind] || "Calibration"}: ${title}`));
      for (const line of wizard.lines || [wizard.advice]) said.append(element("p", "", line));
      if (wizard.files) said.append(element("p", "note", `Written: ${wizard.files.join(", ")}`));
      parts.push(said);
    }
    const can = Object.keys(steps).length ? "Before that, sensors can be calibrated here." : "It has no sensors that one could calibrate.";
    parts.push(element("p", "note", `Start begins the run. ${can}`));
    const list = element("div", "kinds");
    for (const [kind, summary] of Object.entries(steps)) {
      const row = element("div", "kind");
      const text = element("div", "");
      text.append(element("b", "", NAMES[kind] || kind), element("p", "note", summary));
      if (kind === "camera") text.append(this.boardFields());
      row.append(text, this.button("Calibrate", "", () => this.command({ do: "calibrate", kind, ...(kind === "camera" ? this.board() : {}) })));
      list.append(row);
    }
    parts.push(list);
    this.parent.replaceChildren(...parts);
  }

  boardFields() {
    const fields = element("div", "fields");
    this.fields = {};
    for (const [name, label, usual] of BOARD) {
      const wrap = element("label", "", label);
      let field;
      if (name === "pattern") {
        field = element("select");
        for (const word of ["charuco", "chessboard"]) field.append(element("option", "", word));
      } else {
        field = element("input");
        field.value = usual;
        field.size = 5;
        field.inputMode = name === "square_mm" ? "decimal" : "text";
      }
      this.fields[name] = field;
      wrap.append(field);
      fields.append(wrap);
    }
    return fields;
  }

  board() {
    return Object.fromEntries(Object.entries(this.fields).map(([name, field]) => [name, field.value.trim()]));
  }

  makeStep(wizard) {
    this.advice = element("p", "advice");
    this.bar = element("progress");
    this.bar.max = 1;
    this.bar.setAttribute("aria-label", "How much of what is wanted is there");
    this.seen = element("div", "seen");
    this.facts = element("dl", "facts");
    this.finish = this.button("Finish", "main", () => this.command({ do: "next" }));
    const buttons = element("div", "buttons");
    buttons.append(this.finish, this.button("Cancel", "", () => this.command({ do: "cancel" })));
    const shown = element("div", "shown");
    shown.append(this.picture, this.seen, this.facts);
    this.parent.replaceChildren(
      element("h2", "", `Calibrate: ${NAMES[wizard.kind] || wizard.kind}`),
      element("p", "note", HOW[wizard.kind] || ""),
      this.advice,
      this.bar,
      shown,
      buttons,
    );
  }

  update(wizard) {
    const { advice } = wizard;
    this.advice.textContent = advice.charAt(0).toUpperCase() + advice.slice(1) + ".";
    this.bar.value = wizard.share;
    this.finish.disabled = !wizard.can_finish;
    const seen = wizard.cells.length ? grid(wizard.cells) : wizard.ways.length ? sphere(wizard.ways) : null;
    this.seen.replaceChildren(...(seen ? [seen] : []));
    this.facts.replaceChildren(...Object.entries(wizard.facts).flatMap(([name, value]) => [element("dt", "", name), element("dd", "", value)]));
  }
}
