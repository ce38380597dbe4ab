"""Factors of a cart on its floor: derivatives, what they hold, and the graph that takes them."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from vislam.config import GraphConfig, MachineConfig, WindowConfig
from vislam.core.geometry import se3_exp
from vislam.core.messages import KeyframePacket
from vislam.factors import motion
from vislam.factors.keys import V, X
from vislam.graph import PoseGraph
from worlds.lap import RIG, World, rmse_m
from worlds.parts import MACHINE

EXACT = GraphConfig(coupling="loose", vo_inflation=1.0)


def test_derivatives() -> None:
    rng = np.random.default_rng(2)
    values = gtsam.Values()
    values.insert(X(1), gtsam.Pose3(se3_exp(rng.normal(0.0, 0.5, 6))))
    values.insert(V(1), rng.normal(0.0, 1.0, 3))
    factors = [motion.on_floor(1, 0.3, 1.0), motion.nonholonomic(1, np.array([0.1, -0.2, 0.05]), 1.0)]
    for factor in factors:
        linear = factor.linearize(values)
        A, b = linear.jacobian()
        assert np.allclose(b, -factor.unwhitenedError(values))
        h, columns = 1e-6, []
        for key, size in ((X(1), 6), (V(1), 3)):
            if key not in list(factor.keys()):
                continue
            for k in range(size):
                errors = []
                for sign in (1.0, -1.0):
                    delta = gtsam.VectorValues()
                    delta.insert(X(1), np.zeros(6))
                    delta.insert(V(1), np.zeros(3))
                    step = np.zeros(size)
                    step[k] = sign * h
                    delta.update(_single(key, step))
                    errors.append(factor.unwhitenedError(values.retract(delta)))
                columns.append((errors[0] - errors[1]) / (2 * h))
        assert np.allclose(A, np.column_stack(columns), atol=1e-6)


def _single(key: int, step: np.ndarray) -> gtsam.VectorValues:
    out = gtsam.VectorValues()
    out.insert(key, step)
    return out


@pytest.mark.parametrize("imu", [True, False])
def test_a_graph_takes_them_and_the_floor_holds_the_height(imu: bool) -> None:
    world = World(12.0)
    packets = [world.packet(k, imu=imu) for k in range(world.count)]
    plain = run(world, packets, EXACT, imu)
    # the world's body rises and falls by 0.3 m: a floor that hard would be wrong, a soft one changes nothing
    soft = run(world, packets, EXACT, imu, MachineConfig(floor_sigma_m=30.0, slip_sigma_m_s=100.0))
    assert rmse_m(plain, soft) < 0.002
    hard = run(world, packets, EXACT, imu, MachineConfig(floor_sigma_m=0.001))
    assert np.abs(hard[:, 2, 3]).max() < 0.02 < np.abs(plain[:, 2, 3]).max()


def run(
    world: World, packets: list[KeyframePacket], config: GraphConfig, imu: bool, machine: MachineConfig = MACHINE
) -> np.ndarray:
    graph = PoseGraph(config, world.noise if imu else None, machine, RIG, WindowConfig())
    graph.initialise(world.initial_state() if imu else None)
    for packet in packets:
        assert not graph.add(packet, []).note
    graph.finish()
    return graph.poses()


def test_wheels_hold_the_velocity() -> None:
    graph = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(V(0), np.array([1.0, 0.5, -0.3]))
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    graph.add(gtsam.PriorFactorVector(V(0), np.array([1.0, 0.5, -0.3]), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))
    graph.add(motion.nonholonomic(0, np.array([0.0, 0.1, 0.0]), 1e-3))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atVector(V(0))
    assert found == pytest.approx([1.0, -0.1, 0.0], abs=1e-3)
