"""The arithmetic of experiments/kitti_gnss.py, plaza.py and cart_wheels.py, on paths whose errors are known."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from vislam.core.geometry import se3_exp, so3_exp, transform
from vislam.sensors.measuring_frame import frame_pose
from vislam.trajectory import Trajectory


def experiment(name: str):
    path = Path(__file__).parents[2] / "experiments" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their annotations up there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def kitti():
    return experiment("kitti_gnss")


@pytest.fixture(scope="module")
def plaza():
    return experiment("plaza")


@pytest.fixture(scope="module")
def cart():
    return experiment("cart_wheels")


def test_holes_that_were_filled_by_straight_lines_are_not_measured(kitti):
    rng = np.random.default_rng(1)
    t_s = np.cumsum(rng.uniform(0.009, 0.011, 400))
    values = rng.normal(size=(400, 6))
    share = (t_s[101:260] - t_s[100]) / (t_s[260] - t_s[100])
    values[101:260] = values[100] + share[:, None] * (values[260] - values[100])
    kept = kitti.measured(t_s, values)
    assert not kept[101:260].any()
    assert kept[:101].all()
    assert kept[260:].all()


def test_the_tables_have_eight_holes(kitti):
    table = kitti.read()
    gaps_s = np.diff(table.imu_t_ns)[1:] * 1e-9  # the first sample stands 2 s before all others
    assert (gaps_s > 1.0).sum() == 8
    assert gaps_s[gaps_s > 1.0].max() < 1.7
    assert (np.diff(table.t_ns) > 0).all()
    assert table.way_m(1, len(table.t_ns) - 1) == pytest.approx(3686.0, abs=10.0)


def test_errors_are_weighed_by_both_covariances(kitti):
    table = kitti.Table(np.zeros(0), np.zeros((0, 6)), np.arange(3), np.zeros((3, 3)), None)
    path = kitti.Path3([0, 1, 2], [np.zeros(3), np.array([3.0, 0.0, 0.0]), np.ones(3)], [3.0 * np.eye(3)] * 3)
    errors, squares = path.against(table, {1}, sigma_m=1.0)
    assert errors.tolist() == [[-3.0, 0.0, 0.0]]
    assert squares == pytest.approx([9.0 / 4.0])


def test_a_place_among_anchors_has_the_covariance_of_what_it_is_made_of(plaza):
    rng = np.random.default_rng(2)
    own, T = np.array([0.7, 12.0, -5.0, 1.0]), se3_exp(rng.normal(size=6))
    T[:3, 3] = [30.0, -20.0, 0.5]
    root = 1e-4 * rng.normal(size=(10, 10))
    drawn = rng.normal(size=(20_000, 10)) @ root.T
    places = []
    for error in drawn:
        R, t = frame_pose(own + error[6:])
        places.append((R @ (T[:3, 3] + error[3:6]) + t)[:2])
    found = plaza.in_anchors_covariance(own, T, root @ root.T)
    assert np.cov(np.array(places).T) == pytest.approx(found, rel=0.05, abs=1e-9)


def line(turn_rad: float, scale: float) -> Trajectory:
    """Ten seconds along x at a metre a second, seen by somebody who is turned and whose metres are too long."""
    R = so3_exp(np.array([0.0, 0.0, turn_rad]))
    poses = [transform(R, scale * R @ np.array([0.1 * k, 0.0, 0.0])) for k in range(101)]
    return Trajectory(np.arange(101) * 100_000_000, np.array(poses))


def test_a_stretch_is_measured_from_its_own_beginning(cart):
    gone = cart.gone_on(line(0.3, 1.01), line(0.0, 1.0), 4 * 10**9, 9 * 10**9)
    assert gone["way_m"] == pytest.approx(5.0)
    assert gone["error_m"] == pytest.approx(0.05)
    assert gone["share"] == pytest.approx(0.01)


def test_a_whole_path_is_measured_as_it_fits_best(cart):
    assert cart.of_way(line(0.3, 1.0), line(0.0, 1.0))["max_m"] == pytest.approx(0.0, abs=1e-9)
