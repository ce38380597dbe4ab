"""Inertial dead reckoning, visual odometry and both fused, as estimators of one plan."""

import csv
from pathlib import Path

import numpy as np
import pytest
from tiny import jobs_here

from browser import is_readable_on_a_phone_and_on_paper
from vislam.cli import run_verb
from vislam.config import load
from vislam.experiment.jobs import expand
from vislam.experiment.plan import load_plan
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import open_source
from vislam.trajectory import read_tum

PLAN = Path(__file__).parents[2] / "experiments" / "imu_vision_fused.toml"
SHORT = """
name = "short"
config = {"loop.enabled" = false}
members = 1

[[sequences]]
name = "blind"
source = "points:laps"
options = {rig = "rgbd", duration_s = 10.0, tracks = 60, camera_hz = 10.0, outage_begin_s = 6.0, outage_length_s = 1.5}
"""


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fused")
    text = PLAN.read_text()
    (folder / "short.toml").write_text(SHORT + text[text.index("[[estimators]]") :])
    places = ["--store", str(folder / "r.db"), "--cache", str(folder / "cache"), "--out", str(folder / "out")]
    with jobs_here():
        assert run_verb(["compare", str(folder / "short.toml"), *places]) == 0
    return folder / "out"


def test_the_plan_asks_all_three_of_the_same_measurements():
    jobs = expand(load_plan(PLAN))
    by_estimator = {}
    for job in jobs:
        by_estimator.setdefault(job.estimator, set()).add((job.sequence, job.source, job.seed))
    assert set(by_estimator) == {"IMU alone", "vision alone", "fused"}
    assert by_estimator["IMU alone"] == by_estimator["vision alone"] == by_estimator["fused"]


def test_fused_is_better_than_an_imu_alone_and_than_a_camera_that_is_blind_for_a_while(compared):
    rows = {(row["estimator"], row["output"]): row for row in csv.DictReader((compared / "runs.csv").open())}
    assert all(row["status"] == "ok" for row in rows.values())
    fused = float(rows["fused", "ekf"]["ate_m"])
    assert fused < 0.5 * float(rows["IMU alone", "ekf"]["ate_m"])
    assert fused < 0.5 * float(rows["vision alone", "ekf"]["ate_m"])


def test_the_report_shows_the_way_the_errors_and_their_rms_from_the_same_start(compared):
    page = (compared / "report.html").read_text()
    section = page[page.index("From the same start") : page.index("Consistency")]
    assert section.count("<svg") == 3
    for part in ("IMU alone filter, causal", "vision alone odometry, causal", "fused graph, final", "yaw", "x [m]"):
        assert part in section


def test_a_filter_without_vision_hears_nothing_of_the_camera_after_its_start(tmp_path):
    options = "rig=stereo,duration_s=6,camera_hz=10,tracks=40,descriptors=false"
    quiet = {"map.enabled": False, "view.enabled": False, "loop.enabled": False, "ekf.vision": "none"}
    ways = {}
    for name, fault in (("seeing", ""), ("blind", ",outage_begin_s=4,outage_length_s=2")):
        source = f"points:cart-drive,{options}{fault}"
        prepare(tmp_path / name, overwrite=False)
        execute(open_source(source), load(None, quiet), tmp_path / name, source, [])
        ways[name] = read_tum(tmp_path / name / "trajectory_ekf.tum")
    np.testing.assert_array_equal(ways["seeing"].T_world_body, ways["blind"].T_world_body)
    live = [read_tum(tmp_path / name / "trajectory_live.tum").T_world_body for name in ways]
    assert len(live[0]) != len(live[1]) or not np.array_equal(*live)  # the graph does hear of it


def test_the_report_is_readable_on_a_phone_and_on_paper(compared, chromium):
    is_readable_on_a_phone_and_on_paper(chromium, compared / "report.html")
