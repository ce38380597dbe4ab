"""What the map process puts into the page's wire: keyframes, points and loops, left out without a reader."""

from __future__ import annotations

import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import VislamError, storage_failure
from vislam.core.messages import Array, GraphUpdate, ImageU8, Keyframe
from vislam.live.web.updates import KeyframeCloud, LoopUpdate, MapUpdate, Save, Saved
from vislam.live.wire.mail import Outbox
from vislam.mapping.formats.ply import write_ply
from vislam.mapping.mapper import Mapper
from vislam.pipeline.steps import KeyframeStep
from vislam.trajectory import Trajectory, write_tum

_MAP_S = 0.5  # between two words of the map
_CLOUD_POINTS = 2000  # of one keyframe
_STEP_M = 1e-3
_MOST_WAITING = 64  # clouds that wait for the page; further ones are left out
_MOST_LOOPS = 1000  # that wait
_VOXEL_M = 0.04
_MAX_REASON = 200
SAVED = ("saved/cloud.ply", "saved/trajectory.tum")  # in the run folder; the next time replaces them


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
        self._loops: list[LoopUpdate] = []
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
            self._loops += [
                LoopUpdate(c.from_id, c.to_id, str(c.decision), c.reason[:_MAX_REASON]) for c in step.candidates
            ]
            self._loops = self._loops[-_MOST_LOOPS:]
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

    def flush(self) -> None:
        """Hand on what is new, if the page has taken what came before."""
        if not (self._poses or self._loops) or len(self._box):
            return
        update = MapUpdate(self._revision, self._poses, self._times, self._clouds, self._loops, self._left_out)
        if self._box.put(update):
            self._due_s = time.monotonic() + _MAP_S
            self._poses, self._times, self._clouds, self._loops = {}, {}, {}, []

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
