"""TORO and iSAM files: their own costs, strictness, and that nothing is lost on the way through them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vislam.batch import optimize_pose_graph, read_pose_graph
from vislam.batch.posegraph.files import graph_format, write_pose_graph
from vislam.batch.posegraph.isam import read_isam, write_isam
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.toro import read_toro, write_toro
from vislam.batch.posegraph.worlds import Shape, simulate_graph
from vislam.config import GraphWorldConfig
from vislam.core.errors import DataError, StorageError, UsageError, VislamError

Array = np.ndarray


def _graph(shape: Shape, seed: int = 0, noise: float = 1.0) -> PoseGraphProblem:
    """A small graph whose edges have full information matrices and tilted measurements."""
    rng = np.random.default_rng(seed)
    world = GraphWorldConfig(
        poses=30, seed=seed, rotation_sigma_deg=noise, translation_sigma_m=0.05 * noise, loops_per_pose=2.0
    )
    made = simulate_graph(shape, world)
    k = made.problem.tangent
    A = rng.normal(size=(len(made.problem.edges), k, k))
    return replace(made.problem, information=A @ A.transpose(0, 2, 1) + np.eye(k), poses=made.truth)


def _euler(R: Array) -> Array:
    return np.array([np.arctan2(R[2, 1], R[2, 2]), np.arcsin(-R[2, 0]), np.arctan2(R[1, 0], R[0, 0])])


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _own_cost(path: Path, poses: Array, ids: Array, root: bool) -> float:
    """The cost of a TORO (planar) or iSAM file as those programs' sources have it, from the text alone."""
    total = 0.0
    at = {int(i): T for i, T in zip(ids, poses, strict=True)}
    for line in path.read_text().splitlines():
        tag, *fields = line.split()
        if "VERTEX" in tag or "POSE" in tag:
            continue
        i, j, numbers = int(fields[0]), int(fields[1]), np.array(fields[2:], dtype=float)
        between = np.linalg.inv(at[i]) @ at[j]
        d = len(between) - 1
        predicted = (
            np.array([*between[:2, 2], np.arctan2(between[1, 0], between[0, 0])])
            if d == 2
            else np.array([*between[:3, 3], *_euler(between[:3, :3])])
        )
        k = len(predicted)
        error = predicted - numbers[:k]
        error[d:] = _wrapped(error[d:])
        if root:
            W = np.zeros((k, k))
            W[np.triu_indices(k)] = numbers[k:]
            total += float(np.sum((W @ error) ** 2))
        else:
            ff, fs, ss, rr, fr, sr = numbers[k:]
            total += float(error @ np.array([[ff, fs, fr], [fs, ss, sr], [fr, sr, rr]]) @ error)
    return total


@pytest.mark.parametrize(
    ("shape", "ending"), [("manhattan", ".toro"), ("manhattan", ".isam"), ("sphere", ".isam"), ("torus", ".isam")]
)
def test_the_cost_is_the_programs_own(tmp_path: Path, shape: Shape, ending: str) -> None:
    """Both costs agree to second order: ten times smaller errors, ten times better agreement."""
    disagreements = []
    for noise in (0.1, 0.01):
        problem = _graph(shape, noise=noise)
        path = tmp_path / f"g{noise}{ending}"
        write_pose_graph(problem, path)
        got = read_pose_graph(path)
        ours, own = got.chi2(problem.poses), _own_cost(path, problem.poses, problem.ids, ending == ".isam")
        assert problem.chi2(problem.poses) == pytest.approx(ours, rel=1e-9)
        disagreements.append(abs(ours / own - 1.0))
    assert disagreements[0] < 0.02
    assert disagreements[1] < 0.2 * disagreements[0] + 1e-9


@pytest.mark.parametrize("shape", ["manhattan", "sphere", "grid3d"])
@pytest.mark.parametrize("ending", [".toro", ".isam", ".g2o"])
def test_what_is_written_comes_back(tmp_path: Path, shape: Shape, ending: str) -> None:
    problem = _graph(shape)
    if (shape, ending) == ("grid3d", ".isam"):  # it climbs straight up, which Euler angles cannot say
        with pytest.raises(UsageError, match="pitch"):
            write_isam(replace(problem, measurements=_upright(problem)), tmp_path / "g.isam")
        return
    path = tmp_path / f"g{ending}"
    write_pose_graph(problem, path)
    got = read_pose_graph(path)
    assert np.array_equal(got.ids, problem.ids)
    assert np.array_equal(got.edges, problem.edges)
    assert np.allclose(got.measurements, problem.measurements, atol=1e-13)
    assert np.allclose(got.information, problem.information, rtol=1e-9, atol=1e-9)
    if (shape, ending) == ("manhattan", ".isam"):
        assert not got.has_pose.any()
    else:
        assert np.allclose(got.poses, problem.poses, atol=1e-12)


