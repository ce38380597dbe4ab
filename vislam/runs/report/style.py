"""How pictures look: inline SVG that follows the page's colours, light or dark."""

import hashlib
import io
import re
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from vislam.runs.report.html import day_colors

# matplotlib cannot write CSS variables: these colours stand for them and are replaced in the SVG
_VARIABLES = {
    "#010101": "var(--ink)",
    "#020202": "var(--muted)",
    "#030303": "var(--line)",
    "#040404": "var(--truth)",
    "#050505": "var(--paper)",
    "#060606": "var(--ekf)",
    "#070707": "var(--graph)",
    "#080808": "var(--live)",
    "#090909": "var(--good)",
    "#0a0a0a": "var(--bad)",
    "#0b0b0b": "var(--warn)",
    "#0c0c0c": "var(--batch)",
    "#0d0d0d": "var(--axis-x)",
    "#0e0e0e": "var(--axis-y)",
    "#0f0f0f": "var(--axis-z)",
}
CODE = {css[6:-1]: code for code, css in _VARIABLES.items()}
RC: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.edgecolor": CODE["line"],
    "axes.labelcolor": CODE["muted"],
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": CODE["line"],
    "grid.linewidth": 0.5,
    "xtick.color": CODE["line"],
    "ytick.color": CODE["line"],
    "xtick.labelcolor": CODE["muted"],
    "ytick.labelcolor": CODE["muted"],
    "text.color": CODE["ink"],
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 1.6,
    "lines.solid_capstyle": "round",
}


def light() -> tuple[dict[str, str], dict[str, Any]]:
    """Return the page's colours by name as they are by day, and the same settings as `RC` with them, for a PNG."""
    colors = {name: value for name, value in day_colors().items() if name in CODE}
    by_code = {CODE[name]: value for name, value in colors.items()}
    return colors, {key: by_code.get(value, value) if isinstance(value, str) else value for key, value in RC.items()}


def svg(figure: Figure, name: str) -> str:
    """Return the figure as an SVG element without a size of its own; the same figure gives the same bytes."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": f"vislam-{name}"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(
        r'\bid="(figure|axes|patch|line2d|text|matplotlib|xtick|ytick|legend|\w*Collection)_[\w.]*"', "", text
    )
    # matplotlib names clips after numbers that the layout's solver leaves different in their last bits
    for clip, shape in re.findall(r'<clipPath id="(\w+)">(.*?)</clipPath>', text, flags=re.DOTALL):
        text = text.replace(clip, f"p{hashlib.sha256(shape.encode()).hexdigest()[:10]}")
    for code, css in _VARIABLES.items():
        text = text.replace(code, css)
    return text.replace("'DejaVu Sans'", "var(--font)")
