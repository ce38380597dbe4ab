// What things are: the labelled voxels of the map, a switch for all of them and, once they are seen, one per class.
import { element, shorts } from "./data.js";

/* global THREE */

export function addLabels(view, labels, parent) {
  if (!labels.count) return;
  const group = new THREE.Group();
  // three.js takes the size of points for that of a view of 90 degrees
  const size = labels.size / Math.tan((0.5 * view.camera.fov * Math.PI) / 180);
  const legend = element("div", "legend labels");
  legend.hidden = true;
  for (const one of labels.classes) {
    const xyz = shorts(one.xyz);
    const position = Float32Array.from(xyz, (value, k) => labels.low[k % 3] + labels.step[k % 3] * value);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
    const colour = `rgb(${one.color.map(Number).join(",")})`;
    const material = new THREE.PointsMaterial({ color: new THREE.Color(colour), size });
    const node = new THREE.Points(geometry, material);
    node.frustumCulled = false;
    group.add(node);
    const label = element("label", "layer");
    const box = element("input");
    box.type = "checkbox";
    box.checked = true;
    box.addEventListener("change", () => {
      node.visible = box.checked;
      view.ask();
    });
    const swatch = element("i", "swatch");
    swatch.style.background = colour;
    label.append(box, swatch, element("span", "", one.name));
    legend.append(label);
  }
  parent.append(legend);
  view.add("labels", group, "Labels", "muted", false);
  const show = view.show.bind(view);
  view.show = (name, visible) => {
    if (name === "labels") legend.hidden = !visible;
    show(name, visible);
  };
}
