"""Line drawings as SVG without matplotlib, whose import and layout take twenty times as long as a small answer.

Lengths are in tenths of a point, whole numbers, which keeps the text short. Colours are the page's own: `graph` is
`var(--graph)` of its style sheet.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vislam.core.messages import Array
from vislam.runs.report.html import day_colors, escape

_LEFT, _RIGHT, _TOP, _BOTTOM = 480, 70, 70, 360
_FONT = 85
_LETTER = 47  # about as wide as one is
_TICKS = 6  # along an axis, about
_MARGIN = 0.04  # of the range, beside what is drawn

Kind = Literal["solid", "dashed", "filled"]  # filled: the area within


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Polylines [N, P, 2] that look alike; where all points of one are the same it is a dot."""

    points: Array
    color: str
    width_pt: float
    opacity: float = 1.0
    label: str = ""  # in the legend
    kind: Kind = "solid"


@dataclass(frozen=True, slots=True)
class Axis:
    """What an axis is called and how it counts."""

    label: str  # of x, "": no numbers at its ticks either
    log: bool = False
    whole: bool = False  # ticks at whole numbers only
    ends: tuple[float, float] | None = None  # None: as far as the lines go; what lies beyond is drawn at the edge
    names: tuple[str, ...] = ()  # of 0, 1, 2, ..., in place of ticks


def drawing(
    lines: Sequence[Lines], x: Axis, y: Axis, *, height_pt: float, width_pt: float = 396.0, same_scale: bool = False
) -> str:
    """Return an SVG element without a size of its own; `same_scale`: a metre is as long along both axes."""
    width, height = round(10 * width_pt), round(10 * height_pt)
    legend, rows = _legend(lines, width)
    top = _TOP + 130 * rows
    left, right = max(_LEFT, 60 + _LETTER * max(map(len, y.names), default=0)), width - _RIGHT
    bottom = height - (_BOTTOM if x.label else _TOP)
    shown = [(group, _scaled(group.points, x, y)) for group in lines if len(group.points)]
    low, high = _range(shown)
    for k, axis in enumerate((x, y)):
        if axis.ends is not None:
            low[k], high[k] = axis.ends
    room = np.array([right - left, bottom - top], dtype=np.float64)
    if same_scale:
        span = room * ((high - low) / room).max()
        low, high = (low + high - span) / 2, (low + high + span) / 2
    frame = _frame(x, y, (low, high), (left, right, top, bottom))
    origin, scale = np.array([left, bottom]), np.array([1.0, -1.0]) * room / (high - low)
    corners = np.array([[left, top], [right, bottom]])
    paths = "".join(_path(group, np.clip(origin + (points - low) * scale, *corners)) for group, points in shown)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="var(--font)" '
        f'font-size="{_FONT}" fill="none" stroke-linecap="round" stroke-linejoin="round">{frame}{paths}{legend}</svg>'
    )


def stacked(drawings: Sequence[str]) -> str:
    """Return drawings of one width below each other, as one."""
    width, at, out = "", 0, ""
    for text in drawings:
        head, _, inner = text.removesuffix("</svg>").partition(">")
        width, height = head.partition('viewBox="0 0 ')[2].partition('"')[0].split()
        out += f'<g transform="translate(0 {at})">{inner}</g>'
        at += int(height)
    return f"{head.replace(f'{width} {height}', f'{width} {at}')}>{out}</svg>"


def as_file(text: str) -> str:
    """Return a drawing as it looks by day, outside of the page."""
    for name, value in day_colors().items():
        text = text.replace(f"var(--{name})", value)
    return text.replace("var(--font)", "sans-serif")


def _legend(lines: Sequence[Lines], width: int) -> tuple[str, int]:
    """Return a sample of all lines that have a label, with it, and how many rows that takes."""
    at, row, out = _LEFT, 0, ""
    for group in lines:
        if not (group.label and len(group.points)):
            continue
        wide = 330 + _LETTER * len(group.label)
        if at > _LEFT and at + wide > width:
            at, row = _LEFT, row + 1
        along, up = np.ptp(group.points[0], axis=0) != 0.0  # a line, a stroke or a dot
        middle, half = np.array([at + 80, 70 + 120 * row]), np.array([80 * along, 40 * (up and not along)])
        sample = replace(group, width_pt=max(group.width_pt, 1.0), opacity=1.0)
        out += _path(sample, np.array([[middle - half, middle + half]]))
        out += f'<text x="{at + 200}" y="{middle[1] + 30}" fill="var(--ink)">{escape(group.label)}</text>'
        at += wide
    return out, row + bool(out)


def _scaled(points: Array, x: Axis, y: Axis) -> Array:
    """Return polylines, logarithms where an axis counts so, without those of which nothing is finite."""
    out = points.astype(np.float64)
    for k, axis in enumerate((x, y)):
        if axis.log:
            with np.errstate(divide="ignore", invalid="ignore"):
                out[..., k] = np.log10(out[..., k])
    out[~np.isfinite(out).all(axis=2)] = np.nan
    return out[np.isfinite(out).any(axis=(1, 2))]


