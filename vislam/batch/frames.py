"""Where every frame of a run is, given the states of its keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from vislam.factor_log import FactorLog
from vislam.geometry import invert, se3_exp, se3_log, transform
from vislam.imu.preintegration import preintegrate
from vislam.messages import Array, ImuSpan, NavState
from vislam.trajectory import Trajectory

_END_SLACK_NS = 1_000_000  # a span that ends this near its keyframes covers the time between them


def place_frames(log: FactorLog, states: Sequence[NavState], max_gap_s: float) -> Trajectory:
    """Return the pose of every frame: by the IMU from the keyframe before, closed on the keyframe after.

    Where the IMU does not cover the time between two keyframes (a hole longer than `max_gap_s`, or none at all), a
    frame keeps the motion since its keyframe that the run measured.
    """
    times = {k: int(state.t_ns) for k, state in enumerate(states)}
    frames = log.frames
    motions, ids = list(frames.T_keyframe_body), frames.keyframe_ids.copy()
    for k, (before, after) in enumerate(pairwise(states)):
        span = log.keyframes[k + 1].packet.imu
        inside = np.flatnonzero((frames.t_ns > before.t_ns) & (frames.t_ns < after.t_ns))
        if span is None or not len(inside) or not _covers(span, before.t_ns, after.t_ns, max_gap_s):
            continue
        if not np.all(np.isfinite(np.concatenate([before.velocity_world_m_s, before.gyro_bias_rad_s]))):
            continue
        T_inverse = invert(before.T_world_body)
        miss = se3_log(invert(_carried(before, span, after.t_ns, log.gravity_m_s2)) @ after.T_world_body)
        for i in inside.tolist():
            t_ns = int(frames.t_ns[i])
            share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)
            T = _carried(before, span, t_ns, log.gravity_m_s2) @ se3_exp(share * miss)
            motions[i] = T_inverse @ T
            ids[i] = k
    placed = replace(frames, T_keyframe_body=motions, keyframe_ids=ids)
    return placed.placed(times, {k: state.T_world_body for k, state in enumerate(states)})


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

    moved = preintegrate(
        ImuSpan(stamps, at(span.gyro_rad_s), at(span.accel_m_s2)), state.gyro_bias_rad_s, state.accel_bias_m_s2
    )
    R, gravity = state.T_world_body[:3, :3], np.array([0.0, 0.0, -gravity_m_s2])
    dt = moved.dt_s
    position = state.T_world_body[:3, 3] + state.velocity_world_m_s * dt + 0.5 * gravity * dt**2 + R @ moved.dp_m
    return transform(np.ascontiguousarray(R @ moved.dR), position)
