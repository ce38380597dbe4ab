"""Line drawings as SVG without matplotlib, whose import and layout take twenty times as long as a small answer.

Lengths are in tenths of a point, whole numbers, which keeps the text short. Colours are the page's own: `graph` is
`var(--graph)` of its style sheet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.core.messages import Array

_WIDTH = 3960
_LEFT, _RIGHT, _TOP, _BOTTOM = 480, 70, 70, 360
_FONT = 85
_TICKS = 6  # along an axis, about
_MARGIN = 0.04  # of the range, beside what is drawn


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Polylines [N, P, 2] that look alike; where all points of one are the same it is a dot."""

    points: Array
    color: str
    width_pt: float
    opacity: float = 1.0


@dataclass(frozen=True, slots=True)
class Axis:
    """What an axis is called and how it counts."""

    label: str
    log: bool = False
    whole: bool = False  # ticks at whole numbers only


def drawing(lines: Sequence[Lines], x: Axis, y: Axis, *, height_pt: float, same_scale: bool = False) -> str:
    """Return an SVG element without a size of its own; `same_scale`: a metre is as long along both axes."""
    height = round(10 * height_pt)
    shown = [(group, _scaled(group.points, x, y)) for group in lines if len(group.points)]
    low, high = _range(shown)
    room = np.array([_WIDTH - _LEFT - _RIGHT, height - _TOP - _BOTTOM], dtype=np.float64)
    if same_scale:
        span = room * ((high - low) / room).max()
        low, high = (low + high - span) / 2, (low + high + span) / 2
    scale = room / (high - low)
    frame = _frame(x, y, (low, high), height)
    corner, sign = np.array([_LEFT, height - _BOTTOM]), np.array([1.0, -1.0])
    paths = "".join(_path(group, corner + sign * (points - low) * scale) for group, points in shown)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" font-family="var(--font)" '
        f'font-size="{_FONT}" fill="none" stroke-linecap="round" stroke-linejoin="round">{frame}{paths}</svg>'
    )


def _scaled(points: Array, x: Axis, y: Axis) -> Array:
    """Return the polylines whose coordinates are finite, logarithms where an axis counts so."""
    out = points.astype(np.float64)
    for k, axis in enumerate((x, y)):
        if axis.log:
            with np.errstate(divide="ignore", invalid="ignore"):
                out[..., k] = np.log10(out[..., k])
    return out[np.isfinite(out).all(axis=(1, 2))]


def _range(shown: Sequence[tuple[Lines, Array]]) -> tuple[Array, Array]:
    """Return the least and the greatest coordinates [2] that are drawn, with a margin."""
    corners = [f(points, axis=(0, 1)) for _, points in shown if len(points) for f in (np.min, np.max)]
    if not corners:
        return np.zeros(2), np.ones(2)
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    span = np.where(high - low > 1e-9 * np.maximum(1.0, np.abs(high)), high - low, np.maximum(1.0, np.abs(high)) * 0.02)
    return (low + high - span) / 2 - _MARGIN * span, (low + high + span) / 2 + _MARGIN * span


def _path(group: Lines, at: Array) -> str:
    """Return one path of all polylines; `at` [N, P, 2] in tenths of a point."""
    whole = np.rint(at).astype(np.int64)
    steps = "".join("M" + "L".join(f"{a} {b}" for a, b in line) for line in whole.tolist())
    return (
        f'<path d="{steps}" stroke="var(--{group.color})" stroke-width="{10 * group.width_pt:g}" '
        f'opacity="{group.opacity:g}"/>'
    )


def _frame(x: Axis, y: Axis, ends: tuple[Array, Array], height: int) -> str:
    """Return grid, ticks and labels."""
    right, bottom = _WIDTH - _RIGHT, height - _BOTTOM
    low, high = ends
    grid, words = "", ""
    for value, text in _ticks(float(low[0]), float(high[0]), x):
        at = round(_LEFT + (value - low[0]) / (high[0] - low[0]) * (right - _LEFT))
        grid += f"M{at} {_TOP}V{bottom}"
        words += f'<text x="{at}" y="{bottom + 115}" text-anchor="middle">{text}</text>'
    for value, text in _ticks(float(low[1]), float(high[1]), y):
        at = round(bottom - (value - low[1]) / (high[1] - low[1]) * (bottom - _TOP))
        grid += f"M{_LEFT} {at}H{right}"
        words += f'<text x="{_LEFT - 40}" y="{at + 30}" text-anchor="end">{text}</text>'
    middle = (_TOP + bottom) // 2
    words += f'<text x="{(_LEFT + right) // 2}" y="{height - 60}" text-anchor="middle">{x.label}</text>'
    words += f'<text transform="translate(90 {middle}) rotate(-90)" text-anchor="middle">{y.label}</text>'
    return (
        f'<path d="{grid}" stroke="var(--line)" stroke-width="5"/>'
        f'<path d="M{_LEFT} {_TOP}V{bottom}H{right}" stroke="var(--line)" stroke-width="8"/>'
        f'<g fill="var(--muted)">{words}</g>'
    )


def _ticks(low: float, high: float, axis: Axis) -> list[tuple[float, str]]:
    """Return where ticks stand, in the numbers that are drawn, and what is written there."""
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
