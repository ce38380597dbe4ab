"""Tables: exact stamps, bounded reading, damage that is counted and where it is told."""

import itertools
from decimal import Decimal
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core import Problems
from vislam.core.errors import DataError
from vislam.datasets.tables import (
    MAX_LINE_BYTES,
    in_time_order,
    parse_ns,
    parse_seconds,
    read_frame_stamps,
    read_names,
    read_numbers,
)


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@given(st.integers(-(2**61), 2**61))
def test_seconds_are_parsed_exactly(t_ns: int) -> None:
    assert parse_seconds(str(Decimal(t_ns) / 10**9)) == t_ns
    assert parse_ns(str(t_ns)) == t_ns


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "", "x", "1e999999999", "1e40", "9" * 5000])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        parse_seconds(text)
    with pytest.raises(ValueError):
        parse_ns(text)


def test_bad_rows_are_skipped_and_their_first_line_named(tmp_path: Path) -> None:
    good = b"".join(b"%d,1.5,2.5\n" % i for i in range(10, 30))
    path = write(tmp_path / "data.csv", b"#t,a,b\n1,1,2\n2,nan,2\n3,x,2\n4,1\n5,inf,1\n\n# note\n" + good)
    problems = Problems()
    rows = list(read_numbers(path, 2, problems))
    assert rows[0] == (1, [1.0, 2.0])
    assert [t for t, _ in rows[1:]] == list(range(10, 30))
    place = f"{tmp_path.name}/data.csv"
    assert problems == {
        f"{place}: rows with NaN or infinity (first: line 3)": 2,
        f"{place}: rows that cannot be read (first: line 4)": 2,
    }


def test_mostly_nan_is_an_error_naming_file_and_line(tmp_path: Path) -> None:
    path = write(tmp_path / "data.csv", b"#t,a\n1,2\n" + b"".join(b"%d,nan\n" % i for i in range(2, 30)))
    with pytest.raises(DataError, match=r"data.csv:3: .* 28 of the 29 rows"):
        list(read_numbers(path, 1, Problems()))


def test_endless_nonsense_is_given_up_early(tmp_path: Path) -> None:
    path = write(tmp_path / "data.csv", b"nonsense\n" * 100_000)
    with pytest.raises(DataError, match="1000 of the 1000 rows"):
        list(read_numbers(path, 1, Problems()))


def test_a_line_without_end_is_refused_without_reading_it(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    with path.open("wb") as file:
        file.write(b"1,2\n" + b"1" * (MAX_LINE_BYTES + 1))
        file.truncate(10 * 2**30)  # sparse: 10 GB that must not be read
    with pytest.raises(DataError, match=r"data.csv:2: a line of 4096 bytes or more"):
        list(read_numbers(path, 1, Problems()))
    with pytest.raises(DataError, match="10737418240 bytes"):
        list(read_names(path, Problems()))


@pytest.mark.parametrize("cut", [b"3,1.5,2", b"3,1.5", b"3", b"3,1.5,2.2"])
def test_a_cut_last_line_is_dropped_even_if_it_reads_as_numbers(tmp_path: Path, cut: bytes) -> None:
    problems = Problems()
    rows = list(read_numbers(write(tmp_path / "d.csv", b"1,1.5,2.25\n2,1.5,2.25\n" + cut), 2, problems))
    assert [t for t, _ in rows] == [1, 2]
    assert problems == {f"{tmp_path.name}/d.csv: last line cut short (first: line 3)": 1}


def test_zero_bytes_of_a_crash_are_told_and_passed_over(tmp_path: Path) -> None:
    problems = Problems()
    path = write(tmp_path / "d.csv", b"1,1.5\n" + b"\0" * 10_000 + b"\n2,2.5\n" + b"\0" * 5000)
    assert list(read_numbers(path, 1, problems)) == [(1, [1.5]), (2, [2.5])]
    assert problems[f"{tmp_path.name}/d.csv: zero bytes (first: line 2)"] >= 2


def test_header_without_comment_sign_and_byte_order_mark(tmp_path: Path) -> None:
    problems = Problems()
    assert list(read_numbers(write(tmp_path / "a.csv", b"time,x\r\n5,1\r\n"), 1, problems)) == [(5, [1.0])]
    assert list(read_numbers(write(tmp_path / "b.csv", b"\xef\xbb\xbf#time,x\n5,1\n"), 1, problems)) == [(5, [1.0])]
    assert problems == {}


def test_names_must_stay_inside_the_recording(tmp_path: Path) -> None:
    rows = b"#t,name\n1,a.png\n2,../../etc/passwd\n3,/etc/passwd\n4,\n5,sub/b.png\n6,c.png\n7,d.png\n"
    problems = Problems()
    assert [name for _, name in read_names(write(tmp_path / "d.csv", rows), problems)] == [
        "a.png", "sub/b.png", "c.png", "d.png",
    ]  # fmt: skip
    assert sum(problems.values()) == 3


def test_a_frame_keeps_its_number_when_a_stamp_before_it_is_bad(tmp_path: Path) -> None:
    path = write(tmp_path / "d.csv", b"timestamp\n10\n2x\n30\n")
    assert list(read_frame_stamps(path, Problems())) == [(10, "0"), (30, "2")]


def test_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="No such file"):
        list(read_numbers(tmp_path / "none.csv", 1, Problems()))


@given(st.lists(st.integers(0, 20), max_size=30))
def test_time_order_is_strict_and_every_row_is_accounted_for(stamps: list[int]) -> None:
    problems = Problems()
    kept = [t for t, _ in in_time_order(((t, None) for t in stamps), problems, "imu")]
    assert all(a < b for a, b in itertools.pairwise(kept))
    assert len(kept) + sum(problems.values()) == len(stamps)


def test_one_stamp_that_leaps_ahead_does_not_cost_the_rest() -> None:
    problems = Problems()
    stamps = [10, 20, 10**18, 30, 40, 35, 40, 50]
    assert [t for t, _ in in_time_order(((t, None) for t in stamps), problems, "imu")] == [10, 20, 30, 40, 50]
    assert problems == {
        f"imu: stamp that leaps ahead (first: {10**18} ns)": 1,
        "imu: backward stamp (first: 35 ns)": 1,
        "imu: duplicate stamp (first: 40 ns)": 1,
    }
