"""The whole pipeline on points: every mode, map and viewer on, and nothing minds that there are no images."""

import json
from pathlib import Path

import pytest

from vislam.cli import run_verb


@pytest.mark.parametrize("rig", ["stereo", "rgbd"])
def test_points_run_from_end_to_end(tmp_path: Path, rig: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert run_verb(["run", f"points:handheld-room,rig={rig},duration_s=6", "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    accuracy = metrics["accuracy"]
    assert metrics["mode"] == rig and metrics["frames"] == metrics["frames_expected"]
    assert accuracy["graph"]["ate_rmse_m"] < 0.02 and accuracy["graph"]["coverage"] > 0.9
    assert (out / "report.html").is_file() and (out / "run.rrd").stat().st_size > 1000
    assert "graph, final" in capsys.readouterr().out


def test_points_that_do_not_exist_end_with_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(["run", "points:laps,tracks=-3", "--out", str(tmp_path / "run")]) == 2
    assert "option tracks" in capsys.readouterr().err
    assert run_verb(["doctor", "points:laps"]) in (0, 2)
    assert "Traceback" not in capsys.readouterr().err
