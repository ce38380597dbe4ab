"""The last frames that an initialisation looks at, and what is cut out of them for a solver."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from vislam.core.camera import Camera
from vislam.core.geometry import invert, se3_adjoint, transform
from vislam.core.messages import Array, ImuSpan, NoiseScale, Observations, VoMeasurement
from vislam.frontend.result import scaled_motion
from vislam.frontend.start.closed_form import Tracks
from vislam.frontend.start.inertial_alignment import VisualMotion
from vislam.imu import join, preintegrate, shifted

_NS = 1_000_000_000
_MIN_SIGHTINGS = 3  # of a point; fewer hardly check one another
_MAX_BLIND_S = 1.0  # a gyroscope of unknown bias is off by degrees after more


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A frame in the window."""

    span: ImuSpan | None  # since the entry before; None for the very first
    vo: VoMeasurement
    observations: Observations | None
    T_vo_body: Array
    keyframe: int  # number of the frame that is its keyframe
    number: int
    still: bool  # by the image

    @property
    def t_ns(self) -> int:
        """Time of the frame."""
        return self.vo.t_ns


class FrameWindow:
    """Chains visual motions (without scale: rotations) to poses in the visual frame; keeps the newest entries."""

    def __init__(self) -> None:
        """Start empty."""
        self.entries: list[Entry] = []
        self._count = 0
        self._T_vo_keyframe = np.eye(4)
        self._keyframe_id: int | None = None
        self._keyframe_number = 0
        self._T_vo_body = np.eye(4)
        self._blind: ImuSpan | None = None  # since the newest entry, while vision is lost

    @property
    def seen_s(self) -> float:
        """Time from the first entry to the last."""
        return (self.entries[-1].t_ns - self.entries[0].t_ns) / _NS if self.entries else 0.0

    def append(self, span: ImuSpan | None, vo: VoMeasurement, observations: Observations | None, still: bool) -> None:
        """Take a frame whose motion is known. After a loss the chain goes on from the last good pose."""
        number = self._count
        if vo.keyframe_id != self._keyframe_id:  # the frame before became the keyframe
            self._T_vo_keyframe = self._T_vo_body
            self._keyframe_number = number if self._keyframe_id is None else number - 1  # the first is its own
            self._keyframe_id = vo.keyframe_id
        self._T_vo_body = self._T_vo_keyframe @ scaled_motion(vo)
        T = self._T_vo_body.copy()
        self.entries.append(Entry(span, vo, observations, T, self._keyframe_number, number, still))
        self._count += 1
        self._blind = None

    def bridge(self, span: ImuSpan, has_scale: bool) -> bool:
        """Take a frame without vision: without scale the gyroscope carries the rotation on, for a while.

        False, and nothing is taken, where there is nothing to go on from or it is too long ago.
        """
        spans = [span] if self._blind is None else [self._blind, span]
        if has_scale or not self.entries or int(spans[0].t_ns[0]) != self.entries[-1].t_ns:
            return False
        blind = join(spans)
        if int(blind.t_ns[-1]) - int(blind.t_ns[0]) > _MAX_BLIND_S * _NS:
            return False
        self._blind = blind
        self._T_vo_body = self._T_vo_body @ transform(preintegrate(span).dR, np.zeros(3))
        return True

    def since_newest(self, span: ImuSpan | None) -> ImuSpan | None:
        """Return the inertial data since the newest entry, given those since the frame before; None across a hole."""
        if span is None or not self.entries:
            return None
        whole = span if self._blind is None else join([self._blind, span])
        return whole if int(whole.t_ns[0]) == self.entries[-1].t_ns else None

    def clear(self) -> None:
        """Drop all entries; the chain of poses goes on."""
        self.entries, self._blind = [], None

    def trim(self, window_s: float) -> None:
        """Drop entries older than the window."""
        oldest_ns = self.entries[-1].t_ns - round(window_s * _NS)
        keep = 0
        while keep < len(self.entries) and self.entries[keep].t_ns < oldest_ns:
            keep += 1
        del self.entries[:keep]

    def restamp(self, shift_ns: int, cut: Callable[[int, int], ImuSpan | None]) -> None:
        """Shift all times and cut the spans again; at the ends, where inertial data do not reach, they are moved."""
        moved: list[Entry] = []
        for entry in self.entries:
            vo, span = replace(entry.vo, t_ns=entry.t_ns + shift_ns), entry.span
            if span is not None and moved:
                span = cut(moved[-1].t_ns, vo.t_ns) or shifted(span, shift_ns)
            moved.append(replace(entry, vo=vo, span=span if moved else None))
        self.entries = moved
        self._blind = None if self._blind is None else shifted(self._blind, shift_ns)

    def is_keyframe(self, i: int) -> bool:
        """Whether entry i is the keyframe of the next one."""
        number = self.entries[i].number
        return i + 1 < len(self.entries) and self.entries[i + 1].keyframe == number

    def choose_nodes(self, spacing_s: float, max_nodes: int) -> list[Entry]:
        """Return the entries that become unknowns: keyframes, the ends, and others at a spacing."""
        entries = self.entries
        spacing_ns = max(round(spacing_s * _NS), (entries[-1].t_ns - entries[0].t_ns) // max_nodes)
        chosen, last_ns = [], -(1 << 62)
        for i, entry in enumerate(entries):
            at_end = i == len(entries) - 1
            if at_end or self.is_keyframe(i) or entry.t_ns - last_ns >= spacing_ns - spacing_ns // 16:
                chosen.append(entry)
                last_ns = entry.t_ns
        return chosen

    def spans(self, chosen: list[Entry]) -> list[ImuSpan]:
        """Return the inertial spans between neighbours of the chosen entries."""
        first = self.entries[0].number
        spans = []
        for a, b in pairwise(chosen):
            between = self.entries[a.number - first + 1 : b.number - first + 1]
            spans.append(join([entry.span for entry in between if entry.span is not None]))
        newest = spans[-1].noise  # the oldest were cut before the samples showed theirs
        return [
            replace(span, noise=NoiseScale(max(span.noise.gyro, newest.gyro), max(span.noise.accel, newest.accel)))
            for span in spans
        ]


def metric_motions(chosen: list[Entry], inflation: float) -> list[VisualMotion]:
    """Return the visual motions among the nodes; if a keyframe is older than the window, from its first frame."""
    place = {entry.number: i for i, entry in enumerate(chosen)}
    start = chosen[0]
    motions = []
    for i, entry in enumerate(chosen[1:], start=1):
        T, covariance = entry.vo.T_keyframe_body, entry.vo.covariance
        assert T is not None and start.vo.T_keyframe_body is not None
        a = place.get(entry.keyframe)
        if a is None and entry.keyframe == start.keyframe:
            a = 0
            T = invert(start.vo.T_keyframe_body) @ T
            turned = se3_adjoint(invert(T))
            covariance = covariance + turned @ start.vo.covariance @ turned.T
        if a is not None and a != i:
            motions.append(VisualMotion(a, i, T, inflation**2 * covariance, True))
    return motions


def gather_tracks(chosen: list[Entry], camera: Camera, T_body_cam: Array, sigma_px: float, max_points: int) -> Tracks:
    """Return the points seen in most of the nodes, at most `max_points`, as bearings in those nodes."""
    ids, nodes, pixels = [], [], []
    for i, entry in enumerate(chosen):
        if entry.observations is not None:
            ids.append(entry.observations.track_ids)
            nodes.append(np.full(len(entry.observations.track_ids), i, dtype=np.int64))
            pixels.append(entry.observations.pixels_px)
    every_id = np.concatenate(ids) if ids else np.empty(0, dtype=np.int64)
    every_node = np.concatenate(nodes) if nodes else np.empty(0, dtype=np.int64)
    xy = camera.normalise(np.concatenate(pixels) if pixels else np.empty((0, 2)))
    good = np.isfinite(xy).all(axis=1)
    every_id, every_node, xy = every_id[good], every_node[good], xy[good]
    known, counts = np.unique(every_id, return_counts=True)
    ranked = np.argsort(-counts, kind="stable")[:max_points]
    kept = np.sort(known[ranked[counts[ranked] >= _MIN_SIGHTINGS]])
    inside = np.isin(every_id, kept)
    every_id, every_node, xy = every_id[inside], every_node[inside], xy[inside]
    order = np.lexsort((every_node, every_id))
    return Tracks(
        point=np.searchsorted(kept, every_id[order]).astype(np.int64),
        node=every_node[order],
        xy=np.ascontiguousarray(xy[order]),
        track_ids=kept,
        sigma_xy=sigma_px / camera.fx,
        R_body_cam=np.ascontiguousarray(T_body_cam[:3, :3]),
    )
