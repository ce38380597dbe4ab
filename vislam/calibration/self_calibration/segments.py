"""Stretches of a recording in which the same points are followed: what one camera saw of each, as dense tables.

Stretches share the lens and nothing else: each has points, poses and a scale of its own. So one that fails is left
out, and leaving out one at a time shows how far they contradict each other.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.messages import Array, Bools, Frame
from vislam.frontend.tracker import Tracker

_SPACING = 0.045  # of the image's width that tracks have moved at the next keyframe
_ALIVE = 0.6  # share of tracks below which there is a keyframe in any case
_LONGEST_S = 1.0  # between keyframes: longer, and inertial dead reckoning adds nothing
_LINKED = 30  # tracks that keyframes must share to stand in one stretch
_KEYFRAMES = 20  # of a stretch
LEAST_KEYFRAMES = 6
_LEAST_SEEN = 3  # keyframes that must have seen a point
_MOST_POINTS = 450  # of a stretch: those seen longest


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """What n keyframes saw of m points; NaN where a point was not seen."""

    t_ns: NDArray[np.int64]  # [n]
    pixels: Array  # [n, m, 2]
    flow_px_s: Array  # [n, m, 2], from the frames before and after
    velocity_px_s: Array  # [n, m, 2], the same, or what is made of it

    def of(self, keyframes: Bools) -> Segment:
        """Return the stretch without the other keyframes."""
        return Segment(
            self.t_ns[keyframes], self.pixels[keyframes], self.flow_px_s[keyframes], self.velocity_px_s[keyframes]
        )


@dataclass(slots=True)
class _Keyframe:
    t_ns: int
    ids: NDArray[np.int64]
    pixels: Array  # [N, 2]
    velocity: Array  # [N, 2] px/s


@dataclass(slots=True)
class _Follower:
    """Follows corners through the frames and keeps what keyframes saw."""

    tracker: Tracker
    spacing_px: float
    keyframes: list[_Keyframe] = field(default_factory=list)
    _begun: int = 0
    _last: tuple[int, Array] | None = None  # time of the last frame and where tracks were [N, 2]
    _before: tuple[int, Array] | None = None  # of the frame before the keyframe, NaN for new tracks

    def take(self, frame: Frame) -> None:
        """Follow into one frame, and make it a keyframe if it is time."""
        if self._last is None:
            self._begin(frame, np.zeros(0, dtype=np.bool_), np.empty((0, 2)))
            return
        pixels = self.tracker.follow(frame, self._last[1])
        if self._before is not None:
            self._set_velocity(frame.t_ns, pixels)
        seen = np.asarray(np.isfinite(pixels).all(axis=1))
        alive = self.tracker.judge(seen)
        pixels, seen = pixels[alive], seen[alive]
        last = np.where(seen[:, None], pixels, self._last[1][alive])
        moved = np.linalg.norm(pixels - self.tracker.pixels, axis=1)[seen]
        since_s = (frame.t_ns - self.keyframes[-1].t_ns) * 1e-9
        if (
            len(moved) < max(_ALIVE * self._begun, _LINKED)
            or float(np.median(moved)) > self.spacing_px
            or since_s > _LONGEST_S
        ):
            earlier = self._last[1][alive]
            self._before = (self._last[0], earlier[seen])
            self._begin(frame, seen, pixels)
            return
        self._last = frame.t_ns, last

    def _begin(self, frame: Frame, kept: NDArray[np.bool_], pixels: Array) -> None:
        fresh = self.tracker.begin(frame, kept, pixels)
        here = self.tracker.pixels.copy()
        before_ns, before = self._before or (frame.t_ns, np.empty((0, 2)))
        self._before = before_ns, np.vstack([before, np.full((fresh, 2), np.nan)])
        self.keyframes.append(_Keyframe(frame.t_ns, self.tracker.ids.copy(), here, np.full_like(here, np.nan)))
        self._last, self._begun = (frame.t_ns, here.copy()), len(here)

    def _set_velocity(self, t_ns: int, after: Array) -> None:
        """Set the velocities of the newest keyframe's tracks, now that the frame after it is known."""
        key = self.keyframes[-1]
        before_ns, before = self._before or (key.t_ns, np.empty((0, 2)))
        ways = [((t_ns - before_ns), after - before), (t_ns - key.t_ns, after - key.pixels)]
        ways.append((key.t_ns - before_ns, key.pixels - before))
        for dt_ns, moved in ways:
            unknown = ~np.isfinite(key.velocity).all(axis=1)
            if dt_ns > 0:
                key.velocity[unknown] = moved[unknown] / (dt_ns * 1e-9)
        self._before = None


def follow_segments(frames: Iterable[Frame], width_px: int, most: int) -> list[Segment]:
    """Return the stretches of a recording, at most `most`, spread evenly over it."""
    config = replace(FrontEndConfig(), max_tracks=300)
    follower = _Follower(Tracker(config), _SPACING * width_px)
    for frame in frames:
        follower.take(frame)
    groups = _groups(follower.keyframes)
    segments = [found for group in groups if (found := _segment(group)) is not None]
    if len(segments) > most:
        segments = [segments[i] for i in np.linspace(0, len(segments) - 1, most).round().astype(int).tolist()]
    return segments


def _groups(keyframes: list[_Keyframe]) -> list[list[_Keyframe]]:
    """Cut keyframes where too few tracks go on, and what is left into parts of nearly one length."""
    runs: list[list[_Keyframe]] = []
    for key in keyframes:
        linked = bool(runs) and len(np.intersect1d(runs[-1][-1].ids, key.ids)) >= _LINKED
        if linked:
            runs[-1].append(key)
        else:
            runs.append([key])
    out = []
    for run in runs:
        parts = max(round(len(run) / _KEYFRAMES), 1)
        edges = np.linspace(0, len(run), parts + 1).round().astype(int).tolist()
        out += [run[a:b] for a, b in itertools.pairwise(edges) if b - a >= LEAST_KEYFRAMES]
    return out


def _segment(group: list[_Keyframe]) -> Segment | None:
    """Return the table of what a group of keyframes saw; None when that is too little."""
    ids, counts = np.unique(np.concatenate([key.ids for key in group]), return_counts=True)
    order = np.argsort(-counts, kind="stable")[:_MOST_POINTS]
    chosen = np.sort(ids[order[counts[order] >= _LEAST_SEEN]])
    if len(chosen) < _LINKED:
        return None
    pixels = np.full((len(group), len(chosen), 2), np.nan)
    velocity = np.full_like(pixels, np.nan)
    for k, key in enumerate(group):
        _, here, there = np.intersect1d(chosen, key.ids, assume_unique=True, return_indices=True)
        moves = np.isfinite(key.velocity[there]).all(axis=1)  # one that is lost in the next frame is a bad one
        pixels[k, here[moves]] = key.pixels[there[moves]]
        velocity[k, here[moves]] = key.velocity[there[moves]]
    return Segment(np.array([key.t_ns for key in group], dtype=np.int64), pixels, velocity, velocity)
