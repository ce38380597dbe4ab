"""What browsers see of a run: the newest of everything, bounded, under one lock."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from vislam.core.files import plain
from vislam.core.messages import Array, Tracking
from vislam.hw.health import Health
from vislam.live.web.updates import FrameUpdate, KeyframeCloud, LoopUpdate, MapUpdate, Saved, Status, StepPicture
from vislam.live.wire.published_pose import PublishedPose
from vislam.runs.report.page_assets import floats, packed

MOST_POINTS = 200_000  # of the whole map
_FEWEST_EACH = 25
_MOST_KEYFRAMES = 8000
_MOST_PATH = 4000  # points of the pose's path
_MOST_LOOPS = 1000
_ANSWER_POINTS = 40_000  # of one answer: 0.4 MB; the page asks again at once
_PATH_STEP_M = 0.02
_MOST_FRAMES = 600  # that the plot of vision remembers: two minutes
_NS = 1e-9
_STATES = tuple(Tracking)


class Feed:
    """Takes updates of processes, and answers requests; both may be called from any thread."""

    def __init__(self) -> None:
        """Know nothing yet."""
        self._lock = threading.Lock()
        self._status: dict[str, Any] = {"phase": "starting"}
        self._zero_ns: int | None = None
        self._pose: PublishedPose | None = None
        self._path = _Path()
        self._map = _Keyframes()
        self._frame: FrameUpdate | None = None
        self._jpeg, self._pictures = b"", 0
        self._seen: deque[tuple[int, int, int]] = deque(maxlen=_MOST_FRAMES)  # time, inliers, state
        self._saved: deque[Saved] = deque(maxlen=4)

    def take(self, update: object) -> None:
        """Take an update of a process."""
        with self._lock:
            if isinstance(update, Status):
                self._status = update.values
            elif isinstance(update, FrameUpdate):
                self._frame = update
                self._jpeg, self._pictures = update.jpeg, self._pictures + 1
                self._seen.append((update.t_ns, update.inliers, _STATES.index(update.tracking)))
                self._begin(update.t_ns)
            elif isinstance(update, StepPicture):
                self._jpeg, self._pictures = update.jpeg, self._pictures + 1
            elif isinstance(update, MapUpdate):
                self._map.take(update)
            elif isinstance(update, Saved):
                self._saved.append(update)

    def follow(self, pose: PublishedPose) -> None:
        """Take the newest pose."""
        with self._lock:
            self._pose = pose
            self._begin(pose.t_ns)
            if pose.health & (Health.LEVELLED | Health.NOT_IN_MAP) == Health.LEVELLED:
                self._path.add(pose.T_map_base[:3, 3])

    @property
    def is_going(self) -> bool:
        """Whether poses are published."""
        with self._lock:
            return self._status.get("phase") in ("running", "ending")

    def state(self, query: Mapping[str, str]) -> dict[str, Any]:
        """Return all that is small, and the path from where the page has it (`epoch`, `path`: how many points)."""
        with self._lock:
            return {
                **self._status,
                "pose": None if self._pose is None else self._pose_json(self._pose),
                "picture": self._pictures,
                "path": self._path.answer(query),
                "map": self._map.summary(),
                "frame": None if self._frame is None else self._frame_json(self._frame),
                "saved": [{"text": saved.text, "is_well": saved.is_well} for saved in self._saved],
            }

    def map(self, query: Mapping[str, str]) -> dict[str, Any]:
        """Return what changed in the map since `since` of `epoch`; `more` where that is only a part."""
        with self._lock:
            return self._map.answer(query)

    def seen(self) -> dict[str, Any]:
        """Return what vision saw lately: seconds, inliers, state."""
        with self._lock:
            rows = np.array(self._seen, dtype=np.int64).reshape(-1, 3)
            zero = self._zero_ns or 0
        return {
            "t": packed((rows[:, 0] - zero) * _NS, "<f4"),
            "inliers": packed(rows[:, 1], "<f4"),
            "state": packed(rows[:, 2], "u1"),
        }

    def picture(self) -> bytes:
        """Return the newest picture as JPEG; empty where there is none."""
        with self._lock:
            return self._jpeg

    def _begin(self, t_ns: int) -> None:
        self._zero_ns = t_ns if self._zero_ns is None else self._zero_ns

    def _pose_json(self, pose: PublishedPose) -> dict[str, Any]:
        T = pose.T_map_base
        return plain({
            "t_s": (pose.t_ns - (self._zero_ns or 0)) * _NS,
            "xyz": T[:3, 3].tolist(),
            "R": T[:3, :3].ravel().tolist(),
            "speed_m_s": float(np.linalg.norm(pose.velocity_m_s)),
            "sigma_m": float(np.sqrt(max(np.trace(pose.pose_covariance[:3, :3]), 0.0))),
            "vision_age_s": pose.vision_age_s,
            "health": [(flag.name or "").lower() for flag in pose.health],
        })  # fmt: skip

    def _frame_json(self, frame: FrameUpdate) -> dict[str, Any]:
        return {
            "t_s": (frame.t_ns - (self._zero_ns or 0)) * _NS,
            "has_picture": bool(frame.jpeg),
            "tracking": frame.tracking,
            "inliers": frame.inliers,
            "reason": frame.reason,
        }


class _Path:
    """Where the pose was; when there is too much of it, every second point goes and a new epoch begins."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._epoch, self._step_m = 0, _PATH_STEP_M

    def add(self, position_m: Array) -> None:
        if not np.isfinite(position_m).all():
            return
        if self._points and np.linalg.norm(position_m - self._points[-1]) < self._step_m:
            return
        self._points.append(position_m)
        if len(self._points) > _MOST_PATH:
            self._points = self._points[::2]
            self._epoch, self._step_m = self._epoch + 1, 2.0 * self._step_m

    def answer(self, query: Mapping[str, str]) -> dict[str, Any]:
        has = _count(query, "path") if _count(query, "epoch") == self._epoch else 0
        new = np.array(self._points[has:], dtype=np.float64).reshape(-1, 3)
        return {"epoch": self._epoch, "from": min(has, len(self._points)), "xyz": floats(new)}


