// The legend of the view: a box for each layer, which shows it or not.
import { element } from "./data.js";

export function layerButtons(view, parent) {
  for (const [name, layer] of view.layers) {
    const label = element("label", "layer");
    const box = element("input");
    box.type = "checkbox";
    box.checked = layer.node.visible;
    box.name = name;
    box.addEventListener("change", () => view.show(name, box.checked));
    const swatch = element("i", "swatch");
    swatch.style.background = `var(--${layer.swatch})`;
    label.append(box, swatch, element("span", "", layer.label));
    parent.append(label);
  }
}
