// Lines and triangles of what stands in the map beside its points.

/* global THREE */

const ROUND = 24; // corners of a circle

// Two triangles for each step of a path and each of two directions across it; steps shorter than the width are joined.
export function bands(xyz, width) {
  const out = [];
  const [a, b, along, up, across] = Array.from({ length: 5 }, () => new THREE.Vector3());
  const least = width * width;
  a.set(xyz[0], xyz[1], xyz[2]);
  for (let k = 3; k < xyz.length; k += 3) {
    b.set(xyz[k], xyz[k + 1], xyz[k + 2]);
    along.copy(b).sub(a);
    if (!(along.lengthSq() >= least)) continue;
    up.set(0, 0, 1);
    if (Math.abs(along.z) > 0.9 * along.length()) up.set(1, 0, 0);
    across.copy(along).cross(up).normalize();
    up.copy(across).cross(along).normalize();
    for (const side of [across, up]) {
      const [x, y, z] = [side.x * width, side.y * width, side.z * width];
      const corners = [[a, 1], [a, -1], [b, 1], [b, 1], [a, -1], [b, -1]];
      for (const [p, s] of corners) out.push(p.x + s * x, p.y + s * y, p.z + s * z);
    }
    a.copy(b);
  }
  return new Float32Array(out);
}

// Along x of a body without a camera.
export function arrow(size) {
  const [tip, back, side] = [[size, 0, 0], 0.7 * size, 0.2 * size];
  return [0, 0, 0, ...tip, ...tip, back, side, 0, ...tip, back, -side, 0];
}

// What a camera sees that stands at T in the body.
export function pyramid(size, T) {
  const [w, h] = [0.62 * size, 0.46 * size];
  const place = (x, y, z) => [0, 1, 2].map((k) => T[k][0] * x + T[k][1] * y + T[k][2] * z + T[k][3]);
  const eye = place(0, 0, 0);
  const corners = [[-w, -h], [w, -h], [w, h], [-w, h]].map(([x, y]) => place(x, y, size));
  const segments = [];
  corners.forEach((corner, k) => segments.push(...eye, ...corner, ...corner, ...corners[(k + 1) % 4]));
  segments.push(...corners[0], ...place(0, -1.5 * h, size), ...place(0, -1.5 * h, size), ...corners[1]);
  return segments;
}

// Ellipsoids, each as its three principal ellipses: from centres, and half axes in columns of 3 x 3 numbers.
export function ellipsoids(centres, axes) {
  const out = new Float32Array((centres.length / 3) * 3 * ROUND * 6);
  let at = 0;
  for (let n = 0; n < centres.length / 3; n++) {
    for (let plane = 0; plane < 3; plane++) {
      for (let k = 0; k < 2 * ROUND; k++) {
        const angle = (2 * Math.PI * ((k + 1) >> 1)) / ROUND;
        for (let row = 0; row < 3; row++) {
          const [u, v] = [axes[9 * n + 3 * row + plane], axes[9 * n + 3 * row + ((plane + 1) % 3)]];
          out[at++] = centres[3 * n + row] + Math.cos(angle) * u + Math.sin(angle) * v;
        }
      }
    }
  }
  return out;
}
