"""`vislam calibrate rgbd`: what it writes is read back, and what a recording does not tell is refused."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.calibration.cameras import rgbd
from vislam.calibration.options import RgbdOptions
from vislam.cli import run_verb
from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.datasets import survey
from vislam.datasets.calibration import read_camera
from vislam.datasets.images import DepthFormat
from vislam.datasets.rgbd import PlaceFit, RgbdFacts
from vislam.datasets.rgbd.facts import OddValue
from vislam.vision.depth_edges import EdgeAlignment
from vislam.vision.depth_focal import FocalFit
from vislam.vision.depth_registration import DepthCamera


def write_folder(folder: Path, frames: int = 3) -> Path:
    """A TUM folder of a camera of fr1 that sees a wall."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i in range(frames):
        cv2.imwrite(str(folder / "rgb" / f"{i}.png"), np.full((480, 640), 90, np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.full((480, 640), 9000 + i, np.uint16))
    for name in ("rgb", "depth"):
        (folder / f"{name}.txt").write_text("".join(f"{1000 + i / 30:.6f} {name}/{i}.png\n" for i in range(frames)))
    return folder


def facts(offset_px: tuple[float, float], lag_s: float, factor: float) -> RgbdFacts:
    tried = np.linspace(-10.0, 10.0, 21)
    bump = 1.0 + np.exp(-(tried**2))
    edges = EdgeAlignment(
        np.array(offset_px), np.full(2, 0.3), lag_s, 0.002, 9000, 1.8, np.array([bump, bump]), tried, bump, tried
    )
    return RgbdFacts((), 1.5, edges, FocalFit(factor, 0.004, 0.02, 0.001, np.zeros(2), 0.0, 40, 4000, 9.0), 300)


def test_what_is_measured_twice_is_written_once_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_folder(tmp_path / "fr1")
    answers = [
        replace(facts((6.4, -3.0), 0.030, 0.90), odd_values=(OddValue(9000, 0.3, False),)),
        facts((1.0, 0.1), 0.006, 1.02),  # what is left once depth is moved by 6 and -3 px
    ]
    seen = []

    def measured(found, rig, frames):
        seen.append((found.depth_format, rig.cameras[0].fx))
        return answers[len(seen) - 1]

    monkeypatch.setattr(rgbd, "rgbd_facts", measured)
    outcome = rgbd.calibrate_rgbd(RgbdOptions(str(source), out=tmp_path / "out"))
    told = 517.306408
    assert seen[1] == (DepthFormat(5000.0, (9000,), (6.4, -3.0), -0.030), pytest.approx(told * 0.9))
    read = read_camera(tmp_path / "out" / "sensor.yaml")
    assert read.camera.fx == pytest.approx(told * 0.9 * 1.02)
    assert read.camera.fy / read.camera.fx == pytest.approx(516.469215 / told)
    how = read.depth.over(DepthFormat())
    assert how.units_per_m == 5000.0 and how.invalid == (9000,)
    assert how.offset_px == pytest.approx((7.0, -3.0)) and how.time_offset_s == pytest.approx(-0.036)
    (source / "sensor.yaml").write_text((tmp_path / "out" / "sensor.yaml").read_text())
    assert survey(str(source)).depth_format == how
    report = json.loads((tmp_path / "out" / "rgbd.json").read_text())
    assert report["focal_sigma"] == 0.004 and not report["units_known"]
    assert any("unit of depth cannot be found" in line for line in outcome.lines)
    assert {path.name for path in outcome.files} == {"sensor.yaml", "rgbd.png", "rgbd.json"}
    with pytest.raises(UsageError, match="already holds"):
        rgbd.calibrate_rgbd(RgbdOptions(str(source), out=tmp_path / "out"))


def test_depth_with_a_lens_of_its_own_is_placed_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_folder(tmp_path / "fr1")
    keys = "resolution: [640, 480]\nintrinsics: [600, 600, 320, 240]\n"
    (source / "depth" / "sensor.yaml").write_text(f"{keys}T_color_depth: {np.eye(4).tolist()}\n")
    T = np.eye(4)
    T[0, 3] = 0.05
    lens = Camera(640, 480, 590.0, 590.0, 320.0, 240.0)
    how = DepthFormat(5000.0, time_offset_s=-0.02, own=DepthCamera(lens, T))
    sigmas = np.full(3, 0.001), np.array([0.001, 0.001, 0.02])
    monkeypatch.setattr(rgbd, "fit_place", lambda found, rig: PlaceFit(how, *sigmas, 0.002, 0.001, 9000))
    monkeypatch.setattr(rgbd, "rgbd_facts", lambda found, rig, frames: facts((3.0, 0.0), 0.03, 1.0))
    outcome = rgbd.calibrate_rgbd(RgbdOptions(str(source), out=tmp_path / "out"))
    read = read_camera(tmp_path / "out" / "sensor.yaml").depth.over(DepthFormat())
    assert read.own is not None and read.own.camera == lens and np.array_equal(read.own.T_color_depth, T)
    assert read.time_offset_s == -0.02 and read.offset_px == (0.0, 0.0)
    said = "\n".join(outcome.lines)
    assert "50.0 ± 1.0, 0.0 ± 1.0, 0.0 ± 20.0 mm right of, below and ahead" in said and "late by 20.0 ± 1.0 ms" in said
    assert "the place of depth to the ahead" not in said and "ahead is only roughly known" in said
    assert json.loads((tmp_path / "out" / "rgbd.json").read_text())["T_color_depth"] == T.tolist()


def test_a_camera_that_sees_a_wall_is_refused_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_folder(tmp_path / "fr1")
    out = tmp_path / "out"
    assert run_verb(["calibrate", "rgbd", str(source), "--out", str(out)]) == DataError.exit_code
    said = capsys.readouterr().err
    assert "cannot be determined" in said and "things near and far" in said
    assert list(out.iterdir()) == []


def test_a_recording_without_depth_is_refused(tmp_path: Path) -> None:
    source = write_folder(tmp_path / "fr1")
    (source / "depth.txt").unlink()
    with pytest.raises(DataError, match="no depth images"):
        rgbd.calibrate_rgbd(RgbdOptions(str(source), out=tmp_path / "out"))
