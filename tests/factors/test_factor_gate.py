import numpy as np
import pytest
from graph_world import T_BODY_CAM0, World

from vislam.config import GraphConfig
from vislam.factors.gate import CarPark, Travel
from vislam.factors.journal import loop_record
from vislam.factors.loop import LoopModel
from vislam.messages import LoopEdge


@pytest.fixture
def world() -> World:
    return World(30.0, seed=8)


def _model(edge: LoopEdge) -> LoopModel:
    return LoopModel(loop_record(edge, 10_000), GraphConfig(), T_BODY_CAM0[:3, 3])


def _travel(world: World) -> Travel:
    travel = Travel()
    for k in range(1, world.count):
        step = float(np.linalg.norm(world.truth[k, :3, 3] - world.truth[k - 1, :3, 3]))
        travel.append(world.vo_sigma_rad**2, world.vo_sigma_m**2, step)
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
    assert model.chi2(world.truth[5], world.truth[105], ignorant) < model.threshold


def test_group_forms_only_from_loops_that_agree(world: World) -> None:
    park, travel = CarPark(GraphConfig()), _travel(world)
    true = [_model(world.loop(n, 5 + 4 * n, 105 + 4 * n)) for n in range(3)]
    false = [_model(world.false_loop(10 + n, 5 + 4 * n, 107 + 4 * n)) for n in range(3)]
    for pair in zip(true, false, strict=True):
        for model in pair:
            park.park(model, world.truth, travel)
    assert park.group_of(true[2]) == true
    assert park.group_of(false[2]) == []
    park.remove(true)
    assert park.edges == false


def test_two_witnesses_are_too_few_and_one_image_is_one_witness(world: World) -> None:
    park, travel = CarPark(GraphConfig()), _travel(world)
    pair = [_model(world.loop(n, 5 + 4 * n, 105 + 4 * n)) for n in range(2)]
    for model in pair:
        park.park(model, world.truth, travel)
    assert park.group_of(pair[1]) == []
    park = CarPark(GraphConfig())
    same = [_model(world.loop(n, 5 + n, 105)) for n in range(4)]
    for model in same:
        park.park(model, world.truth, travel)
    assert park.group_of(same[3]) == []


def test_loose_odometry_between_loops_proves_nothing(world: World) -> None:
    travel = _travel(world)
    travel.scale(100.0)
    park = CarPark(GraphConfig())
    true = [_model(world.loop(n, 5 + 4 * n, 105 + 4 * n)) for n in range(3)]
    for model in true:
        park.park(model, world.truth, travel)
    assert park.group_of(true[2]) == []


def test_travel_takes_better_variances_of_the_newest_motions() -> None:
    travel, again = Travel(), Travel()
    for k in range(1, 8):
        travel.append(9.0 if k in (5, 6) else float(k), 0.1 * k, 1.0)
        again.append(float(k), 0.5 if k == 5 else 0.1 * k, 1.0)
    travel.amend(6, 6.0, 0.6)
    travel.amend(5, 5.0, 0.5)
    for i, j in ((0, 7), (4, 5), (5, 6), (6, 7), (0, 4)):
        np.testing.assert_allclose(travel.between(i, j), again.between(i, j))


def test_full_park_gives_up_its_oldest(world: World) -> None:
    park, travel = CarPark(GraphConfig(parked_max=2)), _travel(world)
    models = [_model(world.false_loop(n, n, 100 + n)) for n in range(3)]
    assert park.park(models[0], world.truth, travel) is None
    assert park.park(models[1], world.truth, travel) is None
    assert park.park(models[2], world.truth, travel) is models[0]
    assert park.edges == models[1:]
