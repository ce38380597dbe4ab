"""What the map process puts into the page's wire: keyframes, points and loops, left out without a reader."""

import time
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import VislamError, storage_failure
from vislam.core.memory import GraphRecord, LoopPlace, LoopState
from vislam.core.messages import Array, GraphUpdate, ImageU8, Keyframe, LoopCandidate, LoopDecision, LoopEdge
from vislam.live.web.updates import KeyframeCloud, LoopUpdate, MapUpdate, Save, Saved
from vislam.live.wire.mail import Outbox
from vislam.loop import INJECTED, is_injected
from vislam.mapping.formats.ply import write_ply
from vislam.mapping.mapper import Mapper
from vislam.pipeline.steps import KeyframeStep
from vislam.trajectory import Trajectory, write_tum

_MAP_S = 0.5  # between two words of the map
_SETTLE_S = 1.0  # that the end of the run may wait for the page
_CLOUD_POINTS = 2000  # of one keyframe
_STEP_M = 1e-3
_MOST_WAITING = 64  # clouds that wait for the page; further ones are left out
_VOXEL_M = 0.04
SAVED = ("saved/cloud.ply", "saved/trajectory.tum")  # in the run folder; the next time replaces them
_MAX_REASON = 200
_Ends = tuple[int, int, bool]  # of an edge, and whether it was made up on purpose


class LoopShare:
    """Follows the verifier, and the graph, which has the last word about what the verifier let through."""

    def __init__(self) -> None:
        """Start empty."""
        self._edges: dict[_Ends, int] = {}
        self._ends: dict[int, _Ends] = {}  # by edge
        self._offered: dict[_Ends, list[LoopUpdate]] = {}
        self._counts: Counter[str] = Counter()
        self._changed: dict[tuple[int, int, str], LoopUpdate] = {}  # since `take_changed`

    def found(self, candidates: Iterable[LoopCandidate], edges: Iterable[LoopEdge]) -> None:
        """Take what the verifier made of candidates, and the edges of those that it offered to the graph.

        One pair of keyframes may be a candidate several times, as it is in the table: pending, then offered.
        """
        for edge in edges:
            ends = edge.from_id, edge.to_id, is_injected(edge.id)
            self._edges[ends], self._ends[edge.id] = edge.id, ends
        for c in candidates:
            loop = LoopUpdate(c.from_id, c.to_id, c.source, str(c.decision), c.reason)
            if c.decision is LoopDecision.ACCEPTED:
                self._offered.setdefault((c.from_id, c.to_id, c.source == INJECTED), []).append(loop)
            self._counts[loop.decision] += 1
            self._show(loop, loop.reason)

    def decided(self, states: Iterable[LoopState]) -> None:
        """Take what the graph decided."""
        for state in states:
            ends = self._ends.get(state.id)
            if ends is None or self._edges[ends] != state.id:
                continue  # of an earlier run, or replaced
            decision = "undone" if state.place is LoopPlace.UNDONE else str(state.decision)
            before = self._offered.get(ends, [])
            self._counts.subtract(loop.decision for loop in before)
            self._counts[decision] += len(before)
            self._offered[ends] = [replace(loop, decision=decision, id=state.id) for loop in before]
            for loop in self._offered[ends]:
                self._show(loop, f"{loop.reason}; {state.reason}")

    def take_changed(self) -> list[LoopUpdate]:
        """Return what changed since the last call."""
        changed, self._changed = self._changed, {}
        return [*changed.values()]

    @property
    def has_changed(self) -> bool:
        """Whether there is something to take."""
        return bool(self._changed)

    @property
    def counts(self) -> dict[str, int]:
        """How many candidates there are of each decision."""
        return {decision: count for decision, count in self._counts.items() if count}

    def _show(self, loop: LoopUpdate, reason: str) -> None:
        key = loop.from_id, loop.to_id, loop.source
        self._changed.pop(key, None)  # the newest stand last
        self._changed[key] = replace(loop, reason=reason[-_MAX_REASON:])


