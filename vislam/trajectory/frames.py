"""Where every frame of a run is, given the states of its keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.messages import Array, ImuSpan, NavState
from vislam.imu import pose_after
from vislam.trajectory import Trajectory

_END_SLACK_NS = 1_000_000  # a span that ends this near its keyframes covers the time between them


@dataclass(frozen=True, slots=True, eq=False)
class LoggedFrames:
    """All frames of a run, relative to the keyframes that they were tracked against."""

    t_ns: NDArray[np.int64]  # [N]
    keyframe_ids: NDArray[np.int64]  # [N], -1 before the first keyframe
    T_keyframe_body: list[Array | None]  # [4, 4] each; None: known by interpolation only

    def placed(self, keyframe_t_ns: dict[int, int], T_map_body: dict[int, Array]) -> Trajectory:
        """Return the pose of every frame, given times and poses of keyframes by id.

        Frames whose motion since their keyframe is unknown are interpolated between those that are known.
        """
        known = {keyframe_t_ns[i]: T for i, T in T_map_body.items()}
        ids = self.keyframe_ids.tolist()
        for t_ns, keyframe_id, T in zip(self.t_ns.tolist(), ids, self.T_keyframe_body, strict=True):
            if T is not None and keyframe_id in T_map_body:
                known[t_ns] = T_map_body[keyframe_id] @ T
        stamps = np.array(sorted(known), dtype=np.int64)
        anchors = Trajectory(stamps, np.array([known[t] for t in stamps.tolist()]).reshape(-1, 4, 4))
        if len(anchors) == 0:
            return anchors
        frames = self.t_ns[(self.t_ns >= stamps[0]) & (self.t_ns <= stamps[-1])]
        return Trajectory(frames, anchors.at(frames))

    def carried_by_imu(
        self,
        states: Sequence[NavState],
        spans: Mapping[int, ImuSpan],
        gravity_m_s2: float,
        max_gap_s: float,
        measured_too: bool = False,
    ) -> LoggedFrames:
        """Return the frames with motions by the IMU from the keyframe before, closed on the keyframe after.

        Args:
            states: of the keyframes, by id.
            spans: inertial data between keyframe id - 1 and id, where there are any.
            gravity_m_s2: down in the frame of the states.
            max_gap_s: spans with a longer hole are not used; their frames stay as they are.
            measured_too: also for frames whose motion vision has measured; else they get the orientation alone, for
                the gyroscope is steadier from frame to frame.
        """
        motions, ids = list(self.T_keyframe_body), self.keyframe_ids.copy()
        for k, (before, after) in enumerate(pairwise(states)):
            span = spans.get(k + 1)
            inside = np.flatnonzero((self.t_ns > before.t_ns) & (self.t_ns < after.t_ns)).tolist()
            wanted = [i for i in inside if measured_too or motions[i] is None or ids[i] == k]
            if span is None or not wanted or not _covers(span, before.t_ns, after.t_ns, max_gap_s):
                continue
            if not np.all(np.isfinite(np.concatenate([before.velocity_world_m_s, before.gyro_bias_rad_s]))):
                continue
            T_inverse = invert(before.T_world_body)
            miss = se3_log(invert(_carried(before, span, after.t_ns, gravity_m_s2)) @ after.T_world_body)
            for i in wanted:
                t_ns = int(self.t_ns[i])
                share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)
                carried = T_inverse @ _carried(before, span, t_ns, gravity_m_s2) @ se3_exp(share * miss)
                seen = motions[i]
                if seen is not None and not measured_too:
                    carried[:3, 3] = seen[:3, 3]
                motions[i], ids[i] = carried, k
        return replace(self, T_keyframe_body=motions, keyframe_ids=ids)


def _covers(span: ImuSpan, t0_ns: int, t1_ns: int, max_gap_s: float) -> bool:
    if len(span.t_ns) < 2 or span.t_ns[0] > t0_ns + _END_SLACK_NS or span.t_ns[-1] < t1_ns - _END_SLACK_NS:
        return False
    return bool(np.max(np.diff(span.t_ns)) * 1e-9 <= max_gap_s)


def _carried(state: NavState, span: ImuSpan, t_ns: int, gravity_m_s2: float) -> Array:
    """Return the pose [4, 4] at a time within the span, carried there from a state by the IMU."""
    inside = (span.t_ns > state.t_ns) & (span.t_ns < t_ns)
    stamps = np.concatenate([[state.t_ns], span.t_ns[inside], [t_ns]]).astype(np.int64)
    own = (span.t_ns - span.t_ns[0]).astype(np.float64)
    wanted = (stamps - span.t_ns[0]).astype(np.float64)

    def at(values: Array) -> Array:
        return np.stack([np.interp(wanted, own, column) for column in values.T], axis=1)

    between = ImuSpan(stamps, at(span.gyro_rad_s), at(span.accel_m_s2))
    return pose_after(state, between, gravity_m_s2)
