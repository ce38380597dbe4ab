"""The README's table says what the runs' metrics say, and keeps rows that failed."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

_PATH = Path(__file__).resolve().parent.parent / "experiments" / "readme_table.py"
_SPEC = importlib.util.spec_from_file_location("readme_table", _PATH)
readme_table = importlib.util.module_from_spec(_SPEC)
sys.modules["readme_table"] = readme_table  # dataclasses look their module up
_SPEC.loader.exec_module(readme_table)

ENTRY = readme_table.Entry("desk", "TUM fr1_desk, 20 s", "tum:desk")
METRICS = {
    "mode": "stereo",
    "has_imu": True,
    "keyframes": 85,
    "realtime_factor": 1.337,
    "cost": {"cpu_ms_per_frame": 41.7, "peak_memory_mb": 803.2, "first_pose_s": 0.0, "first_pose_cpu_s": 1.26},
    "loops": {"candidates": 40, "accepted": 7, "pending": 1, "rejected": 32},
    "accuracy": {
        "ekf": {"ate_rmse_m": 0.1234, "coverage": 1.0, "scale": 1.0},
        "batch": {"ate_rmse_m": 0.0191, "coverage": 1.0, "scale": 1.0},
        "graph": {"ate_rmse_m": 0.0216, "coverage": 0.996, "scale": 1.003},
    },
}


def cells(metrics):
    return readme_table.row(readme_table.Outcome(ENTRY, metrics))


def test_row_holds_the_measured_numbers():
    assert cells(METRICS) == [
        "TUM fr1_desk, 20 s", "stereo, inertial", "0.019", "0.022", "0.123", "85", "7 of 40", "1.34", "42",
        "803", "0.00 (1.3 CPU)", "100 %",
    ]  # fmt: skip


def test_row_without_imu_or_truth_and_with_wrong_scale():
    visual = METRICS | {"has_imu": False, "mode": "rgbd"}
    assert cells(visual)[1:5] == ["rgbd", "0.019", "0.022", "0.123 (odometry)"]
    assert cells(METRICS | {"accuracy": {}})[2:5] == ["–", "–", "–"]
    drifted = {"graph": METRICS["accuracy"]["graph"] | {"scale": 1.08}}
    assert cells(METRICS | {"accuracy": drifted})[3] == "0.022 (scale 1.080)"
    assert cells({})[5:] == ["–", "– of –", "–", "–", "–", "– (– CPU)", "–"]


def test_an_error_that_may_be_of_the_truth_has_the_error_of_the_truth_beside_it():
    blurred = METRICS | {"truth": {"error_m": 0.0105}}
    assert cells(blurred)[2:5] == ["0.019 (truth 0.011)", "0.022", "0.123"]
    assert cells(METRICS | {"truth": {}})[2:5] == cells(METRICS)[2:5]


def test_table_keeps_rows_that_failed():
    failed = readme_table.Outcome(ENTRY, None, "exit code 4: vislam: lost | no pose")
    lines = readme_table.table([readme_table.Outcome(ENTRY, METRICS), failed]).splitlines()
    assert len(lines) == 4
    assert {line.count("|") for line in lines} == {len(readme_table.COLUMNS) + 1}
    assert "exit code 4: vislam: lost / no pose" in lines[3]


def test_missing_recording_is_said_without_running_anything(tmp_path):
    outcome = readme_table.measure(ENTRY, tmp_path / "out", tmp_path)
    assert (outcome.metrics, outcome.failure) == (None, "recording missing")
    assert not (tmp_path / "out").exists()


def test_finished_runs_are_reused_and_damaged_ones_said(tmp_path):
    (tmp_path / "desk").mkdir()
    out = tmp_path / "out"
    out.mkdir()
    (out / "metrics.json").write_text(json.dumps(METRICS))
    assert readme_table.measure(ENTRY, out, tmp_path, reuse=True).metrics == METRICS
    (out / "metrics.json").write_text("{")
    assert readme_table.measure(ENTRY, out, tmp_path, reuse=True).failure.startswith("metrics.json: ")


def test_a_run_that_fails_tells_its_exit_code_and_last_line(tmp_path):
    (tmp_path / "desk").mkdir()  # an empty folder is no recording
    outcome = readme_table.measure(ENTRY, tmp_path / "out", tmp_path)
    assert outcome.metrics is None
    assert outcome.failure.startswith("exit code 3: ")


def test_only_the_block_between_the_markers_is_replaced():
    readme = f"# vislam\n\n{readme_table.BEGIN}\nold\n{readme_table.END}\n\nMore.\n"
    text = readme_table.replace_block(readme, "| new |\n")
    assert text == f"# vislam\n\n{readme_table.BEGIN}\n| new |\n{readme_table.END}\n\nMore.\n"
    assert readme_table.replace_block(text, "| new |\n") == text
    for wrong in ("no markers", readme_table.END + readme_table.BEGIN, readme + readme):
        with pytest.raises(ValueError, match="README needs"):
            readme_table.replace_block(wrong, "")
