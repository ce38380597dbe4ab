import numpy as np
import pytest

from vislam.config import GraphConfig
from vislam.core.geometry import invert, se3_adjoint, se3_exp
from vislam.core.messages import LoopEdge
from vislam.factors.journal import loop_record
from vislam.factors.loop import LoopModel
from vislam.graph.belief.loop_set import LoopSet
from vislam.graph.belief.witnesses import Witnesses, confirming
from vislam.graph.travel import Travel
from worlds.lap import T_BODY_CAM0, World


@pytest.fixture
def world() -> World:
    return World(30.0, seed=8)


def _model(edge: LoopEdge) -> LoopModel:
    return LoopModel(loop_record(edge, 10_000), GraphConfig(), T_BODY_CAM0[:3, 3])


def _travel(world: World) -> Travel:
    travel = Travel()
    for k in range(1, world.count):
        travel.append(world.vo_sigma_rad**2, world.vo_sigma_m**2, invert(world.truth[k - 1]) @ world.truth[k])
    return travel


def test_chi2_of_true_loops_has_its_degrees_of_freedom(world: World) -> None:
    values = []
    for n in range(300):
        edge = world.loop(n, 5, 105, 0.02, 0.05)
        values.append(_model(edge).chi2(world.truth[5], world.truth[105]))
    assert 4.5 < np.mean(values) < 6.5


def test_a_graph_that_knows_nothing_lets_a_loop_pass(world: World) -> None:
    model = _model(world.loop(0, 5, 105))
    ignorant = np.zeros((6, 6))
    ignorant[3, 3] = 1e30
    elsewhere = world.truth[105] @ se3_exp(np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0]))
    assert model.chi2(world.truth[5], world.truth[105], ignorant) < model.threshold
    assert model.chi2(world.truth[5], elsewhere, ignorant) < model.threshold < model.chi2(world.truth[5], elsewhere)


def test_loops_about_the_same_two_places_are_one_witness(world: World) -> None:
    witnesses, travel = Witnesses(GraphConfig()), _travel(world)
    loops = [(5, 105), (8, 108), (9, 107), (40, 140), (5, 105)]
    models = [_model(world.loop(n, i, j)) for n, (i, j) in enumerate(loops)]
    lie = _model(world.false_loop(9, 6, 106))
    for model in [*models, lie]:
        witnesses.add(model, travel)
    assert witnesses.loops() == [[*models[:3], models[4]], [models[3]], [lie]]


def test_a_loop_that_turns_as_it_may_is_the_same_witness_though_its_lever_moves_the_place(world: World) -> None:
    witnesses, travel = Witnesses(GraphConfig()), _travel(world)
    covariance = np.diag(np.repeat([0.1**2, 0.005**2], 3))
    for n, (i, j, turn_rad) in enumerate([(5, 105, 0.0), (14, 114, 0.3)]):
        T = invert(world.truth[i]) @ world.truth[j] @ se3_exp(np.array([0.0, 0.0, turn_rad, 0.0, 0.0, 0.0]))
        witnesses.add(_model(LoopEdge(n, i, j, T, covariance, True, 60, 0.5)), travel)
    assert len(witnesses) == 1


def test_loops_confirm_one_another_only_where_odometry_can_tell(world: World) -> None:
    travel = _travel(world)
    true = [_model(world.loop(n, 5 + 8 * n, 105 + 8 * n)) for n in range(4)]
    false = [_model(world.false_loop(10 + n, 5 + 8 * n, 107 + 8 * n)) for n in range(4)]
    assert confirming([*false, *true], travel.chain()) == [4, 5, 6, 7]
    travel.scale(100.0)
    assert confirming([*false, *true], travel.chain()) == []


def test_covariance_between_any_two_keyframes_is_that_of_the_steps_composed(world: World) -> None:
    travel, rng = Travel(), np.random.default_rng(4)
    poses, steps = [np.eye(4)], []
    for _ in range(12):
        T, variances = se3_exp(rng.normal(size=6) * 0.5), rng.uniform(1e-4, 1e-3, 2)
        travel.append(*variances, T)
        poses.append(poses[-1] @ T)
        steps.append(np.diag(np.repeat(variances, 3)))
    T, covariance = travel.chain().motion(3, 10)
    expected = np.zeros((6, 6))
    for k in range(4, 11):
        carry = se3_adjoint(invert(poses[10]) @ poses[k])
        expected += carry @ steps[k - 1] @ carry.T
    np.testing.assert_allclose(T, invert(poses[3]) @ poses[10], atol=1e-12)
    np.testing.assert_allclose(covariance, expected, atol=1e-9)


def test_travel_takes_better_variances_of_the_newest_motions() -> None:
    travel, again = Travel(), Travel()
    for k in range(1, 8):
        step = se3_exp(np.full(6, 0.1 * k))
        travel.append(9.0 if k in (5, 6) else float(k), 0.1 * k, np.eye(4) if k in (5, 6) else step)
        again.append(float(k), 0.5 if k == 5 else 0.1 * k, step)
    travel.amend(6, 6.0, 0.6, se3_exp(np.full(6, 0.6)))
    travel.amend(5, 5.0, 0.5, se3_exp(np.full(6, 0.5)))
    for i, j in ((0, 7), (4, 5), (5, 6), (6, 7), (0, 4)):
        np.testing.assert_allclose(travel.between(i, j), again.between(i, j))
    np.testing.assert_allclose(travel.poses, again.poses, atol=1e-12)


def test_full_park_gives_up_its_oldest(world: World) -> None:
    loops = LoopSet(GraphConfig(pending_max=2), np.zeros(3), None, Travel())
    models = [_model(world.false_loop(n, n, 100 + n)) for n in range(3)]
    for model in models:
        loops.wait(model)
    assert loops.keep_pending(models[:2]) == []
    assert loops.keep_pending(models[2:]) == [models[0].id]
    assert loops.pending == 2
