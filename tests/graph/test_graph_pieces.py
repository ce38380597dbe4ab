"""Submaps that no odometry ties: how the graph keeps them apart, joins them, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_graph_tight import TIGHT, make  # noqa: F401  a fixture

from vislam.config import GraphConfig, WindowConfig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, so3_exp, transform
from vislam.core.memory import Tied
from vislam.core.messages import Array, GraphUpdate, LoopDecision, LoopEdge, Submaps
from vislam.graph import PoseGraph
from vislam.graph.belief.gate import Anchors
from vislam.graph.travel import Travel
from worlds.lap import RIG, World, rmse_m
from worlds.parts import MACHINE
from worlds.solvers import Review

LOST = 150  # the first keyframe after the loss
COUNT = 190
AWAY = transform(so3_exp(np.array([0.0, 0.0, 1.2])), np.array([9.0, -7.0, 0.5]))  # where odom believes to be after it
TILTED = transform(so3_exp(np.array([0.4, -0.3, 1.2])), np.array([9.0, -7.0, 0.5]))


def loose(world: World, imu: bool) -> PoseGraph:
    config = GraphConfig(coupling="loose", vo_inflation=1.0)
    graph = PoseGraph(config, world.noise if imu else None, MACHINE, RIG, WindowConfig())
    graph.initialise(world.initial_state() if imu else None, world.truth[0])
    return graph


def run(
    graph: PoseGraph, world: World, edges: dict[int, list[LoopEdge]], imu: bool, away: Array, count: int = COUNT
) -> list[GraphUpdate]:
    updates = []
    for k in range(count):
        packet = world.packet(k, lost=k == LOST, imu=imu and k != LOST)
        T_odom_body = world.truth[k] if k < LOST else away @ world.truth[k]
        packet = replace(packet, begins_submap=k == LOST)
        updates.append(graph.add(packet, edges.get(k, []), T_odom_body))
    return updates


def loops(world: World, *frames: int) -> dict[int, list[LoopEdge]]:
    return {k: [world.loop(n, k - 100, k)] for n, k in enumerate(frames)}


@pytest.fixture
def world() -> World:
    return World(40.0, seed=3, vo_sigma_rad=np.deg2rad(0.05), vo_sigma_m=0.002)


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize("coupling", ["loose", "tight"])
def test_a_submap_joins_where_two_frames_say_that_it_belongs(world: World, make, coupling: str, imu: bool) -> None:  # noqa: F811
    graph = loose(world, imu) if coupling == "loose" else make(world, imu, replace(TIGHT))[0]
    updates = run(graph, world, loops(world, 160, 163), imu, AWAY if imu else TILTED)
    assert updates[LOST - 1].submaps == Submaps()
    assert {u.submaps.groups for u in updates[LOST:163]} == {(0, 1)}
    assert {u.submaps for u in updates[163:]} == {Submaps((0, LOST), (0, 0))}
    assert updates[160].rejected_loop_ids == (0,)  # waits
    assert updates[163].accepted_loop_ids == (0, 1)
    before, after = updates[162].T_map_odom, updates[163].T_map_odom
    np.testing.assert_allclose(before, updates[0].T_map_odom, atol=0.3)  # odom goes on meanwhile, wherever it is
    assert np.linalg.norm(before - after) > 5.0
    assert LOST in updates[163].ids  # the whole submap moved, and its consumers hear of it
    graph.finish()
    assert rmse_m(graph.poses()[:LOST], world.truth[:LOST]) < 0.2
    relative = invert(graph.poses()[60]) @ graph.poses()[160]
    np.testing.assert_allclose(relative, invert(world.truth[60]) @ world.truth[160], atol=0.05)
    assert rmse_m(graph.poses()[LOST:COUNT], world.truth[LOST:COUNT]) < 0.3


def test_one_image_is_one_witness_however_many_old_keyframes_it_resembles(world: World) -> None:
    graph = loose(world, imu=False)
    edges = {160: [world.loop(n, i, 160) for n, i in enumerate((59, 60, 61, 62))]}
    updates = run(graph, world, edges, False, TILTED)
    assert updates[-1].submaps.groups == (0, 1)
    assert all(r.decision is LoopDecision.PENDING and "other frames" in r.reason for r in graph.edge_reports())


def test_frames_that_contradict_each_other_join_nothing(world: World) -> None:
    graph = loose(world, imu=False)
    edges = {k: [world.false_loop(k, k - 100, k)] for k in (158, 160, 162, 164)}
    assert run(graph, world, edges, False, TILTED)[-1].submaps.groups == (0, 1)


def test_loops_that_ask_for_places_far_apart_wait_without_a_marginal(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph, asked = loose(world, imu=False), []
    monkeypatch.setattr(Travel, "relative_covariance", lambda _, i, j: asked.append((i, j)))
    edges = {}
    for n, k in enumerate((158, 160, 162)):
        away = transform(np.eye(3), np.array([20.0 * n, 0.0, 0.0]))
        true = world.loop(k, k - 100, k)
        edges[k] = [replace(true, T_from_to=true.T_from_to @ away)]
    assert run(graph, world, edges, False, TILTED, 170)[-1].submaps.groups == (0, 1)
    assert asked == []


def tied(graph: PoseGraph, world: World, edges: dict[int, list[LoopEdge]], sigma_m: float) -> GraphUpdate:
    """Run without inertial data, the submap tied to what was before by habit, 10 cm off."""
    habit = invert(world.truth[LOST - 1]) @ world.truth[LOST] @ transform(np.eye(3), np.array([0.1, 0.0, 0.0]))
    covariance = np.diag(np.repeat([0.2, sigma_m], 3) ** 2)
    for k in range(COUNT):
        packet = replace(world.packet(k, lost=k == LOST, imu=False), begins_submap=k == LOST)
        if k == LOST:
            packet = replace(packet, vo=replace(packet.vo, T_keyframe_body=habit, covariance=covariance))
        T_odom_body = world.truth[k] if k < LOST else world.truth[LOST - 1] @ habit @ invert(world.truth[LOST]) @ (
            world.truth[k]
        )  # fmt: skip
        update = graph.add(packet, edges.get(k, []), T_odom_body)
    return update


def panels_further(world: World, frames: tuple[int, ...], step_m: float, first_id: int = 0) -> list[LoopEdge]:
    """Return loops to what was just before the loss, all by the same step too far."""
    off = transform(np.eye(3), np.array([step_m, 0.0, 0.0]))
    true = [world.loop(first_id + n, 145, k) for n, k in enumerate(frames)]
    return [replace(edge, T_from_to=off @ edge.T_from_to) for edge in true]


@pytest.mark.parametrize("sigma_m", [0.1, 0.15])
def test_loops_one_panel_further_than_habit_allows_join_nothing_and_true_ones_do(world: World, sigma_m: float) -> None:
    frames = (152, 154, 156, 158, 160)
    wrong = panels_further(world, frames, 2.0)
    update = tied(loose(world, imu=False), world, {edge.to_id: [edge] for edge in wrong}, sigma_m)
    assert update.submaps.groups == (0, 1)
    right = panels_further(world, frames[:3], 0.0, 10)
    both = {k: [edge for edge in (*wrong, *right) if edge.to_id == k] for k in frames}
    graph = loose(world, imu=False)
    assert tied(graph, world, both, sigma_m).submaps.groups == (0, 0)
    off = invert(graph.poses()[140]) @ graph.poses()[170]
    np.testing.assert_allclose(off, invert(world.truth[140]) @ world.truth[170], atol=0.06)


def test_two_places_that_habit_does_not_tell_apart_are_rivals_and_the_submap_stays_apart(world: World) -> None:
    frames = (152, 154, 156, 158, 160, 162)
    edges = {
        k: [edge for n, step_m in enumerate((0.0, 1.0)) for edge in panels_further(world, (k,), step_m, 10 * k + n)]
        for k in frames
    }
    graph = loose(world, imu=False)
    assert tied(graph, world, edges, 0.5).submaps.groups == (0, 1)
    assert all("or 1.0 m from there" in report.reason for report in graph.edge_reports())
    agreeing = {k: edges[k][:1] for k in frames}
    assert tied(loose(world, imu=False), world, agreeing, 0.5).submaps.groups == (0, 0)
    graph = loose(world, imu=False)
    assert tied(graph, world, agreeing | {152: edges[152]}, 0.5).submaps.groups == (0, 1)
    waiting = {report.reason for report in graph.edge_reports() if report.decision is LoopDecision.PENDING}
    rival = "keyframe 152 is at keyframe 145, or 1.0 m from there, as 152 is at keyframe 145"
    assert waiting == {f"between submaps that are not joined, {rival}"}


def test_a_review_lets_no_loop_in_that_tears_a_submap_from_where_habit_led(world: World) -> None:
    true = {k: panels_further(world, (k,), 0.0, 10 * k) for k in (152, 154, 156)}
    inside = {k: [world.loop(k, k - 9, k)] for k in (162, 164, 166)}
    step = transform(np.eye(3), np.array([6.0, 0.0, 0.0]))
    alike = {k: [replace(e, T_from_to=step @ e.T_from_to) for e in [world.loop(k, k - 23, k)]] for k in (168, 170, 172)}
    graph = loose(world, imu=False)
    tied(graph, world, true | inside | alike, 0.1)
    graph.finish()
    decided = {report.loop_id: report.decision for report in graph.edge_reports()}
    assert {decided[k] for k in alike} == {LoopDecision.PENDING}
    assert {decided[k] for k in inside} == {LoopDecision.ACCEPTED}


def test_a_place_that_habit_makes_unlikely_joins_nothing_though_all_frames_see_it(world: World) -> None:
    frames = (152, 154, 156, 158, 160, 162)
    for step_m, groups in ((1.8, (0, 1)), (0.8, (0, 0))):
        edges = {edge.to_id: [edge] for edge in panels_further(world, frames, step_m)}
        assert tied(loose(world, imu=False), world, edges, 0.5).submaps.groups == groups


def test_a_submap_that_nothing_ties_stays_apart_where_places_look_like_their_neighbours(world: World) -> None:
    true = loops(world, 160, 163)
    assert run(loose(world, False), world, true, False, TILTED)[-1].submaps.groups == (0, 0)
    step = transform(np.eye(3), np.array([1.5, 0.0, 0.0]))
    rivals = {k: [replace(e, id=e.id + 900, T_from_to=step @ e.T_from_to) for e in edges] for k, edges in true.items()}
    both = {k: rivals[k] + true[k] for k in true}
    assert run(loose(world, False), world, both, False, TILTED)[-1].submaps.groups == (0, 1)


def test_a_submap_that_nothing_joins_stays_where_habit_has_it(world: World) -> None:
    graph = loose(world, imu=False)
    tied(graph, world, {}, 0.3)
    graph.finish()
    habit, poses = invert(world.truth[LOST - 1]) @ world.truth[LOST], graph.poses()
    off = invert(habit) @ invert(poses[LOST - 1]) @ poses[LOST]
    assert np.linalg.norm(off[:3, 3]) == pytest.approx(0.1, abs=0.01)


def test_a_lie_among_true_loops_is_left_out(world: World) -> None:
    graph = loose(world, imu=False)
    edges = loops(world, 158, 160, 162, 164)
    edges[156] = [world.false_loop(9, 56, 156)]
    updates = run(graph, world, edges, False, TILTED)
    assert updates[-1].submaps.groups == (0, 0)
    decisions = {r.loop_id: r.decision for r in graph.edge_reports()}
    assert decisions.pop(9) is not LoopDecision.ACCEPTED
    assert set(decisions.values()) == {LoopDecision.ACCEPTED}


def test_submaps_that_met_come_together_to_the_oldest(world: World) -> None:
    """Submap 2 finds submap 1 first, and both come to submap 0 when a loop of 2 finds that."""
    graph = loose(world, imu=False)
    begins = {60: TILTED, 110: AWAY @ TILTED}
    edges = {115: (70, 0), 118: (73, 1), 125: (25, 2), 128: (28, 3)}
    away = np.eye(4)
    for k in range(140):
        away = begins.get(k, away)
        packet = replace(world.packet(k, lost=k in begins, imu=False), begins_submap=k in begins)
        offered = [world.loop(edges[k][1], edges[k][0], k)] if k in edges else []
        update = graph.add(packet, offered, away @ world.truth[k])
        assert update.submaps.groups == ((0, 1, 2)[: len(update.submaps.groups)] if k < 118 else
                                        (0, 1, 1) if k < 128 else (0, 0, 0))  # fmt: skip
    graph.finish()
    assert rmse_m(graph.poses(), world.truth[:140]) < 0.3


def test_a_submap_goes_its_own_way_again_when_its_loops_are_taken_out(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    review = Review(monkeypatch)
    graph = loose(world, imu=False)
    run(graph, world, loops(world, 160, 163), False, TILTED, 170)
    review.decide(put_out=(0, 1))
    update = graph.add(world.packet(170, imu=False), [], TILTED @ world.truth[170])
    assert update.submaps.groups == (0, 1)
    assert rmse_m(graph.poses()[LOST:], world.truth[LOST:171]) < 0.5  # it stays where it was found


def test_directions_of_one_camera_join_a_submap_where_they_meet(world: World) -> None:
    graph = loose(world, imu=True)
    offered, n = {}, 0
    for k in (158, 162, 166, 170):
        offered[k] = []
        for old in (k - 104, k - 96):
            world.mono = True
            offered[k].append(world.loop(n, old, k, sigma_rad=0.002, sigma_m=0.005))
            world.mono = False
            n += 1
    updates = run(graph, world, offered, True, AWAY)
    assert updates[-1].submaps.groups == (0, 0)
    assert rmse_m(graph.poses()[LOST:], world.truth[LOST:COUNT]) < 0.3


def test_another_recording_is_found_in_a_map_that_does_not_move(world: World, make) -> None:  # noqa: F811
    """The second recording begins anew in time, with its own odom; keyframe ids go on."""
    graph, _ = make(world)
    for k in range(100):
        graph.add(world.packet(k), [], world.truth[k])
    graph.hold()
    before = graph.poses()
    graph.begin_recording(world.initial_state(), AWAY @ world.truth[100])
    for k in range(100, 140):
        packet = world.packet(k)
        if k == 100:
            packet = replace(packet, begins_submap=True, imu=None)
        old_clock = replace(packet.keyframe, t_ns=packet.keyframe.t_ns - world.t_ns(100))
        packet = replace(packet, keyframe=old_clock, imu=None)
        edges = [world.loop(k, k - 100, k)] if k in (105, 108, 120) else []
        update = graph.add(packet, edges, AWAY @ world.truth[k])
        assert update.submaps == Submaps((0, 100), (0, 0 if k >= 108 else 1))
    np.testing.assert_allclose(graph.poses()[:100], before, atol=2e-3)
    errors = [invert(graph.poses()[k - 100]) @ graph.poses()[k] for k in (105, 108, 120)]
    truths = [invert(world.truth[k - 100]) @ world.truth[k] for k in (105, 108, 120)]
    np.testing.assert_allclose(errors, truths, atol=0.06)


def test_loose_coupling_continues_no_other_recording(world: World) -> None:
    graph = loose(world, imu=True)
    graph.add(world.packet(0))
    with pytest.raises(UsageError, match="tight"):
        graph.begin_recording(world.initial_state(), np.eye(4))


def test_two_runs_give_the_same_bytes() -> None:
    results = []
    for _ in range(2):
        world = World(40.0, seed=5)
        graph = loose(world, imu=False)
        run(graph, world, loops(world, 158, 160, 163, 170), False, TILTED)
        graph.finish()
        results.append((graph.poses().tobytes(), [(r.decision, r.reason, r.chi2) for r in graph.edge_reports()]))
    assert repr(results[0]) == repr(results[1])


@given(
    st.lists(st.integers(1, 60), max_size=6, unique=True).map(sorted),
    st.lists(st.tuples(st.integers(0, 70), st.integers(0, 70)), max_size=8),
)
def test_joined_is_an_equivalence_and_groups_are_named_by_their_oldest(
    begins: list[int], pairs: list[tuple[int, int]]
) -> None:
    submaps = Submaps()
    for k in begins:
        submaps = submaps.begun(k)
    submaps = submaps.joined_by(pairs)
    ids = np.arange(71)
    groups = submaps.groups_of(ids)
    assert [submaps.group(int(k)) for k in ids] == groups.tolist()
    assert all(submaps.are_joined(a, b) for a, b in pairs)
    assert all(group == min(p for p, g in enumerate(submaps.groups) if g == group) for group in submaps.groups)
    assert len(set(submaps.groups)) >= len(submaps.groups) - len(pairs)
    assert submaps.joined_by([]).groups == tuple(range(len(begins) + 1))


def test_sigmas_of_odometry_grow_by_their_factor_and_the_way_stays() -> None:
    travel = Travel()
    for _ in range(3):
        travel.append(1e-4, 9e-4, transform(np.eye(3), np.array([2.0, 0.0, 0.0])))
    before = travel.between(0, 3)
    travel.scale(3.0)
    assert travel.between(0, 3) == pytest.approx((9.0 * before[0], 9.0 * before[1], before[2]))


def test_the_nearest_tied_keyframe_stands_for_the_place() -> None:
    anchors = Anchors(GraphConfig(), None)
    for k in (40, 50):
        anchors.tie(Tied(k, k - 30, np.zeros((6, 6))))
    near = {k: anchors.near(k) for k in (29, 31, 44, 46, 60, 61)}
    assert {k: tied and tied.id for k, tied in near.items()} == {29: None, 31: 40, 44: 40, 46: 50, 60: 50, 61: None}
