// What is known of the moment that one points at: picture, pose, errors, state and loops.
import { STATES, element, nearest } from "./data.js";

const AROUND_S = 0.6; // loops as near as this belong to the moment
const MOST_LOOPS = 5;
const FAR_S = 4; // a picture farther away than this is not of this moment

export class Details {
  constructor(parent, data) {
    this.data = data;
    this.picture = element("img", "frame");
    this.picture.alt = "";
    this.picture.hidden = true;
    this.caption = element("p", "of-frame");
    this.facts = element("dl", "facts");
    this.reason = element("p", "reason");
    this.loops = element("ul", "loops-now");
    this.loop = element("div", "loop");
    this.loop.hidden = true;
    parent.append(this.picture, this.caption, this.facts, this.reason, this.loops, this.loop);
    this.pictureTimes = data.pictures.map((picture) => picture.t);
  }

  imageAt(t) {
    const k = nearest(this.pictureTimes, t);
    return k < 0 || Math.abs(this.pictureTimes[k] - t) > FAR_S ? null : this.data.pictures[k];
  }

  setTime(t) {
    const { data } = this;
    const image = this.imageAt(t);
    if (image !== this.image) {
      this.image = image;
      this.picture.hidden = !image;
      if (image) this.picture.src = `data:image/jpeg;base64,${image.jpg}`;
      this.caption.textContent = image ? `Keyframe ${image.id} at ${image.t.toFixed(2)} s` : "";
    }
    const path = data.paths[data.best];
    const k = nearest(path.t, t);
    const facts = [["Time", `${t.toFixed(2)} s`]];
    const xyz = Array.from(path.xyz.subarray(3 * k, 3 * k + 3));
    facts.push(["x, y, z [m]", xyz.map((v) => v.toFixed(2)).join(", ")]);
    const R = path.R.subarray(9 * k, 9 * k + 9);
    facts.push(["Heading", `${((Math.atan2(R[3], R[0]) * 180) / Math.PI).toFixed(1)}°`]);
    for (const [name, curve] of Object.entries(data.errors)) {
      const i = nearest(curve.t, t);
      if (i < 0) continue;
      facts.push([`Error, ${data.labels[name] || name}`, `${curve.position[i].toFixed(3)} m, ${curve.rotation[i].toFixed(2)}°`, name]);
    }
    this.showState(t, facts);
    this.showFacts(facts);
    this.showLoops(t);
  }

  showState(t, facts) {
    const seen = this.data.tracking;
    this.reason.textContent = "";
    if (!seen.t) return;
    const k = nearest(seen.t, t);
    const state = STATES[seen.state[k]];
    const inliers = isNaN(seen.inliers[k]) ? "" : `, ${seen.inliers[k]} inliers`;
    facts.push(["Vision", `${state}${inliers}`, `state-${state}`]);
    this.reason.textContent = seen.reasons[seen.reason[k]];
  }

  showFacts(facts) {
    this.facts.replaceChildren(
      ...facts.flatMap(([name, value, mark]) => {
        const term = element("dt", "", name);
        if (mark) term.prepend(element("i", `dot ${mark}`));
        return [term, element("dd", "", value)];
      }),
    );
  }

  showLoops(t) {
    const rows = this.data.loops.rows;
    const near = rows
      .map((row, k) => [Math.min(Math.abs(row.to_s - t), Math.abs(row.from_s - t)), k])
      .filter(([away, k]) => away < AROUND_S && rows[k].decision !== "rejected")
      .sort((a, b) => a[0] - b[0])
      .slice(0, MOST_LOOPS);
    this.loops.replaceChildren(
      ...near.map(([, k]) => {
        const button = element("button", "", `Loop ${rows[k].from} – ${rows[k].to}`);
        button.type = "button";
        button.prepend(element("i", `dot ${rows[k].decision}`));
        button.addEventListener("click", () => this.onLoop && this.onLoop(k));
        const item = element("li");
        item.append(button);
        return item;
      }),
    );
  }

  choose(k) {
    this.loop.hidden = k === null;
    if (k === null) return;
    const row = this.data.loops.rows[k];
    const head = element("h3", "", `Loop ${row.from} – ${row.to}, ${row.decision}`);
    head.prepend(element("i", `dot ${row.decision}`));
    const pair = element("div", "pair");
    for (const t of [row.from_s, row.to_s]) {
      const image = this.imageAt(t);
      const button = element("button", "at", `${t.toFixed(1)} s`);
      button.type = "button";
      button.addEventListener("click", () => this.onTime && this.onTime(t));
      if (image) {
        const shown = element("img");
        shown.alt = "";
        shown.src = `data:image/jpeg;base64,${image.jpg}`;
        button.prepend(shown);
      }
      pair.append(button);
    }
    const close = element("button", "close", "×");
    close.type = "button";
    close.setAttribute("aria-label", "Close");
    close.addEventListener("click", () => this.onLoop && this.onLoop(null));
    this.loop.replaceChildren(close, head, pair, element("p", "note", row.text));
    this.loop.scrollIntoView({ block: "nearest" });
  }
}
