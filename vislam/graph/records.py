"""All that a run measured, as factors at any estimate: odometry, readings of other sensors, and poses that are held."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import gtsam

from vislam.config import GraphConfig
from vislam.core.messages import Array
from vislam.factors.builder import Label, Step, read_guess
from vislam.factors.keys import X, poses_of
from vislam.factors.loop import LoopModel
from vislam.factors.motion import held_pose
from vislam.factors.odometry import Odometry
from vislam.factors.sensed import Readings
from vislam.factors.solvers import graph_of

Whole = tuple[gtsam.NonlinearFactorGraph, list[Label | None]]  # all factors, with their names


class Records:
    """Knows what was measured and holds no estimate; a solver can be filled from it again at any time."""

    def __init__(self, config: GraphConfig, odometry: Odometry, readings: Readings) -> None:
        """Take the odometry, and the readings of other sensors: one record for each of its keyframes."""
        self._config = config
        self.odometry = odometry
        self.readings = readings
        self.vo_scale = 1.0  # on the sigma of visual odometry, learnt from loops that it contradicted
        self._held: dict[int, Array] = {}  # poses that stay, by keyframe id

    @property
    def has_imu(self) -> bool:
        """Return whether velocities and biases are variables."""
        return self.odometry.has_imu

    def hold(self, poses: Mapping[int, Array]) -> None:
        """Hold keyframes at poses [4, 4], as firmly as the first."""
        self._held |= poses

    def ties_poses_alone(self, first: int, end: int) -> bool:
        """Return whether odometry is all that is known of keyframes `first` to `end`, which are free to move.

        Readings of other sensors hang on more than relative poses, and so do velocities and biases.
        """
        has_readings = any(map(self.readings.has, range(first, end + 1)))
        return not (has_readings or self.has_imu or any(k in self._held for k in range(first, end)))

    def step(self, k: int, values: gtsam.Values) -> Step:
        """Return what ties keyframe k to the one before, at an estimate."""
        before = read_guess(values, k - 1, self.has_imu)
        earlier = values.atPose3(X(k - 2)).matrix() if k > 1 else None
        step = self.odometry.step(k, before, earlier, self.vo_scale)
        return self.readings.joined(step, k, before.T_map_body, values)

    def steps(self, values: gtsam.Values) -> list[Step]:
        """Return what ties each keyframe of an estimate to the one before."""
        return [self.step(k, values) for k in range(1, len(poses_of(values)))]

    def whole(
        self,
        values: gtsam.Values,
        loops: Mapping[int, LoopModel],
        plain: Collection[int] = (),
        as_measured: bool = False,
        steps: list[Step] | None = None,
    ) -> Whole:
        """Return all factors at an estimate of all keyframes, with their names; loops in `plain` without a kernel.

        `as_measured` leaves out what keeps the work of an update small: each loop is between its own ends. `steps` are
        those between the keyframes where they are at hand.
        """
        factors, _ = self.odometry.start()
        factors += [held_pose(k, T) for k, T in self._held.items()]
        labels: list[Label | None] = [None] * len(factors)
        for step in self.steps(values) if steps is None else steps:
            factors += [*step.factors, *step.named.values()]
            labels += [*[None] * len(step.factors), *step.named]
        factors += [loop.factor(loop_id not in plain, as_measured) for loop_id, loop in loops.items()]
        labels += [("loop", loop_id) for loop_id in loops]
        return graph_of(factors), labels

    def shared_error(self, keys: list[int], poses: Array) -> Array | None:
        """Return what errors that all odometry shares do to some variables, if all of them are poses; see Odometry."""
        ids = [key - X(0) for key in keys]
        return self.odometry.shared_error(ids, poses) if all(0 <= k < len(poses) for k in ids) else None
