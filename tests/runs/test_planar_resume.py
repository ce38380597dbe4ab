"""A run over a floor that was stopped in the middle goes on as if it had not been: pose, tilt of the camera, clock."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import load
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.session import Session, recall
from vislam.runs.sources import open_source
from vislam.trajectory import read_tum

SOURCE = "sim:cart-drive,image_width_px=320,camera_hz=10,exposure_s=0,duration_s=9.5"
TRUE_TILT_DEG = 17.54
SETTINGS = {
    "view.enabled": False, "map.enabled": False, "frontend.planar.height_m": 0.6,
    "frontend.planar.tilt_deg": TRUE_TILT_DEG - 0.5, "frontend.planar.roll_deg": 0.74,
}  # fmt: skip
STOPPED_AT = 70  # of 94 frames: it drives, and has found its tilt


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped after `STOPPED_AT` frames; beside it, what it would have been."""
    folder = tmp_path_factory.mktemp("runs")

    def stop(done: int, total: int, note: str) -> None:
        if done == STOPPED_AT:
            shutil.copytree(folder / "whole", folder / "stopped")  # as a power cut leaves it

    prepare(folder / "whole", overwrite=False)
    execute(open_source(SOURCE), load(None, SETTINGS), folder / "whole", SOURCE, [], stop)
    return folder / "stopped"


def test_a_stopped_run_goes_on_with_tilt_and_clock(stopped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = recall(Session(stopped / "session.db"))
    assert before is not None and before.front.learned.tilt is not None
    whole = json.loads((stopped.parent / "whole" / "metrics.json").read_text())
    assert run_verb(["run", "--resume", str(stopped), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    (resumed,) = metrics["resumed"]
    assert resumed["keyframe"] == before.front.keyframe_id
    assert metrics["mode"] == "planar" and metrics["frames"] == metrics["frames_expected"] == whole["frames"]
    assert metrics["coverage_frames"] == pytest.approx(whole["coverage_frames"], abs=0.02)
    assert abs(metrics["keyframes"] - whole["keyframes"]) <= 0.1 * whole["keyframes"]

    found, undisturbed = metrics["calibration"], whole["calibration"]
    print({name: (round(undisturbed[name], 4), round(found[name], 4)) for name in found})
    assert found["tilt_deg"] == pytest.approx(TRUE_TILT_DEG, abs=0.15)
    assert found["tilt_deg"] == pytest.approx(undisturbed["tilt_deg"], abs=2.0 * undisturbed["tilt_sigma_deg"])
    assert found["tilt_sigma_deg"] == pytest.approx(undisturbed["tilt_sigma_deg"], rel=0.3)  # 0.5 deg when it forgot
    assert found["camera_offset_s"] == pytest.approx(undisturbed["camera_offset_s"], abs=0.004)

    errors_m = [run["accuracy"]["graph"]["ate_rmse_m"] for run in (whole, metrics)]
    print("ATE [m]: undisturbed, resumed", errors_m)
    assert errors_m[1] < max(1.5 * errors_m[0], 0.02)
    trajectories = [read_tum(run / "trajectory_graph.tum") for run in (stopped.parent / "whole", stopped)]
    apart_m = np.linalg.norm(trajectories[0].positions_m[-1] - trajectories[1].positions_m[-1])
    assert apart_m < 0.08
    counters = metrics["counters"]
    assert counters["front"]["frames_lost"] <= 2 and counters["front"]["submaps"] == 1
    assert counters["ekf"]["vo_no_keyframe"] == 0 and counters["ekf"]["soft_resets"] == 0
    assert counters["ekf"]["vo_accepted"] >= 0.8 * (whole["frames"] - STOPPED_AT)
