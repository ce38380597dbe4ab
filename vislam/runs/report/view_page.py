"""The interactive part of a report: its elements, style and scripts, all inside the one file."""

import base64
import hashlib
import re
from typing import Any

from vislam.runs.report.html import escape
from vislam.runs.report.page_assets import assets
from vislam.runs.report.view_data import as_script

# each may use those before it
_MODULES = (
    "data.js", "shade.js", "shapes.js", "pick.js", "view.js", "tools.js", "layers.js", "plots.js", "details.js",
    "labels.js", "sort.js", "main.js",
)  # fmt: skip
_LIBRARIES = ("vendor/three.min.js", "vendor/uplot.min.js")


def view_style() -> str:
    """Return the style sheet of the view and of the plots' library."""
    return assets("vendor/uplot.min.css") + assets("view.css")


def view_elements(data: dict[str, Any]) -> str:
    """Return the elements of the view, which are seen only once its script runs; empty without data."""
    if not data:
        return ""
    cloud = data["cloud"]
    shown = f"{cloud['count']:,} of {cloud['of']:,} points".replace(",", "\u202f") if cloud else "no points"
    bands = "Green ticks are accepted loops; bands say that vision was degraded (yellow) or lost (red). "
    return (
        '<div class="view" id="view"><div class="stage">'
        '<div class="canvas"><div class="surface">'
        '<canvas id="view-canvas" aria-label="Map and trajectories in 3-D"></canvas></div>'
        '<div class="corner" id="view-tools"></div><div class="legend" id="view-layers"></div></div>'
        '<div class="time"><button type="button" id="view-play">Play</button>'
        '<input type="range" id="view-time" min="0" max="1" step="any" value="0" aria-label="Time">'
        '<output id="view-now"></output></div></div>'
        '<aside class="details" id="view-details"></aside>'
        '<div class="plots" id="view-plots"></div>'
        '<p class="note hint">Point at a curve: the body stands there. Drag to zoom, '
        '<button type="button" id="plots-whole">show all</button>. '
        f"{bands if data['has_camera'] else ''}Click a loop or a path in the map, "
        f"of which you see {escape(shown)}.</p></div>"
    )


def view_scripts(data: dict[str, Any]) -> tuple[str, str]:
    """Return the scripts, and the policy that lets these scripts run, no others, and nothing reach the network."""
    texts = [*(assets(name) for name in _LIBRARIES), _module()] if data else []
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii") for text in texts]
    allowed = " ".join(f"'sha256-{value}'" for value in hashes) or "'none'"
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}; base-uri 'none'"
    if not data:
        return "", policy
    carried = f'<script type="application/json" id="view-data">{as_script(data)}</script>'
    licences = "three.js and uPlot are under the MIT licence, their texts are in vislam/runs/report/assets/vendor."
    return carried + f"<!-- {licences} -->" + "".join(f"<script>{text}</script>" for text in texts), policy


def _module() -> str:
    """Return our modules as one script: what they import from each other stands before them."""
    texts = []
    for name in _MODULES:
        text = re.sub(r"^import .*?;\n", "", assets(name), flags=re.MULTILINE | re.DOTALL)
        texts.append(re.sub(r"^export ", "", text, flags=re.MULTILINE))
    return '(() => {\n"use strict";\n' + "".join(texts) + "})();\n"
