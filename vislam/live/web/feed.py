"""What browsers see of a run: the newest of everything, bounded, under one lock."""

import re
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
_BY_PHASE = {
    "waiting": "The run waits for Start.",
    "ending": "The run ends: it is being written down.",
}


def sigma_m(pose: PublishedPose) -> float:
    """Return the sigma of a pose's position, over all axes; infinite where it is unknown."""
    variance = float(np.trace(pose.pose_covariance[:3, :3]))
    return float(np.sqrt(max(variance, 0.0))) if np.isfinite(variance) else np.inf


def headline(status: Mapping[str, Any], pose: PublishedPose | None, frame: FrameUpdate | None) -> dict[str, str]:
    """Return `state` and `text` of the line; of an invalid pose also `sigma` and `reason`.

    `state` is "invalid", that of the verdict, or "plain" where there is no pose to judge.
    """
    phase, verdict = status.get("phase"), status.get("verdict") or {}
    if phase == "running" and pose is not None:
        sigma = f"± {sigma_m(pose):.2f} m" if np.isfinite(sigma_m(pose)) else "position unknown"
        if Health.INVALID in pose.health:
            reason = _why_invalid(pose, frame)
            return {
                "state": "invalid", "text": f"Invalid, {sigma}: {reason}. Do not steer by it.", "sigma": sigma,
                "reason": reason,
            }  # fmt: skip
        return _judged(verdict or {"state": "trusted"}, f", {sigma}")
    if verdict:
        return _judged(verdict, "")
    return {"state": "plain", "text": _BY_PHASE.get(str(phase), "") or _no_pose(status)}


def _judged(verdict: Mapping[str, Any], sigma: str) -> dict[str, str]:
    """Return the verdict with the first words of its first reason; the page has them all further below."""
    reasons = verdict.get("reasons") or ["nothing in the run contradicts itself"]
    first = re.split("[:;] ", reasons[0], maxsplit=1)[0]
    more = f", and {len(reasons) - 1} more reason{'s' * (len(reasons) > 2)}" if len(reasons) > 1 else ""
    state = str(verdict["state"])
    return {"state": state, "text": f"{state.capitalize()}{sigma}: {first}{more}."}


def _no_pose(status: Mapping[str, Any]) -> str:
    line = str(status.get("line") or "no pose yet")
    return line[:1].upper() + line[1:] + "."


def _why_invalid(pose: PublishedPose, frame: FrameUpdate | None) -> str:
    seen = f"vision is {frame.tracking}: {frame.reason}" if frame is not None and frame.reason else ""
    if Health.IMU_MISSING in pose.health:
        return "no samples come from the IMU"
    if not np.isfinite(pose.vision_age_s) and Health.VISION_OK not in pose.health:
        return seen or "nothing has measured a position yet"
    if Health.DEAD_RECKONING in pose.health:
        return f"nothing has corrected it for {pose.vision_age_s:.1f} s" + (f"; {seen}" if seen else "")
    return "it drifted too far, and what corrects it again does not suffice yet"


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
                self._zero_ns = update.values.get("zero_ns", self._zero_ns)
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
                "headline": headline(self._status, self._pose, self._frame),
                "notices": [[*notice[:2], self._since(notice[2])] for notice in self._status.get("notices", ())],
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

    def _since(self, t_ns: int) -> float | None:
        """Return seconds since the start of the run; None before it."""
        return None if self._zero_ns is None or t_ns < self._zero_ns else (t_ns - self._zero_ns) * _NS

    def _begin(self, t_ns: int) -> None:
        self._zero_ns = t_ns if self._zero_ns is None else self._zero_ns

    def _pose_json(self, pose: PublishedPose) -> dict[str, Any]:
        T = pose.T_map_base
        return plain({
            "t_s": (pose.t_ns - (self._zero_ns or 0)) * _NS,
            "xyz": T[:3, 3].tolist(),
            "R": T[:3, :3].ravel().tolist(),
            "speed_m_s": float(np.linalg.norm(pose.velocity_m_s)),
            "sigma_m": sigma_m(pose),
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
        self._loops: dict[tuple[int, int, str], LoopUpdate] = {}
        self._decided: dict[str, int] = {}
        self._graph_revision = self._left_out = 0

    def take(self, update: MapUpdate) -> None:
        self._revision += 1
        self._graph_revision, self._left_out = update.revision, update.left_out
        for i, T in update.T_map_body.items():
            self._poses[i] = (self._revision, T[:3].astype(np.float32))
        self._clouds |= {i: (self._revision, cloud) for i, cloud in update.clouds.items()}
        self._loops |= {(loop.from_id, loop.to_id, loop.source): loop for loop in update.loops}
        self._decided = update.decided or self._decided
        for key in [*self._loops][: max(len(self._loops) - _MOST_LOOPS, 0)]:
            del self._loops[key]
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
            "loops": self._decided,
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
            "loops": [[loop.from_id, loop.to_id, loop.decision, loop.reason, loop.id] for loop in self._loops.values()],
        }


def _count(query: Mapping[str, str], name: str) -> int:
    """Return a number of a query; 0 for what is none."""
    text = query.get(name, "0")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else 0
