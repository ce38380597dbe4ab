// Draws a scene so that its depth is seen: what lies behind what is near it in the picture is darker there (eye-dome
// lighting, Boucheny 2009). Points without normals have edges and steps by it, whatever their colours.

/* global THREE */

const STRENGTH = 9; // of the shade, for each doubling of distance
const REACH_PX = 1.5; // from a pixel to those that it is compared with
const CORNERS = "void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }";
const SHADED = `
  uniform sampler2D picture, depth;
  uniform vec2 size, range;
  float far(vec2 at) {
    float z = texture2D(depth, at).r;
    return z == 1.0 ? 0.0 : log2(range.x * range.y / (range.y - z * (range.y - range.x)));
  }
  void main() {
    vec2 at = gl_FragCoord.xy / size, reach = float(${REACH_PX}) / size;
    vec4 seen = texture2D(picture, at);
    float shade = 0.0;
    if (texture2D(depth, at).r < 1.0) {
      float here = far(at);
      for (int k = 0; k < 4; k++) {
        vec2 by = reach * (k < 2 ? vec2(float(2 * k - 1), 0.0) : vec2(0.0, float(2 * k - 5)));
        if (texture2D(depth, at + by).r < 1.0) shade += min(max(here - far(at + by), 0.0), 0.1);
      }
    }
    gl_FragColor = vec4(seen.rgb * exp2(-${STRENGTH}.0 * 0.25 * shade), 1.0);
  }`;

export class Shade {
  constructor(renderer) {
    this.renderer = renderer;
    this.target = new THREE.WebGLRenderTarget(1, 1, { depthTexture: new THREE.DepthTexture(1, 1) });
    this.size = new THREE.Vector2();
    this.range = new THREE.Vector2();
    const uniforms = { size: this.size, range: this.range, picture: this.target.texture, depth: this.target.depthTexture };
    const material = new THREE.ShaderMaterial({
      uniforms: Object.fromEntries(Object.entries(uniforms).map(([name, value]) => [name, { value }])),
      vertexShader: CORNERS,
      fragmentShader: SHADED,
      depthTest: false,
    });
    const whole = new THREE.BufferGeometry();
    whole.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    this.sheet = new THREE.Mesh(whole, material);
    this.sheet.frustumCulled = false;
  }

  render(scene, camera) {
    this.renderer.getDrawingBufferSize(this.size);
    this.target.setSize(this.size.x, this.size.y);
    this.range.set(camera.near, camera.far);
    this.renderer.setRenderTarget(this.target);
    this.renderer.render(scene, camera);
    this.renderer.setRenderTarget(null);
    this.renderer.render(this.sheet, camera);
  }
}

// Points as discs, that close the same surface as squares of their size.
export function round(material) {
  material.size *= 2 / Math.sqrt(Math.PI);
  material.onBeforeCompile = (shader) => {
    const cut = "void main() { if (distance(gl_PointCoord, vec2(0.5)) > 0.5) discard;";
    shader.fragmentShader = shader.fragmentShader.replace("void main() {", cut);
  };
}