def _range(shown: Sequence[tuple[Lines, Array]]) -> tuple[Array, Array]:
    """Return the least and the greatest coordinates [2] that are drawn, with a margin."""
    corners = [f(points, axis=(0, 1)) for _, points in shown if len(points) for f in (np.nanmin, np.nanmax)]
    if not corners:
        return np.zeros(2), np.ones(2)
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    span = np.where(high - low > 1e-9 * np.maximum(1.0, np.abs(high)), high - low, np.maximum(1.0, np.abs(high)) * 0.02)
    return (low + high - span) / 2 - _MARGIN * span, (low + high + span) / 2 + _MARGIN * span


def _path(group: Lines, at: Array) -> str:
    """Return one path of all polylines, broken where `at` [N, P, 2], in tenths of a point, is not finite."""
    whole = np.rint(at)
    if np.isfinite(whole).all():
        lines = whole.astype(np.int64).tolist()
    else:
        lines = [piece.astype(np.int64).tolist() for line in whole for piece in _pieces(line)]
    steps = "".join("M" + "L".join(f"{a} {b}" for a, b in line) for line in lines)
    if group.kind == "filled":
        return f'<path d="{steps}" fill="var(--{group.color})" opacity="{group.opacity:g}"/>'
    dashes = ' stroke-dasharray="40 30" stroke-linecap="butt"' if group.kind == "dashed" else ""
    return (
        f'<path d="{steps}" stroke="var(--{group.color})" stroke-width="{10 * group.width_pt:g}" '
        f'opacity="{group.opacity:g}"{dashes}/>'
    )


def _pieces(line: Array) -> list[Array]:
    """Return the parts of a polyline [P, 2] between points that are not finite."""
    finite = np.isfinite(line).all(axis=1)
    parts = np.split(line, np.flatnonzero(np.diff(finite)) + 1)
    return [part for part in parts if len(part) > 1 and np.isfinite(part[0]).all()]


def _frame(x: Axis, y: Axis, ends: tuple[Array, Array], sides: tuple[int, int, int, int]) -> str:
    """Return grid, ticks and labels; sides: left, right, top, bottom."""
    left, right, top, bottom = sides
    low, high = ends
    grid, words = "", ""
    for value, text in _ticks(float(low[0]), float(high[0]), x):
        at = round(left + (value - low[0]) / (high[0] - low[0]) * (right - left))
        grid += f"M{at} {top}V{bottom}"
        words += f'<text x="{at}" y="{bottom + 115}" text-anchor="middle">{text}</text>' if x.label else ""
    for value, text in _ticks(float(low[1]), float(high[1]), y):
        at = round(bottom - (value - low[1]) / (high[1] - low[1]) * (bottom - top))
        grid += "" if y.names else f"M{left} {at}H{right}"
        words += f'<text x="{left - 40}" y="{at + 30}" text-anchor="end">{text}</text>'
    if x.label:
        words += f'<text x="{(left + right) // 2}" y="{bottom + 300}" text-anchor="middle">{x.label}</text>'
    if y.label:
        words += (
            f'<text transform="translate(90 {(top + bottom) // 2}) rotate(-90)" text-anchor="middle">{y.label}</text>'
        )
    return (
        f'<path d="{grid}" stroke="var(--line)" stroke-width="5"/>'
        f'<path d="M{left} {top}V{bottom}H{right}" stroke="var(--line)" stroke-width="8"/>'
        f'<g fill="var(--muted)">{words}</g>'
    )


def _ticks(low: float, high: float, axis: Axis) -> list[tuple[float, str]]:
    """Return where ticks stand, in the numbers that are drawn, and what is written there."""
    if axis.names:
        return [(float(k), escape(name)) for k, name in enumerate(axis.names)]
    if axis.log and high - low > 1.0:
        every = max(1, math.ceil((high - low) / _TICKS))
        return [(float(k), f"{10.0**k:g}") for k in range(math.ceil(low), math.floor(high) + 1) if k % every == 0]
    if axis.log:
        return [(math.log10(v), f"{v:.6g}") for v in _round_values(10.0**low, 10.0**high) if v > 0.0]
    return [(v, f"{v:.6g}") for v in _round_values(low, high, 1.0 if axis.whole else 0.0)]


def _round_values(low: float, high: float, least_step: float = 0.0) -> list[float]:
    """Return multiples of 1, 2 or 5 times a power of ten between two numbers."""
    rough = max((high - low) / _TICKS, 1e-300)
    power = 10.0 ** math.floor(math.log10(rough))
    step = max(next(power * m for m in (1, 2, 5, 10) if power * m >= rough * 0.999), least_step)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
