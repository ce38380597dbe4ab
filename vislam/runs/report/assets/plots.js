// Errors, inliers and state over time, in plots that share one axis: point, drag to zoom, double click for all of it.
import { STATES, color } from "./data.js";

/* global uPlot */

const HEIGHT = { position: 170, rotation: 130, inliers: 110 };
const STATE_COLORS = ["good", "warn", "bad", "muted"];

function joined(curves) {
  const tables = curves.map((curve) => [Array.from(curve.t), Array.from(curve.values, (v) => (isNaN(v) ? null : v))]);
  return tables.length === 1 ? tables[0] : uPlot.join(tables, tables.map(() => [0, 2]));
}

// Bands of the times at which vision was not ok.
function spells(tracking, end) {
  const out = [];
  const { t, state } = tracking;
  for (let k = 0; t && k < t.length; k++) {
    const until = k + 1 < t.length ? t[k + 1] : end;
    const last = out[out.length - 1];
    if (!state[k]) continue;
    if (last && last.state === state[k] && last.until === t[k]) last.until = until;
    else out.push({ state: state[k], from: t[k], until });
  }
  return out;
}

export class Plots {
  constructor(parent, data) {
    this.parent = parent;
    this.data = data;
    this.plots = [];
    this.closed = data.loops.rows.filter((row) => row.decision === "accepted").map((row) => row.to_s);
    const of = (key) => Object.entries(data.errors).map(([name, curve]) => ({ name, t: curve.t, values: curve[key] }));
    if (of("position").length) {
      this.add("position", "Position error [m]", of("position"), 3);
      this.add("rotation", "Rotation error [°]", of("rotation"), 2);
    }
    this.setTracking(data.tracking, data.end_s);
    new ResizeObserver(() => this.resize()).observe(parent);
  }

  // What vision saw up to an end; a live page gives it again and again.
  setTracking(tracking, end) {
    this.data.tracking = tracking;
    this.data.end_s = end;
    this.spells = spells(tracking, end);
    if (!tracking.t) return;
    const curves = [{ name: "muted", t: tracking.t, values: tracking.inliers }];
    if (this.inliers) this.inliers.setData(joined(curves));
    else this.inliers = this.add("inliers", "Inliers of vision", curves, 0);
  }

  add(key, title, curves, digits) {
    const frame = document.createElement("figure");
    frame.className = "plot";
    const head = document.createElement("figcaption");
    head.textContent = title;
    frame.append(head);
    this.parent.append(frame);
    const labels = { ...this.data.labels, muted: "inliers" };
    const tell = (value) => (value === null || value === undefined ? "–" : value.toFixed(digits));
    const series = curves.map((curve) => ({
      label: labels[curve.name],
      stroke: () => color(curve.name),
      width: curve.name === "graph" ? 1.8 : 1.2,
      points: { show: false },
      spanGaps: true,
      value: (u, value) => tell(value),
    }));
    const axis = { stroke: () => color("muted"), grid: { stroke: () => color("line"), width: 0.6 }, font: "11px system-ui, sans-serif", ticks: { show: false } };
    const plot = new uPlot(
      {
        width: this.width(),
        height: HEIGHT[key],
        padding: [6, 8, 0, 0],
        scales: { x: { time: false }, y: { range: (u, low, high) => [Math.min(0, low ?? 0), (high || 1) * 1.06] } },
        series: [{ label: "time", value: (u, t) => (t === null || t === undefined ? "–" : `${t.toFixed(2)} s`) }, ...series],
        axes: [{ ...axis, size: 26 }, { ...axis, size: 46 }],
        cursor: { sync: { key: "report" }, drag: { x: true, y: false }, y: false, points: { size: 6 } },
        hooks: {
          drawClear: [(u) => this.background(u)],
          setCursor: [(u) => this.moved(u)],
          setScale: [(u, scale) => scale === "x" && this.zoomed(u)],
        },
      },
      joined(curves),
      frame,
    );
    const now = document.createElement("div");
    now.className = "now";
    plot.over.append(now);
    plot.now = now;
    plot.over.addEventListener("pointermove", (event) => this.touched(plot, event));
    plot.over.addEventListener("pointerdown", (event) => this.touched(plot, event));
    this.plots.push(plot);
    return plot;
  }

  width() {
    return Math.max(Math.floor(this.parent.clientWidth), 200);
  }

  resize() {
    for (const plot of this.plots) plot.setSize({ width: this.width(), height: plot.height });
    this.setTime(this.time ?? 0);
  }

  touched(plot, event) {
    if (event.pointerType === "mouse") return;
    const left = event.clientX - plot.over.getBoundingClientRect().left;
    plot.setCursor({ left, top: 10 });
  }

  background(u) {
    const { left, top, width, height } = u.bbox;
    const context = u.ctx;
    const at = (t) => Math.min(Math.max(u.valToPos(t, "x", true), left), left + width);
    context.save();
    for (const spell of this.spells) {
      context.globalAlpha = 0.16;
      context.fillStyle = color(STATE_COLORS[spell.state]);
      context.fillRect(at(spell.from), top, Math.max(at(spell.until) - at(spell.from), 1), height);
    }
    context.globalAlpha = 0.8;
    context.fillStyle = color("good");
    for (const t of this.closed) {
      const x = u.valToPos(t, "x", true);
      if (x >= left && x <= left + width) context.fillRect(x, top, devicePixelRatio, 5 * devicePixelRatio);
    }
    context.restore();
  }

  moved(u) {
    if (u.cursor.left < 0 || u.cursor.event === null || this.silent) return;
    const t = u.posToVal(u.cursor.left, "x");
    if (Number.isFinite(t) && this.onTime && t !== this.time) this.onTime(Math.min(Math.max(t, 0), this.data.end_s));
  }

  zoomed(u) {
    if (this.zooming) return;
    this.zooming = true;
    const { min, max } = u.scales.x;
    for (const other of this.plots) if (other !== u) other.setScale("x", { min, max });
    this.zooming = false;
    this.setTime(this.time ?? 0);
  }

  whole() {
    for (const plot of this.plots) plot.setScale("x", { min: plot.data[0][0], max: plot.data[0][plot.data[0].length - 1] });
  }

  setTime(t) {
    this.time = t;
    for (const plot of this.plots) {
      const left = plot.valToPos(t, "x");
      plot.now.style.transform = `translateX(${left}px)`;
      plot.now.hidden = !(left >= 0 && left <= plot.over.clientWidth);
    }
  }

  paint() {
    for (const plot of this.plots) plot.redraw();
  }
}

export const stateColor = (state) => STATE_COLORS[STATES.indexOf(state)];
