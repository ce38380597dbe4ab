// The map as it grows: points of each keyframe, sent once in its own frame, stand where its newest pose has them.
import { colorsOf, floats, numbers, shorts, steps } from "./data.js";

const FAR_SHARE = 0.02; // of points on either side, which do not decide how large the picture is
const USUAL = 20000; // points of a map: fewer are not drawn larger
const MEASURED = 4000; // points by which that is judged

export class LiveMap {
  constructor() {
    this.path = new Float32Array(0);
    this.pathEpoch = 0;
    this.reset(0);
  }

  reset(epoch) {
    this.epoch = epoch;
    this.revision = 0;
    this.poses = new Map();
    this.clouds = new Map();
    this.loops = [];
    this.mostEach = 1;
  }

  take(answer) {
    if (answer.epoch !== this.epoch) this.reset(answer.epoch);
    const ids = numbers(answer.ids);
    const T = floats(answer.T);
    ids.forEach((id, k) => this.poses.set(id, T.subarray(12 * k, 12 * k + 12)));
    for (const [id, cloud] of Object.entries(answer.clouds)) {
      this.clouds.set(Number(id), { step: cloud.step, xyz: steps(cloud.xyz), rgb: shorts(cloud.rgb) });
    }
    this.loops = answer.loops;
    this.mostEach = answer.most_each;
    this.revision = answer.revision;
  }

  takePath(update) {
    const tail = floats(update.xyz);
    if (update.epoch === this.pathEpoch && !tail.length) return false;
    const from = update.epoch === this.pathEpoch ? 3 * update.from : 0;
    const path = new Float32Array(from + tail.length);
    path.set(this.path.subarray(0, from));
    path.set(tail, from);
    this.path = path;
    this.pathEpoch = update.epoch;
    return true;
  }

  // What the view of a report takes.
  data() {
    const ids = [...this.poses.keys()].sort((a, b) => a - b);
    const graph = new Float32Array(ids.flatMap((id) => this.position(id)));
    const paths = {};
    if (this.path.length >= 6) paths.live = { xyz: this.path };
    if (graph.length >= 6) paths.graph = { xyz: graph };
    const known = this.loops.filter(([from, to]) => this.poses.has(from) && this.poses.has(to));
    return {
      paths,
      best: paths.live ? "live" : "graph",
      labels: { live: "Path of the pose", graph: "Keyframes" },
      cloud: this.cloud(),
      loops: {
        rows: known.map(([from, to, decision, text, id]) => ({ from, to, decision, text, id })),
        ends: new Float32Array(known.flatMap(([from, to]) => [...this.position(from), ...this.position(to)])),
      },
    };
  }

  position(id) {
    const T = this.poses.get(id);
    return [T[3], T[7], T[11]];
  }

  cloud() {
    const shown = [...this.clouds].filter(([id]) => this.poses.has(id));
    const sizes = shown.map(([, cloud]) => Math.min(cloud.rgb.length, this.mostEach));
    const count = sizes.reduce((sum, size) => sum + size, 0);
    if (!count) return { count };
    const position = new Float32Array(3 * count);
    const color = new Uint8Array(4 * count);
    let at = 0;
    shown.forEach(([id, { step, xyz, rgb }], place) => {
      const T = this.poses.get(id);
      colorsOf(rgb.subarray(0, sizes[place]), color, at);
      for (let k = 0; k < sizes[place]; k++, at++) {
        const [x, y, z] = [step * xyz[3 * k], step * xyz[3 * k + 1], step * xyz[3 * k + 2]];
        for (let row = 0; row < 3; row++) {
          position[3 * at + row] = T[4 * row] * x + T[4 * row + 1] * y + T[4 * row + 2] * z + T[4 * row + 3];
        }
      }
    });
    return { count, position, color, near: near(position, count), usual: USUAL };
  }
}

// Two corners of a box that holds nearly all points.
function near(position, count) {
  const stride = Math.max(1, Math.floor(count / MEASURED));
  const low = [];
  const high = [];
  for (let axis = 0; axis < 3; axis++) {
    const values = [];
    for (let k = 0; k < count; k += stride) values.push(position[3 * k + axis]);
    values.sort((a, b) => a - b);
    const far = Math.floor(FAR_SHARE * (values.length - 1));
    low.push(values[far]);
    high.push(values[values.length - 1 - far]);
  }
  return [low, high];
}
