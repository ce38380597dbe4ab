// Joins the view, the plots and the details: one moment, one chosen loop.
import { element, readData } from "./data.js";
import { Details } from "./details.js";
import { addLabels } from "./labels.js";
import { layerButtons } from "./layers.js";
import { Plots } from "./plots.js";
import { sortTables } from "./sort.js";
import { viewTools } from "./tools.js";
import { View } from "./view.js";

const PLAY_MS = 50;

function player(slider, button, data, setTime) {
  let timer = null;
  const stop = () => {
    clearInterval(timer);
    timer = null;
    button.textContent = "Play";
  };
  button.addEventListener("click", () => {
    if (timer) return stop();
    button.textContent = "Pause";
    const step = Math.max(data.end_s / 400, PLAY_MS / 1000);
    timer = setInterval(() => {
      const t = Number(slider.value) + step;
      if (t >= data.end_s) stop();
      setTime(Math.min(t, data.end_s));
    }, PLAY_MS);
  });
  slider.addEventListener("input", () => {
    stop();
    setTime(Number(slider.value));
  });
}

function start() {
  const at = (id) => document.getElementById(id);
  const root = document.documentElement;
  const data = readData();
  let view = null;
  try {
    view = new View(at("view-canvas"), data);
  } catch (error) {
    root.classList.add("flat"); // no WebGL here: the pictures stay, the plots live
    const word = element("p", "note", "This browser shows no WebGL: here is the path from above, flat; it does not turn.");
    const picture = document.querySelector(".from-above .scroll");
    at("view-canvas").closest(".canvas").replaceChildren(word, ...(picture ? [picture] : []));
  }
  const plots = new Plots(at("view-plots"), data);
  const details = new Details(at("view-details"), data);
  const slider = at("view-time");
  slider.max = String(data.end_s);
  const setTime = (t) => {
    slider.value = String(t);
    at("view-now").textContent = `${t.toFixed(1)} s`;
    if (view) view.setTime(t);
    plots.setTime(t);
    details.setTime(t);
    root.dataset.time = t.toFixed(3);
  };
  const choose = (k) => {
    if (view) view.choose(k);
    details.choose(k);
    if (k !== null) setTime(data.loops.rows[k].to_s);
  };
  for (const part of [view, plots, details]) if (part) Object.assign(part, { onTime: setTime, onLoop: choose });
  player(slider, at("view-play"), data, setTime);
  at("plots-whole").addEventListener("click", () => plots.whole());
  if (view) {
    addLabels(view, data.voxels, at("view-layers").parentElement);
    layerButtons(view, at("view-layers"));
    viewTools(view, at("view-tools"));
  }
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", () => {
    if (view) view.paint();
    plots.paint();
  });
  setTime(Math.min(data.paths[data.best].t[0], data.end_s));
  document.querySelectorAll(".sortable").forEach(sortTables);
  window.vislamReport = { view, plots, details, data };
  root.dataset.ready = "yes";
}

// The words are seen at once; what takes longer comes after them.
document.documentElement.classList.add("live");
requestAnimationFrame(() => setTimeout(start, 0));
