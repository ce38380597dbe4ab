// The map from above, flat: what stands in for the view in 3-D where the browser has no WebGL.
import { DECISIONS, LOOP_COLORS, color } from "./data.js";

const MARGIN_PX = 24;
const MOST_POINTS = 20000;

export class Plan {
  constructor(canvas, data) {
    this.canvas = canvas;
    this.pose = null;
    new ResizeObserver(() => this.paint()).observe(canvas.parentElement);
    this.replace(data);
  }

  replace(data) {
    this.data = data;
    this.paint();
  }

  setPose(R, [x, y]) {
    this.pose = { x, y, heading: Math.atan2(R[3], R[0]) };
    this.paint();
  }

  // What brings metres of the map onto the canvas.
  place(width, height) {
    const { paths, cloud } = this.data;
    const low = [Infinity, Infinity];
    const high = [-Infinity, -Infinity];
    const take = (value, k) => {
      if (k > 1) return;
      low[k] = Math.min(low[k], value);
      high[k] = Math.max(high[k], value);
    };
    for (const path of Object.values(paths)) path.xyz.forEach((value, k) => take(value, k % 3));
    if (cloud.count) cloud.near.forEach((corner) => corner.forEach(take));
    const spans = [Math.max(high[0] - low[0], 0.1), Math.max(high[1] - low[1], 0.1)];
    const scale = Math.min((width - 2 * MARGIN_PX) / spans[0], (height - 2 * MARGIN_PX) / spans[1]);
    const middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
    return (x, y) => [width / 2 + scale * (x - middle[0]), height / 2 - scale * (y - middle[1])];
  }

  paint() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    this.canvas.width = width;
    this.canvas.height = height;
    const pen = this.canvas.getContext("2d");
    const at = this.place(width, height);
    const { paths, cloud, loops } = this.data;
    for (let k = 0, step = Math.ceil(cloud.count / MOST_POINTS); k < cloud.count; k += step) {
      pen.fillStyle = `rgb(${cloud.color[4 * k]} ${cloud.color[4 * k + 1]} ${cloud.color[4 * k + 2]})`;
      pen.fillRect(...at(cloud.position[3 * k], cloud.position[3 * k + 1]), 2, 2);
    }
    const line = (points, name, wide) => {
      pen.beginPath();
      points.forEach((point) => pen.lineTo(...point));
      pen.strokeStyle = color(name);
      pen.lineWidth = wide;
      pen.stroke();
    };
    for (const [name, { xyz }] of Object.entries(paths)) {
      line(Array.from({ length: xyz.length / 3 }, (_, k) => at(xyz[3 * k], xyz[3 * k + 1])), name, 2);
    }
    loops.rows.forEach(({ decision }, k) => {
      const [a, b, , c, d] = loops.ends.subarray(6 * k, 6 * k + 6);
      if (DECISIONS.indexOf(decision) < 2) line([at(a, b), at(c, d)], LOOP_COLORS[decision], 1);
    });
    if (!this.pose) return;
    const [x, y] = at(this.pose.x, this.pose.y);
    const tip = (turn, far) => [x + far * Math.cos(this.pose.heading + turn), y - far * Math.sin(this.pose.heading + turn)];
    line([tip(2.5, 12), tip(0, 16), tip(-2.5, 12), tip(2.5, 12)], "accent", 3);
  }
}
