// The page of a live run: asks for what is new, a few times a second, one request after the other.
import { DECISIONS, element, floats, octets } from "./data.js";
import { layerButtons } from "./layers.js";
import { LiveMap } from "./map.js";
import { Plan } from "./plan.js";
import { Plots } from "./plots.js";
import { viewTools } from "./tools.js";
import { View } from "./view.js";
import { Wizard } from "./wizard.js";

const STATE_MS = 100;
const DRAW_MS = 1000; // between two drawings of map and path; the pose moves in between
const SEEN_MS = 1000;
const LOST_MS = 1500; // between two tries where nothing answers
const GROWN = 1.15; // so much larger and the whole is looked at again
const SURE_MS = 4000;
const LABELS = { start: "Start", stop: "Stop", save: "Save map" };

const at = (id) => document.getElementById(id);
const page = { map: new LiveMap(), refusal: "", view: null, plots: null, state: null, drawn: 0, reach: 0, touched: false, answers: 0 };

class Lost extends Error {} // nothing answers; all other errors are ours

async function asked(path) {
  const answer = await fetch(path, { cache: "no-store" }).catch(() => null);
  if (answer && answer.status === 401) location.reload();
  if (!answer || !answer.ok) throw new Lost(path);
  return answer.json();
}

export async function command(values) {
  try {
    const answer = await fetch("/command", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(values),
    });
    page.refusal = answer.ok ? "" : (await answer.json()).error;
  } catch (error) {
    page.refusal = "Nothing answers: the command was not heard.";
  }
}

// A button; with a question it asks before it acts.
function buttonOf(name, label, act, question = "") {
  const button = element("button", name, label);
  button.type = "button";
  button.addEventListener("click", () => {
    if (!question || button.classList.contains("sure")) return act();
    button.classList.add("sure");
    button.textContent = question;
    setTimeout(() => {
      button.classList.remove("sure");
      button.textContent = label;
    }, SURE_MS);
  });
  return button;
}

function commandButtons(can) {
  const parent = at("commands");
  if (parent.dataset.can === can.join()) return;
  parent.dataset.can = can.join();
  const question = (name) => (name === "stop" ? "Really stop?" : "");
  parent.replaceChildren(...can.map((name) => buttonOf(name, LABELS[name] || name, () => command({ do: name }), question(name))));
}

// What is known of the loop that was clicked, and how to take it out of the graph.
function showLoop(k) {
  const row = page.view.data.loops.rows[k];
  const head = element("h3", "", `Loop ${row.from} – ${row.to}, ${row.decision}`);
  head.prepend(element("i", `dot ${row.decision}`));
  const parts = [head, element("p", "note", row.text)];
  if (row.decision === "accepted" && page.state.can.includes("save")) {
    const undo = () => {
      command({ do: "undo", loop: String(row.id) });
      parts[1].textContent = "It is taken out with the next keyframe.";
    };
    parts.push(buttonOf("undo", "Undo", undo, "Really undo?"));
  }
  parts.push(buttonOf("close", "×", () => (at("loop").hidden = true)));
  at("loop").replaceChildren(...parts);
  at("loop").hidden = false;
  page.view.choose(k);
}

const fixed = (value, digits, unit) => (value === null || value === undefined ? "–" : `${value.toFixed(digits)}${unit}`);

function factsOf(state) {
  const { pose, frame, map } = state;
  const facts = [];
  if (pose) {
    facts.push(["Time", fixed(pose.t_s, 1, " s")]);
    facts.push(["x, y, z [m]", pose.xyz.map((v) => fixed(v, 2, "")).join(", ")]);
    const [heading] = [Math.atan2(pose.R[3] ?? 0, pose.R[0] ?? 1)];
    facts.push(["Heading", fixed((heading * 180) / Math.PI, 1, "°")]);
    facts.push(["Sigma", fixed(pose.sigma_m, 2, " m")]);
    facts.push(["Speed", fixed(pose.speed_m_s, 2, " m/s")]);
    facts.push(["Vision corrected", pose.vision_age_s === null ? "not yet" : `${pose.vision_age_s.toFixed(1)} s ago`]);
  }
  if (frame) facts.push(["Vision", `${frame.tracking}, ${frame.inliers} inliers`, `state-${frame.tracking}`]);
  const late = state.latency_ms || {};
  if ("p50" in late) facts.push(["Sample to pose", `${late.p50.toFixed(2)} ms, 99 %: ${late.p99.toFixed(1)} ms`]);
  if (state.every > 1) facts.push(["Too slow", `one frame in ${state.every}`, "state-degraded"]);
  if (state.map_left_out) facts.push(["Map too slow", `${state.map_left_out} left out`, "state-degraded"]);
  for (const [name, word] of Object.entries(state.sensors || {})) facts.push([name, word, word === "well" ? "state-ok" : "state-lost"]);
  if (map.keyframes) facts.push(["Keyframes", `${map.keyframes}, graph ${map.graph_revision}`]);
  for (const decision of DECISIONS) {
    if (map.loops[decision]) facts.push([`Loops ${decision}`, String(map.loops[decision]), decision]);
  }
  return facts;
}

