"""Vision is lost in the middle of a recording: what the run makes of it, end to end."""

import csv
from itertools import groupby

import numpy as np
import pytest

from vislam.config import load
from vislam.core.geometry import invert, so3_log
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.sim.points.points import open_points
from vislam.trajectory import read_tum

BLIND = {"rig": "rgbd", "camera_hz": 10.0, "outage_begin_s": 10.0, "outage_length_s": 3.0}
FILES = ("trajectory_ekf.tum", "trajectory_live.tum", "trajectory_graph.tum", "loops.csv", "tracking.csv")


def run(out, **settings):
    """Turn about for 22 s; the camera is covered while it turns by 120 degrees."""
    prepare(out, overwrite=False)
    recording = open_points("turn-in-place", 3, duration_s=22.0, **BLIND)
    config = load(None, {"view.enabled": False, "map.enabled": False, **settings})
    return execute(recording, config, out, "test", [])


def tracking(out):
    with (out / "tracking.csv").open() as file:
        return list(csv.DictReader(file))


def worst_turn_deg(out):
    """The largest error of rotation since the first frame."""
    estimate = read_tum(out / "trajectory_graph.tum")
    truth = read_tum(out / "trajectory_truth.tum").at(estimate.t_ns)
    seen = [row["tracking"] != "lost" for row in tracking(out)]
    turns = [
        so3_log(np.ascontiguousarray((invert(invert(truth[0]) @ b) @ invert(estimate.T_world_body[0]) @ a)[:3, :3]))
        for a, b in zip(estimate.T_world_body[seen], truth[seen], strict=True)
    ]
    return float(np.rad2deg(np.linalg.norm(turns, axis=1).max()))


@pytest.fixture(scope="module")
def without_imu(tmp_path_factory):
    out = tmp_path_factory.mktemp("lost") / "run"
    return out, run(out, **{"imu.enabled": False})


def test_without_an_imu_a_new_submap_begins_and_is_joined_within_half_a_second(without_imu):
    out, metrics = without_imu
    assert metrics["counters"]["front"]["submaps"] == 2
    assert metrics["counters"]["localisation"]["relocalised"] == 1
    rows = tracking(out)
    states = [(key, len(list(group))) for key, group in groupby(row["localisation"] for row in rows)]
    assert [state for state, _ in states] == ["tracking", "lost", "relocalised", "tracking"]
    assert 30 <= states[1][1] <= 36  # the three seconds, and what it takes to recognise the place
    assert [row["submap"] for row in rows] == ["0"] * rows.index(next(r for r in rows if r["submap"] == "1")) + [
        "1" for row in rows if row["submap"] == "1"
    ]
    assert worst_turn_deg(out) < 1.0
    assert metrics["accuracy"]["graph"]["ate_max_m"] < 0.05


def test_the_imu_bridges_the_same_loss(tmp_path):
    metrics = run(tmp_path / "run")
    assert metrics["counters"]["front"]["submaps"] == 1
    assert {row["submap"] for row in tracking(tmp_path / "run")} == {"0"}
    assert "lost" in {row["localisation"] for row in tracking(tmp_path / "run")}
    assert worst_turn_deg(tmp_path / "run") < 1.0


def test_a_bound_of_nothing_lets_no_dead_reckoning_pass(tmp_path):
    metrics = run(tmp_path / "run", **{"ekf.submap_sigma_m": 1e-6})
    assert metrics["counters"]["front"]["submaps"] == 2
    assert metrics["counters"]["localisation"]["relocalised"] == 1
    assert worst_turn_deg(tmp_path / "run") < 1.0


def test_what_was_lost_and_found_again_replays_to_the_same_bytes(without_imu, tmp_path):
    out, _ = without_imu
    run(tmp_path / "again", **{"imu.enabled": False})
    for name in FILES:
        assert (out / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
