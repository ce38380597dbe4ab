// The map and the trajectories in 3-D. Draws only when something has changed; while it turns, only as many points as
// the machine can draw 20 times a second.
import { DECISIONS, LOOP_COLORS, color, nearest } from "./data.js";
import { loopAt, pointAt, timeAt } from "./pick.js";
import { Shade, round } from "./shade.js";
import { arrow, bands, ellipsoids, pyramid } from "./shapes.js";

/* global THREE */

const FRAME_MS = 45;
const FEWEST = 20000;
const FIRST = 100000; // points of the first picture
const PATH_WIDTH = 0.003; // half of it, in radii of the scene: lines of WebGL have one pixel whatever one asks for
const HIDDEN = ["rejected", "undone"]; // until one asks for them
const MOUSE = { hits: 9, rolls: 5 }; // px: so far from a loop a click still means it, and so far the mouse may move
const FINGER = { hits: 22, rolls: 12 };
const FORWARD = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]; // a camera that looks along x of the body

export class View {
  constructor(canvas, data) {
    THREE.ColorManagement.enabled = false; // colours as they are stored and as the page has them
    this.data = data;
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.shade = new Shade(this.renderer);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.layers = new Map(); // name: { node, label, swatch }
    this.painted = []; // what takes a colour of the page: [material, name of the colour]
    this.fraction = Math.min(1, FIRST / (data.cloud.count || 1));
    this.frameMs = 0;
    this.addControls();
    this.fill();
    this.paint();
    this.overview();
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
  }

  // Everything that is drawn of the data.
  fill() {
    this.measure();
    this.addGrid();
    this.addCloud();
    this.addPaths();
    this.addSigmas();
    this.addLoops();
    this.addMarker();
    this.span(this.ends || []);
    this.controls.maxDistance = 12 * this.reach;
    this.controls.minDistance = 0.02 * this.reach;
  }

  // Draw other data from where one looks now; what is hidden stays so.
  replace(data) {
    const hidden = new Map([...this.layers].map(([name, layer]) => [name, layer.node.visible]));
    this.scene.traverse((node) => {
      if (node.geometry) node.geometry.dispose();
      if (node.material) node.material.dispose();
    });
    this.scene.clear();
    this.layers.clear();
    this.painted = [];
    this.points = null;
    this.data = data;
    this.fill();
    for (const [name, layer] of this.layers) if (hidden.has(name)) layer.node.visible = hidden.get(name);
    this.paint();
  }

  measure() {
    const { cloud, paths, best } = this.data;
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    const take = (p, k) => {
      low[k] = Math.min(low[k], p);
      high[k] = Math.max(high[k], p);
    };
    paths[best].xyz.forEach((value, k) => take(value, k % 3));
    this.path = { low: new THREE.Vector3(...low), high: new THREE.Vector3(...high) };
    if (cloud.count) cloud.near.forEach((corner) => corner.forEach(take));
    this.low = new THREE.Vector3(...low);
    this.high = new THREE.Vector3(...high);
    this.middle = this.low.clone().add(this.high).multiplyScalar(0.5);
    this.reach = Math.max(this.low.distanceTo(this.high) / 2, 0.1);
  }

  add(name, node, label, swatch, visible = true) {
    node.visible = visible;
    this.layers.set(name, { node, label, swatch });
    this.scene.add(node);
  }

  addGrid() {
    const cell = 10 ** Math.floor(Math.log10(this.reach));
    const count = 2 * Math.ceil((1.3 * this.reach) / cell);
    const grid = new THREE.GridHelper(count * cell, count);
    grid.material.dispose();
    grid.material = new THREE.LineBasicMaterial({ transparent: true, opacity: 0.75, depthWrite: false });
    grid.geometry.deleteAttribute("color");
    this.painted.push([grid.material, "line"]);
    grid.rotation.x = Math.PI / 2;
    const snap = (value) => Math.round(value / cell) * cell;
    grid.position.set(snap(this.middle.x), snap(this.middle.y), this.low.z - 0.01 * this.reach);
    this.add("grid", grid, `Grid of ${cell >= 1 ? cell : cell.toPrecision(1)} m`, "line");
  }

  addCloud() {
    const cloud = this.data.cloud;
    if (!cloud.count) return;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(cloud.position, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(cloud.color, 4, true));
    // as large as points that lie evenly on surfaces of this extent would have to be to close them
    this.pointSize = (6.2 * this.reach) / Math.sqrt(Math.max(cloud.count, cloud.usual || 0));
    const material = new THREE.PointsMaterial({ vertexColors: true, size: this.pointSize });
    round(material);
    this.pointSize = material.size;
    this.points = new THREE.Points(geometry, material);
    this.points.frustumCulled = false;
    this.add("map", this.points, "Map", "muted");
  }

