"""Bad packets, bad loops, and a gtsam that throws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import GraphConfig, WindowConfig
from vislam.core import DataError
from vislam.core.messages import ImuSpan, KeyframePacket, LoopDecision, LoopEdge
from vislam.factors import solvers as solver_module
from vislam.graph import PoseGraph
from worlds.lap import RIG, World, rmse_m, with_vo
from worlds.parts import MACHINE
from worlds.solvers import POISON, Review, WatchedSolvers

EXACT = GraphConfig(coupling="loose", vo_inflation=1.0)


@pytest.fixture
def world() -> World:
    return World(26.0, seed=11)


def started(world: World, count: int) -> PoseGraph:
    graph = PoseGraph(EXACT, world.noise, MACHINE, RIG, WindowConfig())
    graph.initialise(world.initial_state())
    for k in range(count):
        graph.add(world.packet(k))
    return graph


def _nan_span(packet: KeyframePacket) -> KeyframePacket:
    assert packet.imu is not None
    gyro = packet.imu.gyro_rad_s.copy()
    gyro[3, 1] = np.nan
    return replace(packet, imu=replace(packet.imu, gyro_rad_s=gyro))


def _backward_span(packet: KeyframePacket) -> KeyframePacket:
    assert packet.imu is not None
    t = packet.imu.t_ns.copy()
    t[5] = t[4]
    return replace(packet, imu=replace(packet.imu, t_ns=t))


def _nan_pose(packet: KeyframePacket) -> KeyframePacket:
    T = np.eye(4)
    T[0, 3] = np.nan
    return with_vo(packet, T_keyframe_body=T)


BAD_PACKETS = {
    "NaN motion": _nan_pose,
    "motion not rigid": lambda p: with_vo(p, T_keyframe_body=np.diag([1.0, 1.0, 2.0, 1.0])),
    "mirrored motion": lambda p: with_vo(p, T_keyframe_body=np.diag([1.0, 1.0, -1.0, 1.0])),
    "NaN covariance": lambda p: with_vo(p, covariance=np.full((6, 6), np.nan)),
    "negative covariance": lambda p: with_vo(p, covariance=-np.eye(6)),
    "odometry from another keyframe": lambda p: with_vo(p, keyframe_id=3),
    "id that is not next": lambda p: replace(p, keyframe=replace(p.keyframe, id=12)),
    "time that stands": lambda p: replace(p, keyframe=replace(p.keyframe, t_ns=p.keyframe.t_ns - 200_000_000)),
    "NaN IMU": _nan_span,
    "IMU stamps that stand": _backward_span,
    "IMU of another time": lambda p: replace(p, imu=replace(p.imu, t_ns=p.imu.t_ns + 50_000_000)),
    "IMU of unequal lengths": lambda p: replace(p, imu=replace(p.imu, gyro_rad_s=p.imu.gyro_rad_s[:-1])),
}


@pytest.mark.parametrize("name", BAD_PACKETS)
def test_bad_packet_is_refused_before_anything_is_touched(world: World, name: str) -> None:
    graph = started(world, 10)
    before, journal = graph.poses(), len(graph.journal)
    good = world.packet(10)
    with pytest.raises(DataError, match="keyframe"):
        graph.add(BAD_PACKETS[name](good))
    np.testing.assert_array_equal(graph.poses(), before)
    assert len(graph.journal) == journal
    assert graph.add(good).note == ""


def test_bad_initial_states_are_refused(world: World) -> None:
    graph = PoseGraph(EXACT, world.noise, MACHINE, RIG, WindowConfig())
    state = world.initial_state()
    with pytest.raises(DataError, match="velocity"):
        graph.initialise(replace(state, velocity_world_m_s=np.array([0.0, np.nan, 0.0])))
    with pytest.raises(DataError, match="positive"):
        graph.initialise(replace(state, covariance=-state.covariance))
    graph.initialise(replace(state, t_ns=10**9))
    with pytest.raises(DataError, match="time of keyframe 0"):
        graph.add(world.packet(0))
    assert len(graph.ids) == 0


BAD_EDGES = {
    "unknown keyframe": {"to_id": 500},
    "backwards": {"from_id": 100, "to_id": 3},
    "NaN": {"T_from_to": np.full((4, 4), np.nan)},
    "no covariance": {"covariance": np.zeros((6, 6))},
}


@pytest.mark.parametrize("name", BAD_EDGES)
def test_bad_loop_is_rejected_with_a_reason_and_the_packet_stays(world: World, name: str) -> None:
    graph = started(world, 110)
    edge = replace(world.loop(1, 5, 105), **BAD_EDGES[name])
    update = graph.add(world.packet(110), [edge, world.loop(2, 5, 105)])
    assert update.rejected_loop_ids == (1,)
    assert update.accepted_loop_ids == (2,)
    report = graph.edge_reports()[0]
    assert report.decision is LoopDecision.REJECTED
    assert "loop 1" in report.reason


def test_loop_id_used_twice_does_not_enter_twice(world: World) -> None:
    graph = started(world, 110)
    graph.add(world.packet(110), [world.loop(1, 5, 105)])
    before = graph.edge_reports()[0]
    graph.add(world.packet(111), [world.loop(1, 6, 106)])
    reports = graph.edge_reports()
    assert len(reports) == 1
    assert reports[0].to_id == before.to_id and reports[0].decision is LoopDecision.ACCEPTED


@pytest.mark.parametrize(
    ("failures", "solver", "word"),
    [(1, "isam2-qr", "rebuilt with QR"), (2, "isam2-qr", "from a batch solution"), (3, "batch-lm", "Levenberg")],
)
def test_poisoned_update_is_survived(
    world: World, monkeypatch: pytest.MonkeyPatch, failures: int, solver: str, word: str
) -> None:
    watched = WatchedSolvers(monkeypatch)
    graph = started(world, 60)
    before = graph.poses()
    watched.armed = failures
    update = graph.add(world.packet(60))
    assert word in update.note
    assert update.details is not None and update.details["solver"] == solver
    np.testing.assert_allclose(graph.poses()[:60], before, atol=2e-2)  # a rebuild also relinearises
    for k in range(61, 80):
        assert graph.add(world.packet(k)).note == ""
    assert rmse_m(graph.poses(), world.truth[:80]) < 0.15
    assert update.newest is not None and np.all(np.isfinite(update.newest.covariance))
    assert not watched.used_after_throw


def test_batch_solver_takes_and_drops_loops(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    watched, review = WatchedSolvers(monkeypatch), Review(monkeypatch)
    graph = started(world, 108)
    watched.armed = 3
    update = graph.add(world.packet(108))
    assert update.details is not None and update.details["solver"] == "batch-lm"
    assert graph.add(world.packet(109), [world.loop(1, 5, 105)]).accepted_loop_ids == (1,)
    before = graph.poses()
    review.decide(put_out=(1,))
    assert graph.add(world.packet(110)).rejected_loop_ids == (1,)
    assert graph.edge_reports()[0].weight == 0.0
    assert np.max(np.abs(graph.poses()[:110] - before)) > 1e-4
    assert graph.relative_covariance(5, 105).shape == (6, 6)
    assert "cost" in graph.finish().note


@pytest.mark.parametrize(("failures", "kept"), [(1, True), (2, False)])
def test_poisoned_loop_keeps_the_chain(
    world: World, monkeypatch: pytest.MonkeyPatch, failures: int, kept: bool
) -> None:
    watched = WatchedSolvers(monkeypatch)
    graph = started(world, 110)
    watched.arm_at_the_gate(monkeypatch, failures)
    update = graph.add(world.packet(110), [world.loop(7, 5, 105)])
    assert (7 in update.accepted_loop_ids) == kept
    assert "rebuilt with QR" in update.note
    assert np.all(np.isfinite(graph.poses()))
    assert rmse_m(graph.poses(), world.truth[:111]) < 0.2
    assert not watched.used_after_throw


def test_marginals_that_fail_become_nan_or_odometry(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = started(world, 30)

    def fail(*_: object) -> None:
        raise POISON

    monkeypatch.setattr(solver_module.IncrementalSolver, "joint_covariance", fail)
    assert np.all(np.isnan(graph.states()[5].covariance))
    covariance = graph.relative_covariance(3, 25)
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    update = graph.add(world.packet(30))
    assert update.newest is not None and np.all(np.isnan(update.newest.covariance))


def test_imu_hole_inside_a_span_is_told_and_survived(world: World) -> None:
    graph = started(world, 40)
    packet = world.packet(40)
    assert packet.imu is not None
    keep = np.ones(len(packet.imu.t_ns), dtype=bool)
    keep[8:34] = False
    imu = ImuSpan(packet.imu.t_ns[keep], packet.imu.gyro_rad_s[keep], packet.imu.accel_m_s2[keep])
    update = graph.add(replace(packet, imu=imu))
    assert "IMU outage of 0.1" in update.note
    for k in range(41, 60):
        graph.add(world.packet(k))
    assert rmse_m(graph.poses(), world.truth[:60]) < 0.15


def test_long_gap_in_images_and_imu(world: World) -> None:
    """Three seconds without keyframes, the middle second without IMU: one packet carries it all."""
    graph = started(world, 40)
    spans = [world.span(k) for k in range(40, 56)]
    t = np.concatenate([s.t_ns[1:] for s in spans])
    gyro = np.concatenate([s.gyro_rad_s[1:] for s in spans])
    accel = np.concatenate([s.accel_m_s2[1:] for s in spans])
    middle = (t > world.t_ns(45)) & (t < world.t_ns(49))
    imu = ImuSpan(t[~middle], gyro[~middle], accel[~middle])
    packet = world.packet(55, lost=True)
    late = replace(packet, keyframe=replace(packet.keyframe, id=40), imu=imu)
    update = graph.add(late)
    assert "vision lost" in update.note and "outage" in update.note
    assert update.newest is not None
    error = np.linalg.norm(graph.poses()[-1, :3, 3] - world.truth[55, :3, 3])
    sigma = np.sqrt(np.trace(update.newest.covariance[3:6, 3:6]))
    assert error < 3.0 * sigma


def test_a_loop_that_cannot_be_true_is_taken_out_again(world: World) -> None:
    """With a gate that lets everything pass, the optimised graph itself contradicts a gross outlier."""
    config = replace(EXACT, loop_gate_probability=1.0 - 1e-16)
    graph = PoseGraph(config, world.noise, MACHINE, RIG, WindowConfig())
    graph.initialise(world.initial_state())
    for k in range(110):
        graph.add(world.packet(k))
    good = world.loop(0, 3, 103)
    graph.add(world.packet(110), [good] + [world.loop(10 + n, 5 + n, 105 + n) for n in range(4)])
    T = good.T_from_to.copy()
    T[:3, 3] += np.array([0.174, -0.145, 0.077])
    bad = LoopEdge(1, 4, 104, T, good.covariance, True, 40, 0.3)
    update = graph.add(world.packet(111), [bad])
    reports = {r.loop_id: r for r in graph.edge_reports()}
    assert reports[0].decision is LoopDecision.ACCEPTED
    assert 1 in update.rejected_loop_ids
    assert "contradicted" in reports[1].reason
    assert reports[1].weight == 0.0
    assert rmse_m(graph.poses(), world.truth[:112]) < 0.15
