"""Line drawings of the graph report."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from vislam.runs.report.drawing import Axis, Lines, as_file, drawing, stacked

SQUARE = np.array([[[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]]])


def drawn(text: str, color: str) -> list[np.ndarray]:
    """Return the polylines [P, 2] of a colour, in the picture's units."""
    root = ElementTree.fromstring(text)
    paths = [p.get("d") for p in root.iter() if p.tag.endswith("path") and p.get("stroke") == f"var(--{color})"]
    return [np.array(re.findall(r"(-?\d+) (-?\d+)", line), dtype=float) for d in paths for line in d.split("M")[1:]]


def ticks(text: str) -> list[str]:
    return [t.text for t in ElementTree.fromstring(text).iter() if t.tag.endswith("text")]


def test_with_the_same_scale_a_square_is_a_square_and_y_is_up() -> None:
    (at,) = drawn(drawing([Lines(SQUARE, "graph", 1.0)], Axis("x"), Axis("y"), height_pt=230, same_scale=True), "graph")
    width, height = at[1] - at[0], at[2] - at[1]
    assert width[0] == pytest.approx(-height[1], abs=2)
    assert width[1] == height[0] == 0
    assert width[0] > 1000


def test_everything_lies_inside_of_the_frame() -> None:
    rng = np.random.default_rng(1)
    lines = [Lines(rng.normal(size=(50, 2, 2)) * [1e3, 1e-3], "muted", 0.4), Lines(SQUARE, "graph", 1.0)]
    text = drawing(lines, Axis("x"), Axis("y"), height_pt=338)
    at = np.concatenate(drawn(text, "muted") + drawn(text, "graph"))
    assert at.min(axis=0) == pytest.approx([480 + 121, 70 + 105], abs=5)  # the margin: 0.04 of 1.08
    assert at.max(axis=0) == pytest.approx([3890 - 121, 3020 - 105], abs=15)


def test_ticks_are_round_numbers_and_whole_ones_where_asked_for() -> None:
    curve = np.array([[[0.0, 1.0], [2.0, 5000.0]]])
    text = drawing([Lines(curve, "graph", 1.0)], Axis("n", whole=True), Axis("chi", log=True), height_pt=230)
    assert ticks(text) == ["0", "1", "2", "1", "10", "100", "1000", "n", "chi"]
    narrow = np.array([[[0.0, 45.0], [2.0, 47.9]]])
    text = drawing([Lines(narrow, "graph", 1.0)], Axis("n"), Axis("chi", log=True), height_pt=230)
    assert ticks(text)[-5:] == ["45", "46", "47", "n", "chi"] or "46" in ticks(text)


def test_what_is_not_finite_is_left_out() -> None:
    lines = np.array([[[0.0, 0.0], [1.0, np.nan]], [[0.0, 0.0], [1.0, 1.0]]])
    assert len(drawn(drawing([Lines(lines, "bad", 1.0)], Axis("x"), Axis("y"), height_pt=230), "bad")) == 1


@pytest.mark.parametrize("points", [np.empty((0, 2, 2)), np.full((1, 2, 2), 7.0), np.full((1, 2, 2), np.inf)])
def test_nothing_or_a_dot_gives_a_picture(points: np.ndarray) -> None:
    text = drawing([Lines(points, "graph", 1.0)], Axis("x"), Axis("y"), height_pt=230)
    assert len(ticks(text)) >= 4
    assert "nan" not in text


def test_a_line_is_broken_where_it_is_not_finite_and_ends_at_the_frame() -> None:
    line = np.array([[[0.0, 0.0], [1.0, 9.0], [2.0, np.nan], [3.0, 1.0], [4.0, 2.0]]])
    text = drawing([Lines(line, "graph", 1.0)], Axis("x"), Axis("y", ends=(0.0, 2.0)), height_pt=230)
    first, second = drawn(text, "graph")
    assert [len(first), len(second)] == [2, 2]
    assert first[1, 1] == second[1, 1] == 70.0  # 9 is drawn where 2 is: at the upper edge


def test_labels_stand_above_in_rows_and_names_in_place_of_ticks() -> None:
    labels = [f"an estimate of {k}" for k in range(6)]
    lines = [Lines(SQUARE, "graph", 1.0, label=label) for label in labels]
    text = drawing(lines, Axis("", ends=(0.0, 4.0)), Axis("", names=("<track>", "loop")), height_pt=230)
    words = [t for t in ElementTree.fromstring(text).iter() if t.tag.endswith("text")]
    assert [t.text for t in words] == ["<track>", "loop", *labels]
    rows = sorted({float(t.get("y")) for t in words[2:]})
    assert len(rows) == 2 and min(at[:, 1].min() for at in drawn(text, "graph")[:1]) > rows[-1]
    assert all(float(t.get("x")) + 47 * len(t.text) < 3960 for t in words[2:])


def test_drawings_are_stacked_and_as_files_have_colours_of_their_own() -> None:
    one = drawing([Lines(SQUARE, "graph", 1.0)], Axis("x"), Axis("y"), height_pt=100)
    assert (both := ElementTree.fromstring(stacked([one, one]))).get("viewBox") == "0 0 3960 2000"
    assert [g.get("transform") for g in both if g.get("transform")] == ["translate(0 0)", "translate(0 1000)"]
    assert "var(" not in as_file(one) and len(re.findall('stroke="#[0-9a-f]{6}"', as_file(one))) == 3