class _Keyframes:
    """Poses and points of keyframes, each with the revision in which it changed last."""

    def __init__(self) -> None:
        self._epoch, self._revision = 0, 0
        self._poses: dict[int, tuple[int, Array]] = {}
        self._clouds: dict[int, tuple[int, KeyframeCloud]] = {}
        self._loops: dict[tuple[int, int], LoopUpdate] = {}
        self._graph_revision = self._left_out = 0

    def take(self, update: MapUpdate) -> None:
        self._revision += 1
        self._graph_revision, self._left_out = update.revision, update.left_out
        for i, T in update.T_map_body.items():
            self._poses[i] = (self._revision, T[:3].astype(np.float32))
        self._clouds |= {i: (self._revision, cloud) for i, cloud in update.clouds.items()}
        self._loops |= {(loop.from_id, loop.to_id): loop for loop in update.loops}
        for pair in [*self._loops][: max(len(self._loops) - _MOST_LOOPS, 0)]:
            del self._loops[pair]
        if len(self._poses) > _MOST_KEYFRAMES:
            self._thin()
        self._trim()

    @property
    def _most_each(self) -> int:
        """Points of one keyframe; it changes where the number of keyframes passes a power of two."""
        return max(_FEWEST_EACH, MOST_POINTS // (1 << max(len(self._clouds) - 1, 0).bit_length()))

    def _thin(self) -> None:
        """Forget every second keyframe; browsers begin again."""
        kept = {*sorted(self._poses)[::2]}
        self._poses = {i: value for i, value in self._poses.items() if i in kept}
        self._clouds = {i: value for i, value in self._clouds.items() if i in kept}
        self._epoch += 1

    def _trim(self) -> None:
        most = self._most_each
        for i, (revision, cloud) in self._clouds.items():
            if len(cloud.xyz) > most:
                self._clouds[i] = (revision, KeyframeCloud(cloud.step_m, cloud.xyz[:most], cloud.rgb[:most]))

    def summary(self) -> dict[str, Any]:
        return {
            "epoch": self._epoch,
            "revision": self._revision,
            "graph_revision": self._graph_revision,
            "keyframes": len(self._poses),
            "points": sum(len(cloud.xyz) for _, cloud in self._clouds.values()),
            "left_out": self._left_out,
        }

    def answer(self, query: Mapping[str, str]) -> dict[str, Any]:
        since = _count(query, "since") if _count(query, "epoch") == self._epoch else 0
        clouds: dict[str, dict[str, Any]] = {}
        points, until, until_last = 0, self._revision, since
        for i, (revision, cloud) in sorted(self._clouds.items(), key=lambda item: item[1][0]):
            if revision <= since:
                continue
            if points > _ANSWER_POINTS and revision > until_last:
                until = until_last
                break
            clouds[str(i)] = {"step": cloud.step_m, "xyz": packed(cloud.xyz, "<i2"), "rgb": packed(cloud.rgb, "<u2")}
            points, until_last = points + len(cloud.xyz), revision
        ids = sorted(i for i, (revision, _) in self._poses.items() if revision > since)
        T = np.array([self._poses[i][1] for i in ids], dtype=np.float32).reshape(-1, 12)
        return {
            "epoch": self._epoch,
            "revision": until,
            "more": until < self._revision,
            "most_each": self._most_each,
            "ids": packed(np.array(ids), "<u4"),
            "T": packed(T, "<f4"),
            "clouds": clouds,
            "loops": [[*pair, loop.decision, loop.reason] for pair, loop in self._loops.items()],
        }


def _count(query: Mapping[str, str], name: str) -> int:
    """Return a number of a query; 0 for what is none."""
    text = query.get(name, "0")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else 0
