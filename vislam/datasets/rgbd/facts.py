"""What colour and depth of a recording say of one another, with sigmas: measured, not yet judged."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Rig
from vislam.core.messages import Array, Bools, ImageF32
from vislam.core.progress import Progress, silent
from vislam.datasets.images import NO_DEPTH, UnreadableImageError, read_raw_depth
from vislam.datasets.loaders import FrameTable
from vislam.datasets.rgbd.pair_tracks import PairTracks, Walk, walk
from vislam.datasets.stream import Survey, open_loader
from vislam.vision.depth_edges import EdgeAlignment, align_edges
from vislam.vision.depth_focal import FocalFit, SeenPoints, fit_focal

_HISTOGRAMS = 24  # depth images whose numbers are counted
_LEAST_SHARE = 0.005  # of the pixels: a wall never fills as many with one number that has no neighbours
_NEAR = 0.15  # numbers that differ by less are neighbours: a surface has them as often
_STANDS_OUT = 30.0  # over any of its neighbours
_LEAST_OTHERS = 0.1  # of the pixels: with fewer, one flat face is all that there is
_OFTEN = 0.5  # of the images: a face that is looked at stays for some only
_REACH_PX = 4  # of the neighbourhood that must be flat
_FLAT = 0.12  # of the inverse depth
_SLOPE_PX = 3.0
_UNKNOWN_OFFSET_PX, _UNKNOWN_LAG_S = 3.0, 0.02  # without ends of foregrounds


@dataclass(frozen=True, slots=True)
class OddValue:
    """A number in raw depth images that is no depth."""

    value: int
    share: float  # of all pixels
    is_known: bool  # read as "nothing measured" already


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFacts:
    """What was measured; None where the recording does not show it."""

    odd_values: tuple[OddValue, ...]
    median_depth_m: float  # NaN without any
    edges: EdgeAlignment | None
    focal: FocalFit | None
    frames: int  # that were looked at
    depth_rows: frozenset[int] = frozenset()  # of the depth images that were read

    @property
    def offset_px(self) -> Array:
        """Place [2] of depth against colour: of the edges, with what the tracks add."""
        edges = np.zeros(2) if self.edges is None else self.edges.offset_px
        return edges if self.focal is None else np.asarray(edges + self.focal.offset_px)

    @property
    def lag_s(self) -> float:
        """How long before its stamp a depth image shows the scene: of the edges, with what the tracks add."""
        edges = 0.0 if self.edges is None else self.edges.lag_s
        return edges if self.focal is None else edges + self.focal.lag_s


def rgbd_facts(found: Survey, rig: Rig, frames: FrameTable, progress: Progress = silent) -> RgbdFacts:
    """Measure a recording with depth; raises DataError when an image is not of the calibrated size."""
    odd, median_m = _numbers(found, rig)
    given = found.depth_format
    unknown = tuple(one.value for one in odd if not one.is_known)
    found = replace(found, depth_format=replace(given, invalid=(*given.invalid, *unknown)))
    seen = walk(found, rig, frames, progress)
    edges = align_edges(seen.ends)
    focal = _focal(found, rig, frames, seen, edges)
    return RgbdFacts(odd, median_m, edges, focal, seen.frames, seen.depth_rows)


def _numbers(found: Survey, rig: Rig) -> tuple[tuple[OddValue, ...], float]:
    """Return numbers that are no depth, and the median of depth in metres, NaN without any."""
    counts, images = np.zeros((2, NO_DEPTH + 1), dtype=np.int64)
    read = 0
    depth = found.depth
    if depth is None or found.streams is not None or not depth.files:
        return (), float("nan")
    for i in np.unique(np.linspace(0, len(depth.files) - 1, _HISTOGRAMS).astype(int)):
        try:
            raw = read_raw_depth(depth.path(int(i)), found.depth_format.camera(rig.cameras[0]))
            one = np.bincount(raw.ravel(), minlength=NO_DEPTH + 1)
        except UnreadableImageError:
            continue
        counts, images, read = counts + one, images + (one > 0), read + 1
    odd = odd_values(counts, images >= _OFTEN * max(read, 1), found.depth_format.invalid)
    for value in {0, NO_DEPTH, *found.depth_format.invalid, *(one.value for one in odd)}:
        if 0 <= value <= NO_DEPTH:
            counts[value] = 0
    valid = int(counts.sum())
    if valid == 0:
        return odd, float("nan")
    median = int(np.searchsorted(np.cumsum(counts), 0.5 * valid))
    return odd, median / found.depth_format.units_per_m


def odd_values(counts: NDArray[np.int64], often: Bools, known: Sequence[int]) -> tuple[OddValue, ...]:
    """Return the numbers that cannot be depths: a lot of pixels, and nearly none at depths nearby.

    Args:
        counts: [65536] pixels with each number.
        often: [65536] whether it occurs in many of the images.
        known: numbers that mean "not measured" by the recording.
    """
    total, out = int(counts.sum()), list[OddValue]()
    for value in np.flatnonzero(counts).tolist():
        share = int(counts[value]) / total
        if value == 0:
            continue
        if value == NO_DEPTH or value in known:
            out.append(OddValue(value, share, True))
            continue
        if share < _LEAST_SHARE or not often[value] or counts[1:].sum() - counts[value] < _LEAST_OTHERS * total:
            continue
        near = counts[max(1, int(value * (1.0 - _NEAR))) : int(value * (1.0 + _NEAR)) + 1]
        if counts[value] > _STANDS_OUT * (np.sort(near)[-2] if len(near) > 1 else 0):
            out.append(OddValue(value, share, False))
    return tuple(out)


def _focal(found: Survey, rig: Rig, frames: FrameTable, seen: Walk, edges: EdgeAlignment | None) -> FocalFit | None:
    """Return what the tracks show where depth is read at the place and time that the edges show."""
    known = (np.zeros(2), np.full(2, _UNKNOWN_OFFSET_PX), 0.0, _UNKNOWN_LAG_S)
    if edges is not None:
        known = (edges.offset_px, edges.offset_sigma_px, edges.lag_s, edges.lag_sigma_s)
    offset_px, offset_sigma_px, lag_s, lag_sigma_s = known
    assert found.depth is not None
    wanted: dict[int, list[tuple[PairTracks, int]]] = {}
    for pair in seen.pairs:
        for side, frame in enumerate(pair.frames):
            wanted.setdefault(frame, []).append((pair, side))
    read: dict[tuple[int, int], SeenPoints] = {}
    with closing(open_loader(found, rig, frames, 1)) as loader:
        for frame in sorted(wanted):
            depth_m = loader.load(frame).depth_m
            if depth_m is None:
                continue
            delay_s = float(found.depth.t_ns[frames.depth_rows[frame]] - frames.t_ns[frame]) * 1e-9 - lag_s
            rho, low, high = _neighbourhoods(depth_m)
            for pair, side in wanted[frame]:
                places = pair.pixels[side] + offset_px + pair.speed_px_s[side] * delay_s
                values, slopes = _read(rho, low, high, places)
                read[id(pair), side] = SeenPoints(pair.pixels[side], pair.speed_px_s[side], values, slopes)
    both = [
        (read[id(pair), 0], read[id(pair), 1])
        for pair in seen.pairs if (id(pair), 0) in read and (id(pair), 1) in read
    ]  # fmt: skip
    return fit_focal(rig.cameras[0], both, offset_sigma_px, lag_sigma_s)


def _neighbourhoods(depth_m: ImageF32) -> tuple[ImageF32, ImageF32, ImageF32]:
    """Return inverse depth [H, W], NaN where invalid, and the lowest and highest around every pixel."""
    with np.errstate(divide="ignore"):
        rho = np.where(depth_m > 0.0, np.float32(1.0) / depth_m, np.float32(np.nan)).astype(np.float32)
    box = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), dtype=np.uint8)
    low = cv2.erode(np.where(np.isnan(rho), np.float32(1e9), rho), box)
    high = cv2.dilate(np.where(np.isnan(rho), np.float32(0.0), rho), box)
    return rho, np.asarray(low, dtype=np.float32), np.asarray(high, dtype=np.float32)


def _read(rho: ImageF32, low: ImageF32, high: ImageF32, pixels: Array) -> tuple[Array, Array]:
    """Return inverse depths [N] between pixels (planes are linear in 1/z) and their slopes [N, 2]; NaN where uneven."""
    value = _sampled(rho, pixels, cv2.INTER_LINEAR)
    lowest, highest = (_sampled(image, pixels, cv2.INTER_NEAREST) for image in (low, high))
    with np.errstate(invalid="ignore"):
        value[~(highest - lowest <= _FLAT * value)] = np.nan
    slope = np.empty((len(pixels), 2))
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = _SLOPE_PX
        ahead, behind = (_sampled(rho, pixels + sign * step, cv2.INTER_LINEAR) for sign in (1.0, -1.0))
        slope[:, axis] = (ahead - behind) / (2.0 * _SLOPE_PX)
    return value, slope


def _sampled(image: ImageF32, pixels: Array, how: int) -> Array:
    x, y = np.ascontiguousarray(pixels.T, dtype=np.float32)
    found = cv2.remap(image, x, y, how, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    return np.asarray(found, dtype=np.float64).ravel()
