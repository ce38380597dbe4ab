"""Candidates and acceptance rules one by one."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.config import LoopConfig
from vislam.core.geometry import invert, se3_exp, transform_points
from vislam.core.messages import Array, LoopDecision
from vislam.loop.candidates import AppearanceCandidates, islands, odometry_candidates, view_bounds
from vislam.loop.closer import PoseTable
from vislam.loop.verification.likeness import Likeness
from vislam.loop.verification.verifier import Verification, judge, tilt_error_rad
from worlds.landmarks import body_pose, make_rig

CONFIG = LoopConfig()
GOOD = Verification(
    "", 100, 40, 80, np.eye(4), np.eye(6) * 1e-4, True, sigma_m=0.02, reverse_agreement=0.9, depth_agreement=0.9,
)  # fmt: skip


@given(st.dictionaries(st.integers(0, 60), st.floats(0.01, 1.0), max_size=20), st.integers(1, 5))
def test_islands_keep_every_keyframe_and_are_apart(retrieved: dict[int, float], gap: int) -> None:
    ids = list(retrieved)
    found = islands(ids, [retrieved[i] for i in ids], gap)
    members = [[i for i in ids if island.first_id <= i <= island.last_id] for island in found]
    assert sorted(itertools.chain(*members)) == sorted(ids)
    for island, inside in zip(found, members, strict=True):
        assert island.score == pytest.approx(sum(retrieved[i] for i in inside))
        assert retrieved[island.best_id] == max(retrieved[i] for i in inside)
    ordered = sorted(found, key=lambda island: island.first_id)
    assert all(b.first_id - a.last_id > gap for a, b in itertools.pairwise(ordered))


def _like(rigid: int, matches: int = 30, is_alike: bool = True) -> Likeness:
    return Likeness(np.zeros((matches, 2), np.int64), rigid, is_alike)


def test_the_surest_of_each_place_come_first_and_the_unlike_not_at_all() -> None:
    appearance = AppearanceCandidates(max_gap=3)
    likeness = {10: _like(9), 11: _like(12), 12: _like(4, is_alike=False), 40: _like(8), 60: _like(8, matches=50)}
    found = appearance.select([12, 40, 10, 11, 60], [0.9, 0.5, 0.3, 0.2, 0.1], likeness)
    assert [c.id for c in found] == [11, 60, 40, 10]
    assert found[0].score == pytest.approx(1.4)  # of the whole place, what is unlike included


def test_places_that_persist_are_counted() -> None:
    appearance = AppearanceCandidates(max_gap=3)
    likeness = {i: _like(10) for i in (10, 11, 12, 14, 40)}
    appearance.select([10, 11], [0.3, 0.2], likeness)
    second = appearance.select([40, 12], [0.9, 0.2], likeness)
    assert {c.id: c.consistency for c in second} == {12: 1, 40: 0}
    assert [c.consistency for c in appearance.select([14], [0.1], likeness)] == [2]


def _near(T_old: list[Array], T_new: Array, count: int = 5) -> list[int]:
    rig = make_rig()
    T_cam = T_new @ rig.T_body_cams[0]
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 8), np.linspace(-0.45, 0.45, 8))
    points = np.column_stack([x.ravel(), y.ravel(), np.ones(64)]) * 3.0
    cams = np.stack([invert(T @ rig.T_body_cams[0]) for T in T_old])
    found = odometry_candidates(
        transform_points(T_cam, points), T_cam[:3, 3].copy(), np.arange(len(T_old)), cams, view_bounds(rig.cameras[0]),
        count, 0.35, 1,
    )  # fmt: skip
    return [candidate.id for candidate in found]


def test_odometry_candidates_see_the_same_things() -> None:
    new = body_pose((0.0, 0.0, 0.0), 0.0)
    same, shifted = body_pose((0.1, 0.0, 0.0), 0.0), body_pose((0.0, 0.6, 0.0), -5.0)
    turned, opposite = body_pose((0.0, 0.0, 0.0), 90.0), body_pose((6.0, 0.0, 0.0), 180.0)
    far, close = body_pose((-8.0, 0.0, 0.0), 0.0), body_pose((2.3, 0.0, 0.0), 0.0)
    assert _near([turned, shifted, opposite, same, far, close], new) == [3, 1]
    assert _near([same] * 4, new, count=2) == [0, 1]


def test_odometry_candidates_keep_apart() -> None:
    new = body_pose((0.0, 0.0, 0.0), 0.0)
    rig = make_rig()
    cams = np.stack([invert(new @ rig.T_body_cams[0])] * 10)
    points = transform_points(new @ rig.T_body_cams[0], np.array([[0.0, 0.0, 2.0]]))
    found = odometry_candidates(
        points, (new @ rig.T_body_cams[0])[:3, 3].copy(), np.arange(10), cams, view_bounds(rig.cameras[0]), 9, 0.3, 4
    )
    assert [candidate.id for candidate in found] == [0, 4, 8]


@given(st.floats(-180.0, 180.0), st.floats(0.0, 60.0), st.floats(-180.0, 180.0))
def test_tilt_ignores_heading_and_measures_the_rest(yaw: float, tilt: float, axis_deg: float) -> None:
    T_from, T_to = body_pose((1.0, 2.0, 0.0), 40.0, 10.0, -5.0), body_pose((0.0, 1.0, 0.5), -70.0, -3.0, 8.0)
    axis = np.array([np.cos(np.deg2rad(axis_deg)), np.sin(np.deg2rad(axis_deg)), 0.0]) * np.deg2rad(tilt)
    error = se3_exp(np.concatenate([axis, np.zeros(3)])) @ body_pose((3.0, -1.0, 0.2), yaw)  # heading, then a tilt
    measured = invert(T_from) @ error @ T_to
    assert np.rad2deg(tilt_error_rad(measured, T_from, T_to)) == pytest.approx(tilt, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "tilt_deg", "decision", "says"),
    [
        ({}, None, LoopDecision.ACCEPTED, "sigma 2.0 cm"),
        ({}, 2.0, LoopDecision.ACCEPTED, "80 with guided matching"),
        ({"sigma_m": 0.05}, None, LoopDecision.ACCEPTED, "sigma 5.0 cm"),
        ({"sigma_m": 0.5}, None, LoopDecision.REJECTED, "sigma 50 cm"),
        ({"sigma_m": float("nan")}, None, LoopDecision.REJECTED, "sigma nan"),
        ({}, 12.0, LoopDecision.REJECTED, "12.0 deg off gravity"),
        ({"reverse_agreement": 0.2}, None, LoopDecision.REJECTED, "agree the other way round: 20%"),
        ({"depth_agreement": 0.1}, None, LoopDecision.REJECTED, "agree in depth: 10%"),
        (
            {"T_a_b": None, "reason": "too few matches: 5, needs 12"},
            None,
            LoopDecision.REJECTED,
            "too few matches: 5, needs 12",
        ),
        ({"has_scale": False}, None, LoopDecision.ACCEPTED, "direction good to 1.1 deg"),
        ({"has_scale": False, "sigma_m": 0.3}, None, LoopDecision.REJECTED, "17.2 deg,"),
    ],
)
def test_each_rule_decides_with_its_reason(
    change: dict[str, float | None], tilt_deg: float | None, decision: LoopDecision, says: str
) -> None:
    tilt = None if tilt_deg is None else float(np.deg2rad(tilt_deg))
    decided, reason = judge(replace(GOOD, **change), tilt)
    assert decided is decision
    assert says in reason


def _table(poses: dict[int, Array]) -> PoseTable:
    table = PoseTable()
    for keyframe_id, pose in poses.items():
        table.add(keyframe_id, pose)
    return table


def test_the_pose_table_grows_and_refuses_nonsense() -> None:
    table = _table({2 * i: body_pose((float(i), 0.0, 0.0), 0.0) for i in range(200)})
    assert len(table) == 200
    assert table.ids.tolist() == list(range(0, 400, 2))
    assert table[398][0, 3] == 199.0
    for keyframe_id, pose in ((398, np.eye(4)), (500, np.full((4, 4), np.nan))):
        with pytest.raises(ValueError, match=f"keyframe {keyframe_id}"):
            table.add(keyframe_id, pose)