class MapShare:
    """Shows the page keyframes as the graph moves them, with their points, and loops; saves when it asks for that."""

    def __init__(self, web: Connection, out: Path) -> None:
        """Take the page's wire, to be used in this process only, and the run folder to save in."""
        self._box = Outbox(web, 1)
        self._asks, self._out = web, out
        self._path: dict[int, tuple[int, Array]] = {}  # time and pose of every keyframe
        self._answers: list[Saved] = []
        self._due_s = 0.0
        self._poses: dict[int, Array] = {}
        self._times: dict[int, int] = {}
        self._clouds: dict[int, KeyframeCloud] = {}
        self._loops = LoopShare()
        self._revision = self._left_out = 0

    def take(self, steps: list[KeyframeStep], mapper: Mapper | None) -> None:
        """Take what the back end did with keyframes, and hand it on when it is time."""
        if self._box.is_broken:
            return
        for step in steps:
            keyframe = step.odometry.packet.keyframe
            self._poses[keyframe.id] = step.update.T_map_odom @ step.odometry.T_odom_body
            self._times[keyframe.id] = keyframe.t_ns
            self.move(step.update)
            self._loops.found(step.candidates, step.edges)
            self._loops.decided(step.record.loops)
            for keyframe_id in sorted({keyframe.id, *step.scans}):
                self._add_cloud(keyframe_id, keyframe, mapper)
        for keyframe_id, T in self._poses.items() if steps else ():
            t_ns = self._times[keyframe_id] if keyframe_id in self._times else self._path.get(keyframe_id, (-1,))[0]
            self._path[keyframe_id] = (t_ns, T)
        self._answer(mapper)
        if time.monotonic() >= self._due_s:
            self.flush()

    def move(self, update: GraphUpdate) -> None:
        """Follow corrected poses."""
        self._revision = max(self._revision, update.revision)
        self._poses.update(zip(update.ids.tolist(), update.T_map_body, strict=True))

    def settle(self, update: GraphUpdate, record: GraphRecord) -> None:
        """Show the map as it is in the end."""
        self.move(update)
        self._loops.decided(record.loops)
        self.flush(_SETTLE_S)

    def flush(self, patience_s: float = 0.0) -> None:
        """Hand on what is new, if the page has taken what came before, or does so within `patience_s`."""
        if not (self._poses or self._loops.has_changed) or (len(self._box) and not patience_s):
            return
        loops, counts = self._loops.take_changed(), self._loops.counts
        update = MapUpdate(self._revision, self._poses, self._times, self._clouds, loops, counts, self._left_out)
        if self._box.put(update, patience_s):
            self._due_s = time.monotonic() + _MAP_S
            self._poses, self._times, self._clouds = {}, {}, {}

    def _add_cloud(self, keyframe_id: int, newest: Keyframe, mapper: Mapper | None) -> None:
        if len(self._clouds) >= _MOST_WAITING:
            self._left_out += 1
            return
        points, colors = _points(keyframe_id, newest, mapper)
        if len(points):
            self._clouds[keyframe_id] = quantised(keyframe_id, points, colors)

    def _answer(self, mapper: Mapper | None) -> None:
        """Do what the page asks for, and report the result to it."""
        is_asked = False
        with suppress(EOFError, OSError):
            while not self._box.is_broken and self._asks.poll():
                is_asked |= isinstance(self._asks.recv()[1], Save)  # once for all that came meanwhile
        if is_asked:
            self._answers = [self._saved(mapper)]
        if self._answers and self._box.put(self._answers[0]):
            self._answers.pop(0)

    def _saved(self, mapper: Mapper | None) -> Saved:
        """Write the map and the keyframes' poses as they are now; what goes wrong must not end the run."""
        cloud, trajectory = (self._out / name for name in SAVED)
        try:
            cloud.parent.mkdir(exist_ok=True)
            known = sorted((t_ns, i) for i, (t_ns, _) in self._path.items() if t_ns >= 0)
            T = np.array([self._path[i][1] for _, i in known]).reshape(-1, 4, 4)
            write_tum(Trajectory(np.array([t_ns for t_ns, _ in known], dtype=np.int64), T), trajectory)
            points = None if mapper is None else mapper.cloud()
            if points is None:
                return Saved(f"{SAVED[1]}: {len(known)} keyframes; there is no map to save")
            write_ply(cloud, points.points_m, points.colors)
        except (VislamError, OSError) as error:
            reason = storage_failure(error) if isinstance(error, OSError) else error
            return Saved(f"not saved: {reason or error}", is_well=False)
        return Saved(f"{SAVED[0]}: {len(points.points_m)} points; {SAVED[1]}: {len(known)} keyframes")


def quantised(keyframe_id: int, points_m: Array, colors: ImageU8) -> KeyframeCloud:
    """Return points [N, 3] with RGB [N, 3] for the page: at most `_CLOUD_POINTS`, in millimetres where that fits."""
    chosen = np.random.default_rng(keyframe_id).permutation(len(points_m))[:_CLOUD_POINTS]
    points = points_m[chosen].astype(np.float64)
    step = max(_STEP_M, float(np.abs(points).max()) / 32767.0)
    red, green, blue = colors[chosen].astype(np.uint16).T
    rgb = (red >> 3 << 11) | (green >> 2 << 5) | (blue >> 3)
    return KeyframeCloud(step, np.rint(points / step).astype(np.int16), rgb)


def _points(keyframe_id: int, newest: Keyframe, mapper: Mapper | None) -> tuple[Array, ImageU8]:
    """Return a keyframe's points in its body frame: from depth where it has that, else the newest's features."""
    if mapper is not None:
        cloud = mapper.keyframe_cloud(keyframe_id, _VOXEL_M)
        if len(cloud.points_m):
            return cloud.points_m.astype(np.float64), cloud.colors
    if keyframe_id != newest.id or newest.points_body_m is None:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(newest.points_body_m).all(axis=1))
    return newest.points_body_m[known], _feature_colors(newest, known)


def _feature_colors(keyframe: Keyframe, known: NDArray[np.bool_]) -> ImageU8:
    frame = keyframe.frame
    image = frame.color if frame.color is not None else frame.images[0] if frame.images else None
    pixels = np.rint(keyframe.keypoints_px[known]).astype(np.int64)
    if image is None:
        return np.full((len(pixels), 3), 128, np.uint8)
    columns, rows = np.clip(pixels, 0, [image.shape[1] - 1, image.shape[0] - 1]).T
    found = image[rows, columns]
    return found[:, ::-1] if found.ndim == 2 else np.repeat(found[:, None], 3, axis=1)
