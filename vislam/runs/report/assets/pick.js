// What lies at a place [x, y] of the screen, in pixels: a loop, a moment of the path, a point of the map.

/* global THREE */

// Index of the loop that is seen nearest to a place; null where none is as near as `hits`.
export function loopAt(view, [x, y], hits) {
  let best = [hits, null];
  for (const node of Object.values(view.loopNodes)) {
    if (!node.visible) continue;
    for (const k of node.userData.indices) {
      const e = view.data.loops.ends.subarray(6 * k, 6 * k + 6);
      const [a, b] = [view.project(e[0], e[1], e[2]), view.project(e[3], e[4], e[5])];
      if (!a || !b) continue;
      const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
      const share = Math.min(1, Math.max(0, ((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy || 1)));
      const away = Math.hypot(a[0] + share * dx - x, a[1] + share * dy - y);
      if (away < best[0]) best = [away, k];
    }
  }
  return best[1];
}

// Time of the best path's nearest pose.
export function timeAt(view, [x, y], hits) {
  const path = view.data.paths[view.data.best];
  if (!path.t) return null;
  let best = [hits, null];
  for (let k = 0; k < path.t.length; k++) {
    const p = view.project(path.xyz[3 * k], path.xyz[3 * k + 1], path.xyz[3 * k + 2]);
    const away = p ? Math.hypot(p[0] - x, p[1] - y) : Infinity;
    if (away < best[0]) best = [away, path.t[k]];
  }
  return best[1];
}

// The point of the map in front of all others that are as near as `hits`, else of the path.
export function pointAt(view, [x, y], hits) {
  const { camera, canvas, data } = view;
  camera.updateMatrixWorld();
  const m = camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse).elements;
  const shown = view.points && view.points.visible ? [data.cloud.position] : [];
  for (const xyz of [...shown, data.paths[data.best].xyz]) {
    let best = [Infinity, -1];
    for (let k = 0; k < xyz.length; k += 3) {
      const along = (row) => m[row] * xyz[k] + m[4 + row] * xyz[k + 1] + m[8 + row] * xyz[k + 2] + m[12 + row];
      const away = along(3);
      if (away < camera.near || away > best[0]) continue;
      const right = ((along(0) / away + 1) / 2) * canvas.clientWidth;
      const down = ((1 - along(1) / away) / 2) * canvas.clientHeight;
      if (Math.hypot(right - x, down - y) < hits) best = [away, k];
    }
    if (best[1] >= 0) return new THREE.Vector3().fromArray(xyz, best[1]);
  }
  return null;
}
