"""A walk over parts of an RGB-D recording: ends of foregrounds, and corners followed between pairs of frames."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Rig
from vislam.core.messages import Array, ImageF32, ImageU8
from vislam.core.progress import Progress, silent
from vislam.datasets.loaders import FrameTable
from vislam.datasets.stream import Survey, open_loader
from vislam.vision.depth_edges import FrameEnds, frame_ends
from vislam.vision.features import FlowSettings, detect_corners, follow

_BLOCK = 40  # frames in a row
_MOST_FRAMES = 480
_FLOW_EVERY = 4  # frames: one of this many has its depth read and its dense flow computed
_NEW_KEY_S = 0.25
_LONGEST_S = 1.0  # of a pair
_KEPT = 0.4  # of the corners of a first view: with fewer, the pair is finished
_CORNERS = 200
_CORNER_CELL_PX, _CORNER_DISTANCE_PX, _CORNER_QUALITY = 40, 8.0, 30.0
_LEAST_CORNERS = 30
_FLOW = FlowSettings(levels=4)  # frames may be far apart


@dataclass(frozen=True, slots=True, eq=False)
class PairTracks:
    """Corners in two frames of a recording, and how fast they move there."""

    frames: tuple[int, int]
    pixels: tuple[Array, Array]  # [N, 2]
    speed_px_s: tuple[Array, Array]  # [N, 2]


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """What a walk brought."""

    ends: tuple[FrameEnds, ...]
    pairs: tuple[PairTracks, ...]
    frames: int
    depth_rows: frozenset[int]  # that could be read


@dataclass(slots=True, eq=False)
class _Key:
    """A first view whose corners are still followed."""

    frame: int
    count: int
    begin: Array  # [N, 2]
    rows: NDArray[np.int64]  # [N] of its corners among all that are followed, rising
    speeds: list[Array] = field(default_factory=list)  # of the first two steps and the last two


@dataclass(slots=True, eq=False)
class _Block:
    """Frames in a row: the keys that are alive, and what is finished."""

    delay_s: Array  # [F] stamp of depth minus stamp of colour, NaN without depth
    t_ns: NDArray[np.int64]
    period_s: float
    keys: list[_Key] = field(default_factory=list)
    now: Array = field(default_factory=lambda: np.empty((0, 2)))  # corners in the frame before, each once for all keys
    before: tuple[int, ImageU8, ImageF32 | None] | None = None
    ends: list[FrameEnds] = field(default_factory=list)
    pairs: list[PairTracks] = field(default_factory=list)

    def see(self, frame: int, image: ImageU8, depth_m: ImageF32 | None, is_last: bool) -> None:
        """Take the next frame; without its depth, it is not compared with it."""
        has_depth = bool(np.isfinite(self.delay_s[frame]))
        if self.before is not None:
            self._compare(frame, image)
            self._follow(frame, image, has_depth, is_last)
        if has_depth and (not self.keys or (frame - self.keys[-1].frame) * self.period_s >= _NEW_KEY_S):
            free = _CORNERS - len(self.now)
            corners = detect_corners(image, free, _CORNER_CELL_PX, _CORNER_DISTANCE_PX, self.now, _CORNER_QUALITY)
            begin = np.vstack([self.now, corners])
            if len(begin) >= _LEAST_CORNERS:
                self.now = begin
                self.keys.append(_Key(frame, len(begin), begin, np.arange(len(begin))))
        self.before = (frame, image, depth_m)

    def _compare(self, frame: int, image: ImageU8) -> None:
        assert self.before is not None
        last, last_image, depth_m = self.before
        if depth_m is None:
            return
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(
            last_image, image, np.zeros((*image.shape, 2), np.float32)
        )
        dt_s = (self.t_ns[frame] - self.t_ns[last]) * 1e-9
        speed = np.asarray(flow, dtype=np.float32) / np.float32(dt_s)
        self.ends.append(frame_ends(depth_m, last_image, speed, float(self.delay_s[last])))

    def _follow(self, frame: int, image: ImageU8, has_depth: bool, is_last: bool) -> None:
        if not self.keys or self.before is None:
            return
        last, last_image, _ = self.before
        dt_s = (self.t_ns[frame] - self.t_ns[last]) * 1e-9
        there, _ = follow(last_image, image, self.now, self.now, _FLOW)
        speed, alive = (there - self.now) / dt_s, []
        is_seen = np.asarray(np.isfinite(there).all(axis=1))
        row = np.cumsum(is_seen) - 1
        for key in self.keys:
            seen = is_seen[key.rows]
            steps = [*key.speeds, speed[key.rows]]
            key.speeds = [one[seen] for one in (steps[:2] + steps[-2:] if len(steps) > 4 else steps)]
            now = there[key.rows[seen]]
            key.begin, key.rows = key.begin[seen], row[key.rows[seen]]
            long = (frame - key.frame) * self.period_s >= _LONGEST_S
            if len(now) < _LEAST_CORNERS:
                continue
            if has_depth and (is_last or long or len(now) < _KEPT * key.count):
                ends = (key.begin, now), (_at_end(*key.speeds[:2]), _at_end(*key.speeds[:-3:-1]))
                self.pairs.append(PairTracks((key.frame, frame), *ends))
            else:
                alive.append(key)
        self.keys, self.now = alive, there[is_seen] if alive else np.empty((0, 2))


def _at_end(step: Array, beside: Array | None = None) -> Array:
    """Return the speed at the outer end of a step, which has that of its middle; half a frame late, hands turn less."""
    return step if beside is None else 1.5 * step - 0.5 * beside


def walk(found: Survey, rig: Rig, frames: FrameTable, progress: Progress = silent) -> Walk:
    """Go over parts of a recording, evenly spread; raises DataError when an image is not of the calibrated size."""
    delays_s = np.full(len(frames.t_ns), np.nan)
    paired = frames.depth_rows >= 0
    if found.depth is not None:
        delays_s[paired] = (found.depth.t_ns[frames.depth_rows[paired]] - frames.t_ns[paired]) * 1e-9
    period_s = float(np.median(np.diff(frames.t_ns))) * 1e-9 if len(frames.t_ns) > 1 else 1.0
    ends: list[FrameEnds] = []
    pairs: list[PairTracks] = []
    read = set[int]()
    blocks = _blocks(len(frames.t_ns))
    compared = replace(frames, depth_rows=np.where(np.arange(len(paired)) % _FLOW_EVERY, -1, frames.depth_rows))
    with closing(open_loader(found, rig, compared, 1)) as loader:
        for block in blocks:
            part = _Block(delays_s, frames.t_ns, period_s)
            for i in block:
                loaded = loader.load(i)
                if loaded.images:
                    part.see(i, loaded.images[0], loaded.depth_m, i == block[-1])
                if loaded.depth_m is not None:
                    read.add(int(frames.depth_rows[i]))
                progress(i + 1, len(frames.t_ns), "colour and depth")
            ends += part.ends
            pairs += part.pairs
    return Walk(tuple(ends), tuple(pairs), sum(map(len, blocks)), frozenset(read))


def _blocks(count: int) -> list[range]:
    if count <= _MOST_FRAMES:
        return [range(begin, min(begin + _BLOCK, count)) for begin in range(0, count, _BLOCK)]
    begins = np.linspace(0, count - _BLOCK, _MOST_FRAMES // _BLOCK).astype(int)
    return [range(begin, begin + _BLOCK) for begin in begins.tolist()]