  line(xyz, name, opacity, Kind = THREE.Line) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(xyz, 3));
    const material = new THREE.LineBasicMaterial({ transparent: opacity < 1, opacity });
    this.painted.push([material, name]);
    const node = new Kind(geometry, material);
    node.frustumCulled = false;
    return node;
  }

  // A path as two bands that cross, so that it has a width from wherever one looks.
  band(xyz, name) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(bands(xyz, PATH_WIDTH * this.reach), 3));
    const material = new THREE.MeshBasicMaterial({ side: 2 }); // both sides
    this.painted.push([material, name]);
    const node = new THREE.Mesh(geometry, material);
    node.frustumCulled = false;
    return node;
  }

  addPaths() {
    const { paths, labels } = this.data;
    for (const [name, path] of Object.entries(paths)) {
      const shown = name !== "live" || !paths.graph;
      this.add(name, this.band(path.xyz, name), labels[name], name, shown);
    }
  }

  // Where the body is with a probability of 97 %, as its covariance has it.
  addSigmas() {
    const { sigmas } = this.data;
    if (!sigmas || !sigmas.xyz) return;
    const node = this.line(ellipsoids(sigmas.xyz, sigmas.axes), "accent", 0.8, THREE.LineSegments);
    this.add("sigmas", node, "Uncertainty, 3 σ", "accent", false);
  }

  addLoops() {
    const { rows, ends } = this.data.loops;
    this.loopNodes = {};
    for (const decision of DECISIONS) {
      const indices = rows.flatMap((row, k) => (row.decision === decision ? [k] : []));
      if (!indices.length) continue;
      const xyz = new Float32Array(6 * indices.length);
      indices.forEach((k, place) => xyz.set(ends.subarray(6 * k, 6 * k + 6), 6 * place));
      const node = this.line(xyz, LOOP_COLORS[decision], HIDDEN.includes(decision) ? 0.5 : 0.9, THREE.LineSegments);
      node.userData.indices = indices;
      const label = `Loops ${decision}`;
      this.add(`loops-${decision}`, node, label, LOOP_COLORS[decision], !HIDDEN.includes(decision));
      this.loopNodes[decision] = node;
    }
    this.chosen = this.line(new Float32Array(6), "accent", 1, THREE.LineSegments);
    this.chosen.visible = false;
    this.chosen.material.depthTest = false;
    this.chosen.renderOrder = 3;
    this.scene.add(this.chosen);
  }

  addMarker() {
    const size = 0.07 * this.reach;
    const segments = this.data.has_camera === false ? arrow(size) : pyramid(size, this.data.camera || FORWARD);
    const shape = this.line(new Float32Array(segments), "accent", 1, THREE.LineSegments);
    const ball = new THREE.Mesh(new THREE.SphereGeometry(0.011 * this.reach, 16, 12), new THREE.MeshBasicMaterial());
    this.painted.push([ball.material, "accent"]);
    for (const node of [shape, ball]) {
      node.material.depthTest = false;
      node.renderOrder = 4;
    }
    this.marker = new THREE.Group();
    this.marker.matrixAutoUpdate = false;
    this.marker.add(shape, ball);
    this.scene.add(this.marker);
  }

  addControls() {
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => this.ask(true));
    this.controls.addEventListener("end", () => this.rest());
    let down = null; // where the mouse or one finger came down; two fingers are no click
    this.canvas.addEventListener("pointerdown", (event) => {
      down = event.isPrimary ? [event.clientX, event.clientY] : null;
    });
    this.canvas.addEventListener("pointerup", (event) => {
      const by = event.pointerType === "touch" ? FINGER : MOUSE;
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < by.rolls) this.click(event, by.hits);
      down = null;
    });
  }

  // Look at all of it from above and aside.
  overview() {
    const way = new THREE.Vector3(-0.62, -0.85, 0.95).normalize();
    const target = this.middle.clone();
    target.z = this.low.z; // what is near takes more of the picture than what is far
    this.look(target, way, (2.15 * this.reach) / Math.min(this.camera.aspect || 1, 1.2));
  }

  // The whole path and a margin around it.
  fromAbove() {
    this.resize();
    const size = this.path.high.clone().sub(this.path.low);
    const tangent = Math.tan((this.camera.fov * Math.PI) / 360);
    const away = Math.max(size.y, size.x / this.camera.aspect, 0.1 * this.reach) / (2 * tangent);
    const target = this.path.low.clone().addScaledVector(size, 0.5);
    this.look(target, new THREE.Vector3(0, -0.001, 1), 1.15 * away + size.z / 2);
  }

  look(target, way, away) {
    this.controls.target.copy(target);
    this.camera.position.copy(target).addScaledVector(way, away);
    this.camera.near = 0.005 * this.reach;
    this.camera.far = 30 * this.reach;
    this.controls.update();
    this.resize();
  }

  paint() {
    this.scene.background = new THREE.Color(color("scene"));
    for (const [material, name] of this.painted) material.color.set(color(name));
    this.ask();
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.ask();
  }

  ask(moving = false) {
    this.moving = this.moving || moving;
    if (moving) {
      clearTimeout(this.later);
      this.later = setTimeout(() => this.rest(), 180);
    }
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      this.draw();
    });
  }

  rest() {
    this.moving = false;
    this.ask();
  }

  draw() {
    const begun = performance.now();
    if (this.points) {
      const count = this.data.cloud.count;
      const part = this.moving ? Math.max(this.fraction, Math.min(1, FEWEST / count)) : 1;
      this.points.geometry.setDrawRange(0, Math.round(part * count));
      this.points.material.size = this.pointSize / Math.sqrt(part); // fewer points, as much of the surface
    }
    this.shade.render(this.scene, this.camera);
    if (!this.moving) return;
    // reading one pixel waits for the picture: what calls alone take says nothing about software rendering
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.frameMs = performance.now() - begun;
    this.fraction = Math.min(1, Math.max(0.01, this.fraction * Math.min(1.3, Math.max(0.5, FRAME_MS / this.frameMs))));
  }

  // The time to draw everything once, in milliseconds, as a mean of several.
  timeWhole(times) {
    const gl = this.renderer.getContext();
    const begun = performance.now();
    for (let k = 0; k < times; k++) {
      this.shade.render(this.scene, this.camera);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    }
    return (performance.now() - begun) / times;
  }

  setTime(t) {
    const path = this.data.paths[this.data.best];
    const k = nearest(path.t, t);
    const R = path.R.subarray(9 * k, 9 * k + 9);
    this.setPose(R, path.xyz.subarray(3 * k, 3 * k + 3));
  }

  setPose(R, [x, y, z]) {
    this.marker.matrix.set(R[0], R[1], R[2], x, R[3], R[4], R[5], y, R[6], R[7], R[8], z, 0, 0, 0, 1);
    this.marker.matrixWorldNeedsUpdate = true;
    const stands = new THREE.Vector3(x, y, z);
    if (this.follows) this.goWith(stands.clone().sub(this.stands));
    this.stands = stands;
    this.ask();
  }

  // Look at the body from so many radii of the scene and stay with it; 0: no more.
  follow(radii) {
    this.follows = radii > 0;
    if (!this.follows || !this.stands) return;
    const way = this.camera.position.clone().sub(this.controls.target).normalize();
    this.look(this.stands, way, radii * this.reach);
  }

  goWith(step) {
    this.camera.position.add(step);
    this.controls.target.add(step);
    this.controls.update();
  }

  // A line between two points, or one of them.
  span(ends) {
    this.ends = ends;
    if (this.spanned) this.scene.remove(this.spanned);
    const points = ends.length ? [ends[0], ends[ends.length - 1]] : [];
    const xyz = new Float32Array(points.flatMap((end) => end.toArray()));
    this.spanned = this.line(xyz, "accent", 1, THREE.LineSegments);
    const dots = new THREE.Points(this.spanned.geometry, new THREE.PointsMaterial({ size: 9, sizeAttenuation: false }));
    for (const node of [this.spanned, dots]) {
      node.material.depthTest = false;
      node.material.color.set(color("accent"));
      node.renderOrder = 5;
    }
    dots.frustumCulled = false;
    this.spanned.add(dots);
    this.scene.add(this.spanned);
    this.ask();
  }

  show(name, visible) {
    this.layers.get(name).node.visible = visible;
    this.ask();
  }

  choose(k) {
    this.chosen.visible = k !== null;
    if (k !== null) {
      this.chosen.geometry.attributes.position.array.set(this.data.loops.ends.subarray(6 * k, 6 * k + 6));
      this.chosen.geometry.attributes.position.needsUpdate = true;
    }
    this.ask();
  }

  // On the screen, in pixels of the page; null behind the camera.
  project(x, y, z) {
    // The camera may have moved since the last frame was drawn.
    this.camera.updateMatrixWorld();
    const p = new THREE.Vector3(x, y, z).project(this.camera);
    const { clientWidth, clientHeight } = this.canvas;
    return p.z > 1 ? null : [((p.x + 1) / 2) * clientWidth, ((1 - p.y) / 2) * clientHeight];
  }

  click(event, hits) {
    const box = this.canvas.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    if (this.onPoint) {
      const point = pointAt(this, at, hits);
      if (point) this.onPoint(point);
      return;
    }
    const loop = loopAt(this, at, hits);
    if (loop !== null && this.onLoop) return this.onLoop(loop);
    const t = timeAt(this, at, 2 * hits);
    if (t !== null && this.onTime) this.onTime(t);
  }
}