function showFacts(state) {
  at("facts").replaceChildren(...factsOf(state).flatMap(([name, value, mark]) => {
    const term = element("dt", "", name);
    if (mark) term.prepend(element("i", `dot ${mark}`));
    return [term, element("dd", "", value)];
  }));
  at("reasons").replaceChildren(...((state.verdict || {}).reasons || []).map((reason) => element("li", "", reason)));
  at("reason").textContent = state.frame ? state.frame.reason : "";
  const bad = new Set(["invalid", "gate_reject", "doubtful", "dead_reckoning"]);
  const health = state.pose ? state.pose.health : [];
  at("health").replaceChildren(...health.map((name) => {
    const isBad = bad.has(name) || /missing|fault|gap|saturated|drift|step/.test(name);
    return element("span", `flag ${isBad ? "bad" : "good"}`, name.replaceAll("_", " "));
  }));
}

function showLists(state) {
  at("processes").replaceChildren(...Object.entries(state.processes || {}).map(([role, word]) => {
    const item = element("li", "", `${role}: ${word}`);
    item.prepend(element("i", `dot state-${word === "runs" ? "ok" : word === "ended" ? "lost" : "degraded"}`));
    return item;
  }));
  const said = [
    ...(state.saved || []).map((saved) => [saved.is_well ? "saved" : "warning", saved.text, null]),
    ...(state.notices || []).slice().reverse(),
  ];
  at("notices-card").hidden = !said.length;
  const newest = said.find(([level]) => level !== "info");
  at("notices-card").querySelector("summary").textContent = newest ? `Notices: ${newest[1]}` : "Notices";
  at("notices").replaceChildren(...said.map(([level, text, t_s]) => {
    const item = element("li", level, text);
    item.prepend(element("b", "", level), element("time", "", fixed(t_s, 1, " s")));
    return item;
  }));
}

function showVerdict({ headline }) {
  at("verdict").className = `verdict ${headline.state}`;
  at("verdict").textContent = headline.text;
  at("invalid").hidden = headline.state !== "invalid";
  at("invalid-sigma").textContent = headline.sigma || "";
  at("invalid-reason").textContent = headline.reason || "";
}

// The picture of the run, or of the step of a calibration.
function showPicture(state) {
  const { frame } = state;
  const isStep = state.wizard && state.wizard.has_picture;
  const image = isStep ? page.wizard.picture : at("picture");
  if (!(isStep || (frame && frame.has_picture)) || page.loading || state.picture === page.shown) return;
  page.loading = true;
  page.shown = state.picture;
  const next = new Image();
  next.onload = () => {
    image.src = next.src;
    image.hidden = false;
    if (frame) at("of-picture").textContent = `Camera at ${frame.t_s.toFixed(1)} s`;
    page.loading = false;
  };
  next.onerror = () => (page.loading = false);
  next.src = `/camera.jpg?n=${state.picture}`;
}

function show(state) {
  page.state = state;
  at("run-name").textContent = state.run ? `vislam live: ${state.run}` : "vislam live";
  at("phase").textContent = state.phase;
  at("phase").className = `badge ${state.phase.replaceAll(" ", "-")}`;
  const saved = (state.saved || []).at(-1);
  at("line").textContent = page.refusal || (saved ? saved.text : "");
  at("view").classList.toggle("idle", ["starting", "waiting", "getting ready"].includes(state.phase));
  commandButtons(state.can || []);
  showVerdict(state);
  showFacts(state);
  showLists(state);
  page.wizard.show(state);
  showPicture(state);
  if (page.map.takePath(state.path)) page.stale = true;
  if (page.view && state.pose && state.pose.R[0] !== null) page.view.setPose(state.pose.R, state.pose.xyz);
  document.documentElement.dataset.phase = state.phase;
  document.documentElement.dataset.answers = ++page.answers;
}

