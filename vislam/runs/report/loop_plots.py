"""Drawings of how good loops are: precision over recall per stage, and the errors of the edges."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.files import write_text
from vislam.runs.report.drawing import Axis, Lines, as_file, drawing, stacked
from vislam.runs.report.html import escape

_STAGES = {  # their colours and what they are called
    "appearance": ("muted", "appearance"),
    "hindsight": ("truth", "in hindsight"),
    "normalised": ("bad", "normalised"),
    "temporal": ("warn", "+ temporal"),
    "geometry": ("live", "+ geometry"),
    "checks": ("ekf", "+ checks"),
    "graph": ("graph", "+ graph"),
}
_HEIGHT_PT = 300.0


def loop_quality(answer: Mapping[str, Any], of: str = "") -> tuple[str, str]:
    """Return two drawings of one evaluation, which belongs to what `of` names; raises KeyError or TypeError on damage.

    Precision over recall: a dot marks the recall at full precision, a bar above its interval. And which share of the
    edges in the graph has a smaller error, with the line beyond which it is gross.
    """
    curves = []
    for row, (name, (color, title)) in enumerate(_STAGES.items()):
        stage = answer["stages"].get(name)
        if stage is None or not stage["curve"]["recall"]:
            continue
        recall, precision = stage["curve"]["recall"], stage["curve"]["precision"]
        full, (low, high) = stage["recall_at_full_precision"], stage["interval"]
        curve = np.column_stack([[0.0, *recall], [precision[0], *precision]])
        curves += [
            Lines(curve[None], color, 1.5, label=f"{title}: {full:.2f} at 100 %"),
            Lines(np.array([[[full, 1.0], [full, 1.0]]]), color, 5.0),
        ]
        if low is not None and np.isfinite(low):
            height = 1.015 + 0.014 * row
            curves.append(Lines(np.array([[[low, height], [high, height]]]), color, 1.5, 0.6))
    x, y = Axis("recall of true revisits", ends=(0.0, 1.0)), Axis(f"precision{of}", ends=(0.0, 1.12))
    errors = np.maximum(np.array(answer["edges"]["errors_m"], dtype=np.float64), 1e-4)
    share = np.repeat(np.arange(len(errors)) + 1, 2) / max(len(errors), 1)
    gross_m = answer["rule"]["gross_m"]
    shares = [
        Lines(np.column_stack([np.repeat(errors, 2)[1:], share[:-1]])[None], "graph", 1.5),
        Lines(np.array([[[gross_m, 0.0], [gross_m, 1.0]]]), "bad", 0.9, label="gross", kind="dashed"),
    ]
    farthest_m = max(2.0, 1.5 * float(errors.max(initial=1.0)))
    of_edges = Axis("error of an accepted edge's translation [m]", log=True, ends=(-3.0, float(np.log10(farthest_m))))
    return (
        drawing(curves, x, y, height_pt=_HEIGHT_PT),
        drawing(shares, of_edges, Axis(f"share of the edges{of}", ends=(0.0, 1.02)), height_pt=_HEIGHT_PT),
    )


def write_loop_plot(path: Path, answers: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the drawings of evaluations, one below the other, as one SVG file; raises StorageError."""
    drawings = [one for name, answer in answers.items() for one in loop_quality(answer, f", {escape(name)}")]
    write_text(path, as_file(stacked(drawings)))
