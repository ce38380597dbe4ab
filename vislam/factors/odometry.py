"""Where the factors between keyframes come from: what the estimator asks, and the answer of loose coupling."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import gtsam
import numpy as np

from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.factors.builder import Builder, Guess, Label, Step
from vislam.factors.journal import SPEED_MAX_M_S, KeyframeRecord, StartRecord
from vislam.factors.keys import nearest_rigid


class Odometry(Protocol):
    """Records of a run, turned into factors at the current estimate; the estimator can ask again at any time."""

    @property
    def has_imu(self) -> bool:
        """Return whether velocities and biases are variables."""

    def start(self) -> tuple[list[gtsam.NonlinearFactor], Guess]:
        """Return the priors and the first guess of keyframe 0."""

    def step(self, k: int, before: Guess, T_map_earlier: Array | None, vo_scale: float) -> Step:
        """Return what ties keyframe k to the one before, whose state is `before`.

        `T_map_earlier` [4, 4] is the pose of the one before that; `vo_scale` multiplies the sigma of visual odometry.
        """

    def changed(self, vo_scale: float) -> dict[Label, gtsam.NonlinearFactor]:
        """Return factors about older keyframes that came or changed with the newest one."""

    def amended(self, vo_scale: float) -> list[tuple[int, float, float]]:
        """Return older keyframes whose motion is known better now, with its variances per axis in rad^2 and m^2."""

    def relink(self, k: int, T_previous_body: Array) -> None:
        """Give the link with which keyframe k begins a submap that motion [4, 4], with its covariance as before."""

    def reach_m(self, k: int) -> float:
        """Return how far keyframe k can be from the one before; an estimate beyond has diverged."""

    def shared_error(self, ids: list[int], poses: Array) -> Array | None:
        """Return what errors that all odometry shares do to poses of keyframes, [6 N, C] at one sigma; None: nothing.

        Rotation and position on the body side; `poses` [M, 4, 4] are those of all keyframes.
        """


class MotionOdometry:
    """Loose coupling: motions of visual odometry and preintegrated IMU, one keyframe to the next."""

    def __init__(self, builder: Builder) -> None:
        """Start empty."""
        self._builder = builder
        self._start: StartRecord | None = None
        self._records: list[KeyframeRecord] = []

    @property
    def has_imu(self) -> bool:
        """See Odometry."""
        return self._start is not None and self._start.has_imu

    def begin(self, start: StartRecord) -> None:
        """Take the first state."""
        self._start = start

    def append(self, record: KeyframeRecord) -> None:
        """Take the next keyframe."""
        self._records.append(record)

    def start(self) -> tuple[list[gtsam.NonlinearFactor], Guess]:
        """See Odometry."""
        assert self._start is not None
        return self._builder.start(self._start)

    def step(self, k: int, before: Guess, T_map_earlier: Array | None, vo_scale: float) -> Step:
        """See Odometry."""
        last_motion = np.eye(4)
        if T_map_earlier is not None:
            last_motion = nearest_rigid(invert(T_map_earlier) @ before.T_map_body)
        record, previous = self._records[k], self._records[k - 1]
        floor_m = 0.0 if self._start is None else float(self._start.T_map_body[2, 3])
        return self._builder.keyframe(
            record, previous, before, last_motion=last_motion, has_imu=self.has_imu, vo_scale=vo_scale, floor_m=floor_m
        )

    def changed(self, vo_scale: float) -> dict[Label, gtsam.NonlinearFactor]:
        """See Odometry; what was measured here never changes."""
        return {}

    def amended(self, vo_scale: float) -> list[tuple[int, float, float]]:
        """See Odometry."""
        return []

    def reach_m(self, k: int) -> float:
        """See Odometry."""
        if self._records[k].begins_submap:
            return float("inf")
        return SPEED_MAX_M_S * (self._records[k].t_ns - self._records[k - 1].t_ns) * 1e-9

    def shared_error(self, ids: list[int], poses: Array) -> Array | None:
        """See Odometry; here the IMU is in the graph itself."""
        return None

    def relink(self, k: int, T_previous_body: Array) -> None:
        """See Odometry."""
        self._records[k] = replace(self._records[k], T_previous_body=nearest_rigid(T_previous_body))
