"""g2o files: exact, strict, and never a traceback."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vislam.batch.posegraph.g2o import read_g2o, write_g2o
from vislam.batch.posegraph.tagged_lines import read_tagged_lines
from vislam.core.errors import DataError

_INFO_3D = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 4 0 0 4 0 4"
_SPACE = [
    "VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1",
    "VERTEX_SE3:QUAT 7 1 0 0 0 0 0.5 0.8660254037844386",
    f"EDGE_SE3:QUAT 3 7 1 0.5 0 0 0 0.5 0.8660254037844386 {_INFO_3D}",
]
_PLANE = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 2 3", "EDGE_SE2 0 1 1 2 3 1 2 3 40 5 60"]


def _written(folder: Path, lines: list[str]) -> Path:
    path = folder / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_orders_of_poses_and_information(tmp_path: Path) -> None:
    space = read_g2o(_written(tmp_path, _SPACE))
    assert space.ids.tolist() == [3, 7]
    assert space.edges.tolist() == [[0, 1]]
    assert np.array_equal(np.diag(space.information[0]), [4, 4, 4, 1, 1, 1])
    assert np.allclose(space.measurements[0, :2, :2], [[0.5, -(0.75**0.5)], [0.75**0.5, 0.5]])
    assert space.chi2(space.poses) == pytest.approx(0.25, rel=1e-12)
    plane = read_g2o(_written(tmp_path, _PLANE))
    assert plane.information[0].tolist() == [[60, 3, 5], [3, 1, 2], [5, 2, 40]]
    assert plane.chi2(plane.poses) == pytest.approx(0.0, abs=1e-25)


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    numbers = rng.normal(size=(40, 28)) * 10.0 ** rng.integers(-12, 12, (40, 28))
    lines = []
    for i, row in enumerate(numbers):
        q = row[3:7] / np.linalg.norm(row[3:7])
        pose = " ".join(repr(float(x)) for x in (*row[:3], *q))
        lines += [f"VERTEX_SE3:QUAT {i * i} {pose}", f"EDGE_SE3:QUAT {i * i} {(i + 1) ** 2} {pose} {_INFO_3D}"]
    landmarks = ["VERTEX_TRACKXYZ 9999 1 2 3", "FIX 9999", "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"]
    first = read_g2o(_written(tmp_path, [*lines, *landmarks, "FIX 4 9"]))
    assert first.ids[first.fixed].tolist() == [4, 9, 9999]
    assert first.ids[first.is_point].tolist() == [9999]
    assert first.has_pose.sum() == 41
    again = tmp_path / "again.g2o"
    write_g2o(first, again)
    second = read_g2o(again)
    for name in ("ids", "fixed", "edges", "information"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    for name in ("poses", "measurements"):
        assert np.allclose(getattr(first, name), getattr(second, name), rtol=1e-14, atol=1e-14, equal_nan=True)
    assert np.array_equal(first.is_point, second.is_point)


@given(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(["%r", "%.17g", "%.9e", "%.3f", "%+.18E"]))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_numbers_are_read_as_python_reads_them(tmp_path: Path, value: float, style: str) -> None:
    text = style % value
    if not np.isfinite(float(text)):
        return
    path = _written(tmp_path, [f"VERTEX_SE2 0 {text} -{text.lstrip('+-')} 0", "VERTEX_SE2 1 0 0 0"])
    got = read_tagged_lines(path, {"VERTEX_SE2": (1, 3)}).rows["VERTEX_SE2"].numbers[0, :2]
    assert got.tolist() == [float(text), float("-" + text.lstrip("+-"))]


def test_ids_are_whole_numbers_to_the_last_digit(tmp_path: Path) -> None:
    ids = [2**53 + 1, 2**63 - 2, 2**63 - 1]
    problem = read_g2o(_written(tmp_path, [f"VERTEX_SE2 {i} 0 0 0" for i in ids]))
    assert problem.ids.tolist() == ids


@pytest.mark.parametrize(
    "text", ["nan", "inf", "1e999", "0x10", "1_0", "1.2.3", ".", "-", "1e", "e5", "1,5", "١", "1\0"]
)
def test_what_is_no_number_is_refused_with_its_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError, match=r"graph\.g2o:2: "):
        read_g2o(_written(tmp_path, [_PLANE[0], f"VERTEX_SE2 1 {text} 2 3", _PLANE[2]]))


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (f"EDGE_SE3:QUAT 3 7 1 0 0 0 0 0 1 {_INFO_3D[:-2]}", "ends too early"),
        (f"EDGE_SE3:QUAT 3 7 1 0 0 0 0 0 1 {_INFO_3D} 5", "too much"),
        (f"EDGE_SE3:QUAT 3 7 1 0 0 0 0 0 0 {_INFO_3D}", "norm 0 "),
        (f"EDGE_SE3:QUAT 3 3 1 0 0 0 0 0 1 {_INFO_3D}", "itself"),
        (f"EDGE_SE3:QUAT 3 -7 1 0 0 0 0 0 1 {_INFO_3D}", "not an id"),
        (f"EDGE_SE3:QUAT 3 7.0 1 0 0 0 0 0 1 {_INFO_3D}", "not an id"),
        (f"EDGE_SE3:QUAT 3 99999999999999999999 1 0 0 0 0 0 1 {_INFO_3D}", "not an id"),
        (f"EDGE_SE3:QUAT 3 7 1 0 0 0 0 0 1 -{_INFO_3D}", "not positive"),
        (f"EDGE_SE3:QUAT 3 7 1 0 0 0 0 0 1 1 9{_INFO_3D[3:]}", "not positive"),
        (f"EDGE_SE3:QUAT 3 7 1 0 0 0 0 0 1{' 0' * 21}", "zero"),
        ("VERTEX_SE3:QUAT 3 0 0 1 0 0 0 1", "other values in line 1"),
        ("VERTEX_SE2 9 0 0 0", "one file"),
        ("FIX 8", "there is none"),
        ("FIX x", "needs ids"),
        ("EDGE_OF_MINE 1 2", "no tag that is known"),
        ("EDGE_SE3_TRACKXYZ 3 9 0 1 2", "cut short"),
    ],
)
def test_damage_is_refused_with_its_line(tmp_path: Path, line: str, says: str) -> None:
    with pytest.raises(DataError, match=rf"graph\.g2o:5: .*{says}"):
        read_g2o(_written(tmp_path, [*_SPACE, "# a comment", line]))


def test_what_is_odd_is_told(tmp_path: Path) -> None:
    lines = [
        *_SPACE,
        _SPACE[0],
        _SPACE[2],
        f"EDGE_SE3:QUAT 20 7 1 0 0 0 0 0 1 {_INFO_3D}",
        "",
        "VERTEX_TRACKXYZ 50 1 2 3",
    ]
    problem = read_g2o(_written(tmp_path, lines))
    assert problem.ids.tolist() == [3, 7, 20, 50]
    assert problem.has_pose.tolist() == [True, True, False, True]
    assert len(problem.edges) == 3
    told = " | ".join(problem.notes)
    for word in (
        "1 poses are given twice",
        "1 of 4 poses have no initial value",
        "1 landmarks, seen 0 times, and 0 priors",
        "1 edges join",
    ):
        assert word in told


def test_parts_are_told_apart_and_anchored(tmp_path: Path) -> None:
    edge = "EDGE_SE2 {} {} 1 0 0 1 0 0 1 0 1"
    lines = [edge.format(*ends) for ends in ((5, 6), (1, 2), (6, 9), (2, 3))]
    problem = read_g2o(_written(tmp_path, [*lines, "VERTEX_SE2 30 0 0 0", "FIX 6"]))
    assert problem.components().tolist() == [0, 0, 0, 1, 1, 1, 2]
    assert problem.ids[problem.anchors()].tolist() == [1, 6, 30]


@given(st.binary(max_size=300), st.integers(0, 400), st.integers(0, 50))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=300)
def test_damaged_files_are_read_or_refused(tmp_path: Path, junk: bytes, at: int, drop: int) -> None:
    whole = "\n".join([*_SPACE, "FIX 3"]).encode()
    path = tmp_path / "graph.g2o"
    path.write_bytes(whole[:at] + junk + whole[at + drop :])
    try:
        problem = read_g2o(path)
    except DataError:
        return
    assert np.isfinite(problem.measurements).all()
    assert np.isfinite(problem.information).all()


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"# only a comment", b"\xff\xfe\x00", b"PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"]
)
def test_files_without_poses_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "graph.g2o"
    path.write_bytes(content)
    with pytest.raises(DataError):
        read_g2o(path)
    with pytest.raises(DataError, match="cannot be read"):
        read_g2o(tmp_path)