def _upright(problem: PoseGraphProblem) -> Array:
    measured = problem.measurements.copy()
    measured[3, :3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    return measured


def test_orders_of_the_files(tmp_path: Path) -> None:
    toro = tmp_path / "a.toro"
    toro.write_text("VERTEX2 0 0 0 0\nVERTEX2 5 1 2 0\nEDGE2 0 5 1 2 0 11 12 22 33 0.13 0.23\n")
    got = read_toro(toro)
    assert got.information[0].tolist() == [[33, 0.13, 0.23], [0.13, 11, 12], [0.23, 12, 22]]
    assert got.ids.tolist() == [0, 5]
    space = tmp_path / "b.toro"
    upper = " ".join(str(100 if a == b else a + 10 * b) for a in range(6) for b in range(a, 6))
    space.write_text(f"VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 2 3 0.1 0.2 0.3\nEDGE3 0 1 1 2 3 0.1 0.2 0.3 {upper}\n")
    got = read_toro(space)
    assert got.chi2(got.poses) == pytest.approx(0.0, abs=1e-20)
    assert got.information[0, 0, 1] == 3 + 10 * 4  # roll and pitch
    assert got.information[0, 0, 3] == 0 + 10 * 3  # roll and x
    isam = tmp_path / "c.isam"
    isam.write_text("ODOMETRY 0 1 1 0 0 2 0.5 0.25 4 0 8\nSOLVE\nEDGE2 1 2 1 0 0 1 0 0 1 0 1\n")
    got = read_isam(isam)
    R = np.array([[2, 0.5, 0.25], [0, 4, 0], [0, 0, 8]])
    assert np.allclose(got.information[0], (R.T @ R)[np.ix_([2, 0, 1], [2, 0, 1])])
    assert got.edges.tolist() == [[0, 1], [1, 2]]


def test_two_names_of_one_pose_are_one_place(tmp_path: Path) -> None:
    path = tmp_path / "two_names.toro"
    edges = [f"EDGE2 {ends} 1 0 1.5 1 0 1 1 0 0" for ends in ("0 1", "1 2", "3 4")]
    path.write_text("\n".join([*edges, "EQUIV 2 3"]) + "\n")
    poses = optimize_pose_graph(read_pose_graph(path)).poses
    assert np.allclose(poses[2], poses[3], atol=1e-5)
    assert np.allclose(np.linalg.norm(np.diff(poses[[0, 1, 2, 4], :2, 2], axis=0), axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize(
    ("ending", "line"),
    [
        ("g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"),
        ("toro", "EDGE2 0 1 1 0 0 1 0 1 1 0 0"),
        ("isam", "EDGE2 0 1 1 0 0 1 0 0 1 0 1"),
    ],
)
def test_what_measures_no_pose_is_passed_over_and_counted(tmp_path: Path, ending: str, line: str) -> None:
    path = tmp_path / f"log.{ending}"
    path.write_text(f"ROBOTLASER1 0 -1.57 3.14 0.01 30 0.1 0 2 1.5 1.6 0\n{line}\nROBOTLASER1 1\nVERTEX_TAG 0 door\n")
    problem = read_pose_graph(path)
    assert problem.ids.tolist() == [0, 1]
    for count in ("2 lines of ROBOTLASER1", "1 lines of VERTEX_TAG"):
        assert f"{count} passed over: they measure no pose" in problem.notes


def test_which_format_it_is(tmp_path: Path) -> None:
    texts = {
        "g2o": "# x\nVERTEX_SE2 0 0 0 0\n",
        "toro": "VERTEX3 0 0 0 0 0 0 0\n",
        "isam": "\nODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n",
    }
    for name, text in texts.items():
        path = tmp_path / f"{name}.txt"
        path.write_text(text)
        assert graph_format(path) == name
        assert graph_format(tmp_path / f"missing.{name.upper()}") == name
    both = tmp_path / "both.txt"
    both.write_text("EDGE2 0 1 1 0 0 1 0 1 1 0 0\n")
    with pytest.raises(UsageError, match=r"\.toro"):
        graph_format(both)
    with pytest.raises(DataError, match="cannot be read"):
        read_pose_graph(tmp_path / "nothing.txt")
    with pytest.raises(DataError):
        read_pose_graph(tmp_path)


_TORO = ["VERTEX2 0 0 0 0", "EDGE2 0 1 1 0 0 1 0 1 1 0 0", "VERTEX2 1 1 0 0"]
_TORO_3D = ["VERTEX3 0 0 0 0 0 0 0", "EDGE3 0 1 1 0 0 0 0 0 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"]
_BR = [*_TORO, "BR 0 7 0.5 3 0.1 0.2"]
_SEEN = ["ODOMETRY 0 1 1 0 0 1 0 0 1 0 1", "LANDMARK 0 5 1 0 1 0 1", "BR 1 5 0.5 3 0.1 0.2"]
_ISAM = ["ODOMETRY 0 1 1 0 0 1 0 0 1 0 1", "EDGE2 1 2 1 0 0 1 0 0 1 0 1"]


@pytest.mark.parametrize(
    ("read", "lines"),
    [
        (read_toro, _TORO),
        (read_toro, _TORO_3D),
        (read_toro, _BR),
        (read_isam, _ISAM),
        (read_isam, _TORO_3D[1:]),
        (read_isam, _SEEN),
    ],
)
def test_every_damage_of_a_field_is_refused_with_its_line(
    tmp_path: Path, read: Callable[[Path], PoseGraphProblem], lines: list[str]
) -> None:
    path = tmp_path / "g.txt"
    path.write_text("\n".join(lines) + "\n")
    read(path)  # sound as it is
    for at, line in enumerate(lines):
        fields = line.split()
        for field in range(len(fields)):
            for wrong in ("nan", "inf", "1e999", "x", "-1", "") if field else ("BOGUS", "EQUIV"):
                if wrong == "-1" and (field > 2 or (field > 1 and "VERTEX" in line)):
                    continue  # a number may be negative; information is tried below
                broken = [*fields[:field], wrong, *fields[field + 1 :]]
                path.write_text("\n".join([*lines[:at], " ".join(broken), *lines[at + 1 :]]) + "\n")
                with pytest.raises(DataError, match=rf"g\.txt:{at + 1}: "):
                    read(path)
        path.write_text("\n".join([*lines[:at], line + " 7", *lines[at + 1 :]]))
        with pytest.raises(DataError, match=rf"g\.txt:{at + 1}: "):
            read(path)


@pytest.mark.parametrize(
    ("read", "lines", "message"),
    [
        (read_toro, ["EDGE2 0 1 1 0 0 1 2 1 1 0 0"], "not positive"),
        (read_toro, ["EDGE2 0 1 1 0 0 0 0 0 0 0 0"], "zero"),
        (read_toro, ["EDGE2 3 3 1 0 0 1 0 1 1 0 0"], "itself"),
        (read_toro, ["VERTEX2 0 0 0 0", "VERTEX3 1 0 0 0 0 0 0"], "plane"),
        (read_toro, ["VERTEX2 0 0 0 0", "VERTEX2 0 1 0 0"], "given other values"),
        (read_toro, ["TRIANGLE 0 1"], "TRIANGLE"),
        (read_toro, ["# nothing"], "no poses"),
        (read_isam, ["ODOMETRY 0 1 1 0 0 0 0 0 0 0 0"], "zero"),
        (read_isam, ["ODOMETRY 0 1 1 0 0 1e200 0 0 1 0 1"], "not finite"),
        (read_isam, ["LANDMARK 0 1 1 0 1 0 1"], "landmarks are known in the plane alone"),
        (read_isam, [_ISAM[0], _TORO_3D[1]], "plane"),
        (read_isam, [f"EDGE3 0 1 1 0 0 0 {np.pi / 2!r} 0 " + "1 " * 21], "pitch"),
    ],
)
def test_what_is_no_pose_graph_is_refused(
    tmp_path: Path, read: Callable[[Path], PoseGraphProblem], lines: list[str], message: str
) -> None:
    path = tmp_path / "g.txt"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=message):
        read(path)


def test_any_bytes_are_read_or_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    kept = (_TORO, read_toro), (_ISAM, read_isam), (_BR, read_toro), (_SEEN, read_isam)
    path = tmp_path / "g.txt"
    refused = 0
    for _ in range(400):
        for lines, read in kept:
            text = ("\n".join(lines) + "\n").encode()
            damaged = bytearray(text)
            for at in rng.integers(0, len(text), 3):
                damaged[at] = rng.integers(0, 256)
            path.write_bytes(bytes(damaged[: rng.integers(1, len(text) + 1)]))
            try:
                read(path)
            except VislamError:
                refused += 1
    assert refused > 800


def test_what_a_format_cannot_hold_is_not_lost_silently(tmp_path: Path) -> None:
    problem = _graph("sphere")
    fixed = replace(problem, fixed=np.arange(len(problem.ids)) == 3)
    for write in (write_toro, write_isam):
        with pytest.raises(UsageError, match="fixed"):
            write(fixed, tmp_path / "g")
    flat = problem.information.copy()
    flat[2] = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    with pytest.raises(UsageError, match="singular"):
        write_isam(replace(problem, information=flat), tmp_path / "g")
    with pytest.raises(StorageError):
        write_toro(problem, tmp_path / "nowhere" / "g.toro")
    assert not list(tmp_path.iterdir())
