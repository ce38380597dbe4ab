"""Made pose graphs: their truth, their noise, their loops."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vislam.batch.posegraph.g2o import read_g2o
from vislam.batch.posegraph.worlds import Shape, SimulatedGraph, simulate_graph
from vislam.cli import run_verb
from vislam.config import GraphWorldConfig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert_many
from vislam.trajectory import read_tum

SHAPES: tuple[Shape, ...] = ("grid3d", "torus", "sphere", "manhattan")
WORLD = GraphWorldConfig(poses=1500, seed=3)


def _positions(graph: SimulatedGraph) -> np.ndarray:
    d = graph.problem.dimension
    return graph.truth[:, :d, d]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("anisotropy", [1.0, 5.0])
def test_noise_is_what_the_information_says(shape: Shape, anisotropy: float) -> None:
    graph = simulate_graph(shape, replace(WORLD, anisotropy=anisotropy))
    freedom = len(graph.problem.edges) * graph.problem.tangent
    # chi2 with this many degrees of freedom: 5 sigma
    assert graph.problem.chi2(graph.truth) == pytest.approx(freedom, abs=5.0 * np.sqrt(2.0 * freedom))
    eigenvalues = np.linalg.eigvalsh(graph.problem.information[0])
    k = graph.problem.dimension - 1  # translation's best and worst sigma differ by the anisotropy
    assert np.isclose(eigenvalues, 1.0 / (0.05 * anisotropy) ** 2).sum() == (1 if anisotropy > 1.0 else k + 1)


@pytest.mark.parametrize("shape", SHAPES)
def test_paths_step_a_metre_and_loops_are_near(shape: Shape) -> None:
    graph = simulate_graph(shape, WORLD)
    positions, (i, j) = _positions(graph), graph.problem.edges.T
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert np.all((steps > 0.85) & (steps < 1.0 + 1e-9))
    loop = j - i > 1
    assert loop.sum() == 1500
    assert len(graph.problem.edges) == 1499 + 1500
    assert np.linalg.norm(positions[i] - positions[j], axis=1)[loop].max() <= 5.0
    assert np.all(np.diff(j) >= 0), "edges come in the order of their later pose"
    d = graph.problem.dimension
    R = graph.truth[:, :d, :d]
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(d), atol=1e-12)
    assert np.allclose(np.linalg.det(R), 1.0)
    assert not graph.outlier.any()
    ahead = np.einsum("nk,nk->n", R[:-1, :, 0], np.diff(positions, axis=0))
    assert np.all(ahead > 0.85), "x looks along the path"


def test_it_starts_from_odometry() -> None:
    graph = simulate_graph("torus", WORLD)
    odometry = np.flatnonzero(np.diff(graph.problem.edges, axis=1)[:, 0] == 1)[:1499]
    assert np.array_equal(graph.problem.poses[0], graph.truth[0])
    assert graph.problem.edge_chi2(graph.problem.poses)[odometry].max() < 1e-15 * graph.problem.chi2(graph.truth)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_same_seed_gives_the_same_graph(shape: Shape) -> None:
    first, second = simulate_graph(shape, WORLD), simulate_graph(shape, WORLD)
    other = simulate_graph(shape, replace(WORLD, seed=4))
    assert first.problem.measurements.tobytes() == second.problem.measurements.tobytes()
    assert first.problem.edges.tobytes() == second.problem.edges.tobytes()
    assert first.problem.measurements.tobytes() != other.problem.measurements.tobytes()


@pytest.mark.parametrize("group", [1, 10])
def test_false_loops_join_far_places_and_agree_in_their_groups(group: int) -> None:
    world = replace(WORLD, poses=3000, outlier_fraction=0.5, alias_group=group)
    graph = simulate_graph("manhattan", world)
    problem, false = graph.problem, np.flatnonzero(graph.outlier)
    assert len(false) == 3000
    positions, (i, j) = _positions(graph), problem.edges.T
    terms = problem.edge_chi2(graph.truth)
    assert terms[false].min() > 1000.0
    assert terms[~graph.outlier].max() < 50.0
    # what a false loop says of the world: T_world_i @ measured @ T_j_world, the same within a group but for noise
    shift = (graph.truth[i] @ problem.measurements @ invert_many(graph.truth[j]))[false]
    key = np.lexsort((j[false], j[false] - i[false]))
    lag, first = (j - i)[false][key], i[false][key]
    pairs = np.flatnonzero((np.diff(lag) == 0) & (np.diff(first) == 1))
    apart = np.abs(shift[key][pairs + 1] - shift[key][pairs])[:, :2, :2].max(axis=(1, 2))
    if group > 1:
        assert len(pairs) >= 0.85 * len(false)
        assert np.median(apart) < 0.1
    else:
        assert len(pairs) < 0.02 * len(false)
    assert np.linalg.norm(positions[i] - positions[j], axis=1)[false].min() > 10.0


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("poses", 1), ("poses", 10**9), ("loops_per_pose", -1.0), ("loops_per_pose", 1e9), ("loops_per_pose", np.nan),
        ("rotation_sigma_deg", 0.0), ("translation_sigma_m", -1.0), ("translation_sigma_m", np.inf),
        ("anisotropy", np.nan), ("outlier_fraction", 1.0), ("outlier_fraction", -0.1), ("alias_group", 0), ("seed", -1),
    ],
)  # fmt: skip
def test_what_cannot_be_made_is_refused(setting: str, value: float) -> None:
    with pytest.raises(UsageError):
        simulate_graph("torus", replace(WORLD, **{setting: value}))


def test_false_loops_need_room() -> None:
    with pytest.raises(UsageError, match="no room"):
        simulate_graph("grid3d", replace(WORLD, poses=8, outlier_fraction=0.5))


def test_tiny_graphs() -> None:
    for shape in SHAPES:
        for poses in (2, 3, 9):
            graph = simulate_graph(shape, replace(WORLD, poses=poses))
            assert len(graph.truth) == poses
            assert len(graph.problem.edges) >= poses - 1


def test_the_verb_writes_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, truth, false = tmp_path / "m.g2o", tmp_path / "m.tum", tmp_path / "m.csv"
    arguments = ["simulate", "--graph=manhattan", "--poses", "400", "--out", str(out), "--truth", str(truth)]
    arguments += ["--outlier-fraction", "0.2", "--alias-group", "4", "--outliers", str(false)]
    assert run_verb(arguments) == 0
    assert "400 poses" in capsys.readouterr().out
    problem, trajectory = read_g2o(out), read_tum(truth)
    made = simulate_graph("manhattan", GraphWorldConfig(poses=400, outlier_fraction=0.2, alias_group=4))
    assert np.array_equal(problem.edges, made.problem.edges)
    assert np.allclose(problem.measurements, made.problem.measurements, atol=1e-12)
    assert np.allclose(trajectory.T_world_body[:, :2, 3], made.truth[:, :2, 2], atol=1e-8)
    rows = np.loadtxt(false, delimiter=",", skiprows=1, dtype=int)
    assert np.array_equal(rows, made.problem.edges[made.outlier])
    assert run_verb(["simulate", "--graph", "cube", "--out", str(out)]) == 2
    assert run_verb(["simulate", "--graph", "torus", "--poses", "0", "--out", str(out)]) == 2
