"""Where a depth image lies against its colour image, and how late it is: ends of foregrounds against grey edges.

Where the foreground ends, depth jumps and the image nearly always has an edge. Along rows and columns, the gradient of
the image around every such end is summed; over many frames the sum peaks where depth lies in the image. Depth that is
late lies off by the speed of the image, so one search over offset and lag explains all frames, whose images move in
different ways. Neither focal length nor unit of depth have a part in it. Sensors make foregrounds too wide or too
narrow; ends on both sides are searched together, and what moves them apart is no offset.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImageF32, ImageU8

_REACH_PX = 24  # of a profile on either side
_OFFSETS_PX = np.arange(-16.0, 16.01, 0.25)
_LAGS_S = np.arange(-0.080, 0.0801, 0.004)
_MOST_WIDER_PX = 4  # by which a sensor may shift each end of a foreground
_JUMP = 0.07  # of depth: beyond slanted faces and a sensor's steps
_MOST_GAP_PX = 12  # of shadow between foreground and background
_FLAT_GREY = 200.0  # gradients of a profile that count as much as this sum (Sobel's gain of 8) are noise
_MOST_ENDS = 3000  # per image and direction
_SPEED_STEP_PX_S = 20.0
_FASTEST_PX_S = 1500.0
_RESAMPLED = 60
_LEAST_ENDS = 2000  # over all frames and per direction
_LEAST_FRAMES = 8
_LEAST_FALL = 0.1  # of what the peak stands out, to the worst lag
_SEED = 7


@dataclass(frozen=True, slots=True, eq=False)
class FrameEnds:
    """The ends of foregrounds in one depth image, as its colour image shows them."""

    scores: Array  # [2 directions, 2 sides, lags, offsets]: gradients there, summed
    count: Array  # [2] ends per direction
    speed_px_s: Array  # [2] median speed of the image at the ends


@dataclass(frozen=True, slots=True, eq=False)
class EdgeAlignment:
    """By how much depth lies right of and below what it belongs to, and how late; sigma by resampling the frames."""

    offset_px: Array  # [2]
    offset_sigma_px: Array  # [2]
    lag_s: float  # depth shows what was so long before its stamp
    lag_sigma_s: float  # infinite where the image hardly moves
    ends: int
    contrast: float  # of the peak against the mean of the search
    by_offset: Array  # [2, M] what was summed over its mean, at the lag found, for offsets of...
    tried_px: Array  # [M]
    by_lag: Array  # [L] the same at the best offsets, for lags of...
    tried_s: Array  # [L]


def frame_ends(depth_m: ImageF32, image: ImageU8, flow_px_s: ImageF32, delay_s: float) -> FrameEnds:
    """Compare one depth image with its colour image.

    Args:
        depth_m: [H, W], 0 where invalid.
        image: grey [H, W].
        flow_px_s: velocity [H, W, 2] of the colour image's contents.
        delay_s: stamp of the depth image minus that of the colour image.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    scores, count, speed = [], [], []
    for axis in (0, 1):
        gradient = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1 - axis, axis))
        turned = (depth_m, gradient, flow_px_s[..., axis])
        depth, slope, flow = turned if axis == 0 else tuple(np.ascontiguousarray(a.T) for a in turned)
        rows, columns, sides = _ends(depth)
        profiles = slope[rows[:, None], columns[:, None] + np.arange(-_REACH_PX, _REACH_PX + 1)].astype(np.float64)
        profiles /= profiles.sum(axis=1, keepdims=True) + _FLAT_GREY
        moved = flow[rows, columns - 2 * sides].astype(np.float64)  # of the foreground, to which the edge belongs
        scores.append([_score(profiles[sides == side], moved[sides == side], delay_s) for side in (1, -1)])
        count.append(len(rows))
        speed.append(float(np.median(np.abs(moved))) if len(moved) else 0.0)
    return FrameEnds(np.array(scores), np.array(count), np.array(speed))


