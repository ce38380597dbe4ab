// What the page carries, unpacked: little-endian typed arrays in base64.

export const DECISIONS = ["accepted", "pending", "rejected", "undone"];
export const LOOP_COLORS = { accepted: "good", pending: "warn", rejected: "bad", undone: "muted" };
export const STATES = ["ok", "degraded", "lost", "blind"];

function bytesOf(text) {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);
  return bytes.buffer;
}

export const floats = (text) => new Float32Array(bytesOf(text));
export const shorts = (text) => new Uint16Array(bytesOf(text));
export const octets = (text) => new Uint8Array(bytesOf(text));

export const steps = (text) => new Int16Array(bytesOf(text));
export const numbers = (text) => new Uint32Array(bytesOf(text));

// Colours of 5, 6 and 5 bits as bytes of red, green, blue and opacity.
export function colorsOf(packed, rgb, from = 0) {
  for (let k = 0; k < packed.length; k++) {
    const at = 4 * (from + k);
    rgb[at] = ((packed[k] >> 11) * 255) / 31;
    rgb[at + 1] = (((packed[k] >> 5) & 63) * 255) / 63;
    rgb[at + 2] = ((packed[k] & 31) * 255) / 31;
    rgb[at + 3] = 255;
  }
}

function unpackCloud(cloud) {
  const xyz = shorts(cloud.xyz);
  cloud.position = new Float32Array(3 * cloud.count);
  for (let k = 0; k < cloud.position.length; k++) cloud.position[k] = cloud.low[k % 3] + cloud.step[k % 3] * xyz[k];
  cloud.color = new Uint8Array(4 * cloud.count);
  colorsOf(shorts(cloud.rgb), cloud.color);
}

// What a report carries; a live page makes the same of what it is sent.
export function readData() {
  const data = JSON.parse(document.getElementById("view-data").textContent);
  if (data.cloud.count) unpackCloud(data.cloud);
  for (const path of Object.values(data.paths)) {
    path.t = floats(path.t);
    path.xyz = floats(path.xyz);
    if (path.R) path.R = floats(path.R);
  }
  for (const curve of Object.values(data.errors)) {
    for (const key of ["t", "position", "rotation"]) curve[key] = floats(curve[key]);
  }
  const seen = data.tracking;
  if (seen.t) {
    Object.assign(seen, { t: floats(seen.t), inliers: floats(seen.inliers), state: octets(seen.state) });
    seen.reason = shorts(seen.reason);
  }
  data.loops.ends = floats(data.loops.ends);
  if (data.sigmas.xyz) data.sigmas = { xyz: floats(data.sigmas.xyz), axes: floats(data.sigmas.axes) };
  data.keyframes = floats(data.keyframes);
  return data;
}

// Index of the entry of ascending times that is nearest to t; -1 where there is none.
export function nearest(times, t) {
  let low = 0;
  let high = times.length - 1;
  if (high < 0) return -1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle;
    else high = middle;
  }
  return t - times[low] <= times[high] - t ? low : high;
}

export const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

// A new element with text, never with markup: what stands in a run folder stays text.
export function element(tag, className, text) {
  const node = document.createElement(tag);
  if (className) node.className = className;
  if (text !== undefined) node.textContent = text;
  return node;
}