async function followMap(state) {
  const { map } = page;
  if (state.map.epoch === map.epoch && state.map.revision === map.revision) return;
  let answer;
  do {
    answer = await asked(`/map?epoch=${map.epoch}&since=${map.revision}`);
    map.take(answer);
  } while (answer.more);
  page.stale = true;
}

function draw() {
  const now = performance.now();
  if (!page.stale || now - page.drawn < DRAW_MS) return;
  const data = page.map.data();
  if (!Object.keys(data.paths).length && !data.cloud.count) return;
  page.stale = false;
  page.drawn = now;
  if (!page.view) {
    try {
      page.view = new View(at("view-canvas"), data);
      viewTools(page.view, at("view-tools"), (touched) => (page.touched = touched));
    } catch (error) {
      document.documentElement.classList.add("flat"); // no WebGL here
      page.view = new Plan(at("view-canvas"), data);
    }
    if (page.view.controls) page.view.controls.addEventListener("start", () => (page.touched = true));
    page.view.onLoop = showLoop;
  } else page.view.replace(data);
  if (page.view.layers) drawLayers();
  const { pose } = page.state;
  if (pose && pose.R[0] !== null) page.view.setPose(pose.R, pose.xyz);
  const flat = page.view.layers ? "" : "This browser shows no WebGL: the map is flat, from above. ";
  at("of-map").textContent = `${flat}Points: ${data.cloud.count}, of ${page.map.clouds.size} of ${page.map.poses.size} keyframes`;
  document.documentElement.dataset.points = data.cloud.count;
}

function drawLayers() {
  const names = [...page.view.layers.keys()].join();
  if (names !== page.layers) {
    page.layers = names;
    page.view.show("live", true);
    at("view-layers").replaceChildren();
    layerButtons(page.view, at("view-layers"));
  }
  if (!page.touched && (page.view.reach > GROWN * page.reach || page.reach > GROWN * page.view.reach)) {
    page.reach = page.view.reach;
    page.view.overview();
  }
}

async function followVision(state) {
  const now = performance.now();
  if (!state.frame || now - (page.seenAt || -SEEN_MS) < SEEN_MS) return;
  page.seenAt = now;
  const seen = await asked("/seen");
  const tracking = { t: floats(seen.t), inliers: floats(seen.inliers), state: octets(seen.state) };
  if (tracking.t.length < 2) return;
  const end = tracking.t[tracking.t.length - 1];
  if (!page.plots) {
    page.plots = new Plots(at("view-plots"), { errors: {}, labels: {}, tracking, end_s: end, loops: { rows: [] } });
  } else page.plots.setTracking(tracking, end);
}

async function turn() {
  let wait = STATE_MS;
  try {
    const { map } = page;
    const state = await asked(`/state?epoch=${map.pathEpoch}&path=${map.path.length / 3}`);
    show(state);
    await followMap(state);
    draw();
    await followVision(state);
  } catch (error) {
    if (!(error instanceof Lost)) throw error;
    const isOver = page.state && ["ending", "ended"].includes(page.state.phase);
    at("phase").textContent = isOver ? "ended" : "no connection";
    at("phase").className = "badge";
    document.documentElement.dataset.phase = isOver ? "ended" : "lost";
    at("line").textContent = isOver
      ? "The run has ended and its folder is written."
      : "Nothing answers: the run has ended, or the way to it is cut.";
    at("invalid").hidden = true;
    if (!isOver) showVerdict({ headline: { state: "lost", text: "No connection: what stands below is old." } });
    commandButtons([]);
    wait = LOST_MS;
  }
  setTimeout(turn, wait);
}

if (location.hash) history.replaceState(null, "", "/"); // the token, where one had signed in before
document.documentElement.classList.add("live");
page.wizard = new Wizard(at("wizard"), command);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  if (page.view) page.view.paint();
  if (page.plots) page.plots.paint();
});
window.vislamLive = page;
document.documentElement.dataset.ready = "yes";
turn();