def foreground_ends(depth_m: ImageF32) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the last pixels [N, 2] (right, down) of foregrounds in depth [H, W], and pixels [N, 2] inside of them."""
    ends, inside = [], []
    for axis in (0, 1):
        rows, columns, sides = _ends(depth_m if axis == 0 else np.ascontiguousarray(depth_m.T))
        order = (0, 1) if axis == 0 else (1, 0)
        ends.append(np.column_stack([columns, rows])[:, order])
        inside.append(np.column_stack([columns - 2 * sides, rows])[:, order])
    return np.vstack(ends).astype(np.int64), np.vstack(inside).astype(np.int64)


def _ends(depth_m: ImageF32) -> tuple[Array, Array, Array]:
    """Return row and column of the last pixel of foregrounds along rows, and on which side (+1: right) they end."""
    height, width = depth_m.shape
    valid = np.flatnonzero(depth_m > 0.0)
    depths = depth_m.ravel()[valid]
    ratio = depths[1:] / depths[:-1]
    ends, begins = (np.flatnonzero(far) for far in (ratio > 1.0 + _JUMP, ratio < 1.0 / (1.0 + _JUMP)))
    ends, begins = (at[valid[at + 1] - valid[at] <= _MOST_GAP_PX] for at in (ends, begins))
    ends, begins = (at[valid[at] // width == valid[at + 1] // width] for at in (ends, begins))
    rows, columns = np.divmod(np.concatenate([valid[ends], valid[begins + 1]]), width)
    sides = np.repeat(np.array([1, -1]), [len(ends), len(begins)])
    inside = (columns > _REACH_PX + 2) & (columns < width - _REACH_PX - 3) & (rows >= 2) & (rows < height - 2)
    rows, columns, sides = rows[inside], columns[inside], sides[inside]
    marks = np.zeros(depth_m.shape, dtype=np.int8)
    marks[rows, columns] = sides
    goes_on = np.ones(len(rows), dtype=np.bool_)  # two rows up and down: noise makes ends of single pixels
    for step in (-2, 2):
        goes_on &= np.any([marks[rows + step, columns + side] == sides for side in (-1, 0, 1)], axis=0)
    kept = np.flatnonzero(goes_on)
    kept = kept[:: max(1, -(-len(kept) // _MOST_ENDS))]
    return rows[kept], columns[kept], sides[kept]


def _score(profiles: Array, speed_px_s: Array, delay_s: float) -> Array:
    """Return the summed gradient [lags, offsets] at where the ends are in the image, were depth off and late so."""
    out = np.zeros((len(_LAGS_S), len(_OFFSETS_PX)))
    places = np.arange(-_REACH_PX, _REACH_PX + 1.0)
    steps = np.round(speed_px_s / _SPEED_STEP_PX_S).astype(np.int64)
    lags_s = delay_s - np.array(_LAGS_S)[:, None]
    for step in np.unique(steps):
        speed = step * _SPEED_STEP_PX_S
        if abs(speed) > _FASTEST_PX_S:
            continue
        summed = profiles[steps == step].sum(axis=0)
        mean = float(summed.mean())
        out += np.interp(-(_OFFSETS_PX + speed * lags_s), places, summed, left=mean, right=mean)
    return out


def align_edges(frames: Sequence[FrameEnds]) -> EdgeAlignment | None:
    """Return offset and lag that explain all frames; None where there are too few ends of foregrounds."""
    if len(frames) < _LEAST_FRAMES:
        return None
    count = np.sum([frame.count for frame in frames], axis=0)
    if count.min() < _LEAST_ENDS:
        return None
    scores = np.array([frame.scores for frame in frames])
    generator = np.random.default_rng(_SEED)
    weights = generator.multinomial(len(frames), np.full(len(frames), 1.0 / len(frames)), size=_RESAMPLED)
    again = np.array([_peak(np.tensordot(weight, scores, axes=1))[0] for weight in weights])
    summed = scores.sum(axis=0)
    found, by_offset, by_lag = _peak(summed)
    means = summed.mean(axis=(-1, -2)).sum(axis=1)
    by_offset, by_lag = by_offset / means[:, None], by_lag / means.sum()
    contrast = float(by_lag.max())
    is_found = (
        contrast - float(by_lag.min()) > _LEAST_FALL * (contrast - 1.0) and 0 < int(by_lag.argmax()) < len(by_lag) - 1
    )
    step = np.array([_OFFSETS_PX[1] - _OFFSETS_PX[0]] * 2 + [_LAGS_S[1] - _LAGS_S[0]])
    sigma = np.hypot(again.std(axis=0), step / np.sqrt(12.0))
    if not is_found:  # the image hardly moves: any lag would do
        found[2], sigma[2] = 0.0, np.inf
    return EdgeAlignment(
        found[:2], sigma[:2], float(found[2]), float(sigma[2]), int(count.sum()), contrast, by_offset, _OFFSETS_PX,
        by_lag, _LAGS_S,
    )  # fmt: skip


def _peak(scores: Array) -> tuple[Array, Array, Array]:
    """Return offset right and down and lag [3] of the highest of summed scores [2, 2, lags, offsets].

    Also the scores [2, offsets] at that lag, and [lags] at the best offsets.
    """
    per_step = round(1.0 / (_OFFSETS_PX[1] - _OFFSETS_PX[0]))
    best = np.full((2, len(_LAGS_S), len(_OFFSETS_PX)), -np.inf)
    for wider in range(-_MOST_WIDER_PX * per_step, _MOST_WIDER_PX * per_step + 1):
        # ends right of a foreground lie at offset + wider, those left of it at offset - wider
        both = np.roll(scores[:, 0], -wider, axis=-1) + np.roll(scores[:, 1], wider, axis=-1)
        rim = abs(wider)
        both[..., :rim] = -np.inf
        both[..., len(_OFFSETS_PX) - rim :] = -np.inf
        best = np.maximum(best, both)
    along = best.max(axis=-1).sum(axis=0)  # by lag, which both directions share
    at = int(along.argmax())
    lag_s = _summit(_LAGS_S, along, at)
    offsets = [_summit(_OFFSETS_PX, best[axis, at], int(best[axis, at].argmax())) for axis in (0, 1)]
    return np.array([*offsets, lag_s]), best[:, at], along


def _summit(places: Array, values: Array, at: int) -> float:
    """Return where a parabola through the highest of equally spaced values and its neighbours has its summit."""
    if at in (0, len(values) - 1) or not np.isfinite(values[at - 1 : at + 2]).all():
        return float(places[at])
    left, middle, right = values[at - 1 : at + 2]
    curve = left - 2.0 * middle + right
    return float(places[at] + (0.0 if curve >= 0.0 else 0.5 * (left - right) / curve * (places[1] - places[0])))
