"""Fetches the libraries that a report carries from the npm registry and writes them, minified, beside their licences.

    python docs/vendor_javascript.py

It needs npm; versions stand below, so that an update is a change that can be read. The same versions give the same
bytes. Nobody needs this to install or use vislam: what it writes is in the repository.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

VERSIONS = {"three": "0.187.0", "uplot": "1.6.32", "esbuild": "0.28.2"}
ASSETS = Path(__file__).resolve().parent.parent / "vislam" / "runs" / "report" / "assets" / "vendor"
ENTRIES = {  # global name: what is bundled, the rest is shaken off
    "THREE": (
        "export { BufferAttribute, BufferGeometry, Color, ColorManagement, DepthTexture, GridHelper, Group, Line, "
        "LineBasicMaterial, LineSegments, LinearSRGBColorSpace, Mesh, MeshBasicMaterial, PerspectiveCamera, Points, "
        "PointsMaterial, Scene, ShaderMaterial, SphereGeometry, Vector2, Vector3, WebGLRenderer, WebGLRenderTarget } "
        "from 'three';\n"
        "export { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';\n"
    ),
    "uPlot": "import uPlot from 'uplot';\nmodule.exports = uPlot;\n",
}


def main() -> None:
    """Write both libraries, their licences and versions.json."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        packages = [f"{name}@{version}" for name, version in VERSIONS.items()]
        subprocess.run(["npm", "install", "--silent", "--no-fund", "--no-audit", *packages], cwd=work, check=True)
        ASSETS.mkdir(parents=True, exist_ok=True)
        sizes = {}
        for name, entry in ENTRIES.items():
            package = name.lower()
            (work / f"{package}.js").write_text(entry)
            out = ASSETS / f"{package}.min.js"
            command = [
                "node_modules/.bin/esbuild", f"{package}.js", "--bundle", "--minify", "--format=iife",
                "--target=es2020", f"--global-name={name}", "--legal-comments=none",
                "--charset=ascii", f"--outfile={out}",
            ]  # fmt: skip
            subprocess.run(command, cwd=work, check=True, capture_output=True)
            (ASSETS / f"{package}.LICENSE").write_bytes((work / "node_modules" / package / "LICENSE").read_bytes())
            sizes[out.name] = {
                "version": VERSIONS[package],
                "bytes": out.stat().st_size,
                "sha256": hashlib.sha256(out.read_bytes()).hexdigest(),
            }
        css = (work / "node_modules" / "uplot" / "dist" / "uPlot.min.css").read_bytes()
        (ASSETS / "uplot.min.css").write_bytes(css)
        (ASSETS / "versions.json").write_text(json.dumps(sizes, indent=2) + "\n")
    json.dump(sizes, sys.stdout, indent=2)


if __name__ == "__main__":
    main()
