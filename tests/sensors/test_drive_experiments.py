"""experiments/gtsam_drives.py on tables whose truth is known, and the arithmetic of cart_wheels.py."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from vislam.cli import run_verb
from vislam.core import so3_exp, transform
from vislam.trajectory import Trajectory


def experiment(name: str):
    path = Path(__file__).parents[2] / "experiments" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their annotations up there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def drives():
    return experiment("gtsam_drives")


@pytest.fixture(scope="module")
def cart():
    return experiment("cart_wheels")


def test_holes_that_were_filled_by_straight_lines_are_not_measured(drives):
    rng = np.random.default_rng(1)
    t_s = np.cumsum(rng.uniform(0.009, 0.011, 400))
    values = rng.normal(size=(400, 6))
    share = (t_s[101:260] - t_s[100]) / (t_s[260] - t_s[100])
    values[101:260] = values[100] + share[:, None] * (values[260] - values[100])
    kept = drives.measured(t_s, values)
    assert not kept[101:260].any()
    assert kept[:101].all()
    assert kept[260:].all()


def tables(folder: Path) -> Path:
    """Write tables as GTSAM has: of a robot that stands, then drives, and of a car that drives from the first on."""
    rng, begin_s = np.random.default_rng(3), 1000.0
    t_s = begin_s + np.arange(300) * 0.2
    speed, rate = (
        np.where(t_s < begin_s + 10.0, 0.0, 1.5),
        np.where(t_s < begin_s + 10.0, 0.0, 0.1 + 0.05 * np.sin(t_s)),
    )
    yaw = np.cumsum(rate) * 0.2
    places = 0.2 * np.cumsum(speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    anchors = np.array([[1, -30.0, 5.0], [2, 25.0, -10.0], [3, 10.0, 40.0], [6, -15.0, -35.0]])
    which = np.arange(300) % 4
    ranges = 1.07 * np.linalg.norm(places - anchors[which, 1:], axis=1) + rng.normal(0.0, 0.1, 300)
    savemat(
        folder / "Plaza1_.mat",
        {
            "DR": np.column_stack([t_s, 0.2 * speed, 0.2 * rate]),
            "TD": np.column_stack([t_s, np.zeros(300), anchors[which, 0], ranges]),
            "GT": np.column_stack([t_s, places, yaw]), "TL": anchors,
        },
    )  # fmt: skip
    s = begin_s + np.arange(0, 3500) * 0.01
    speed, rate = 8.0 + 2.0 * np.sin(0.3 * s), 0.25 * np.sin(0.4 * s)
    yaw = np.cumsum(rate) * 0.01
    places = 0.01 * np.cumsum(speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw]), axis=0)
    felt = np.column_stack([0.6 * np.cos(0.3 * s), speed * rate, 0.0 * s + 9.81, 0.0 * s, 0.0 * s, rate])
    felt += rng.normal(size=felt.shape) * np.repeat([0.02, 0.001], 3)
    save(folder / "KittiEquivBiasedImu.txt", np.column_stack([s, 0.01 + 0.0 * s, felt]), " ")
    save(folder / "KittiEquivBiasedImu_metadata.txt", [np.r_[np.zeros(6), 2e-3, 1e-4, 0.0, 1e-4, 1e-5, 0.01]], " ")
    at = np.r_[100, np.arange(400, 3300, 100)]
    save(folder / "KittiGps_converted.txt", np.column_stack([s[at], places[at]]), ",")
    return folder


def save(path: Path, rows: object, delimiter: str) -> None:
    np.savetxt(path, rows, header="names", delimiter=delimiter, comments="", fmt="%.9f")


@pytest.mark.parametrize(
    ("name", "files", "most_m", "options"),
    [
        ("plaza", ("sensors.toml",), 0.5, ["--machine.slip-sigma-m-s", "0.05", "--machine.floor-sigma-m", "0.02"]),
        ("kitti", ("sensors.toml", "car.toml"), 0.3, []),
    ],
)
def test_a_drive_of_tables_is_a_plain_run(drives, tmp_path, name, files, most_m, options):
    folder = tables(tmp_path)
    drives.write(drives.plaza(folder, 1) if name == "plaza" else drives.kitti(folder), tmp_path / name)
    for file in files:
        out = tmp_path / f"run-{file}"
        sensors = ["--sensors.file", str(tmp_path / name / file), "--view.no-enabled"]
        assert run_verb(["run", str(tmp_path / name), "--out", str(out), *sensors, *options]) == 0
        accuracy = json.loads((out / "metrics.json").read_text())["accuracy"]["graph"]
        assert accuracy["ate_rmse_m"] < most_m


def test_a_cut_takes_the_fixes_of_a_minute_and_keeps_them_as_the_truth(drives, tmp_path):
    drives_fixes = drives.kitti(tables(tmp_path), cut=5)
    times_s = drives_fixes.readings["gnss"][1][:, 0]
    assert len(times_s) == 5 and len(drives_fixes.truth) == 2 * 29


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
