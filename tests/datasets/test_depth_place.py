"""Place, focal length and lag of depth with a lens of its own are found together, as drawn scenes have them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.core.camera import Camera
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.datasets import Problems, open_dataset, survey
from vislam.datasets.calibration_text import camera_text, depth_keys_text
from vislam.datasets.extrinsics import misplaced_depth
from vislam.datasets.images import DepthFormat
from vislam.datasets.rgbd import PlaceFit, fit_place, misplaced, rgbd_findings
from vislam.datasets.stream import frame_table, with_depth_format
from vislam.vision.depth_registration import DepthCamera

COLOR = Camera(320, 240, 260.0, 260.0, 159.5, 119.5, 0.0, "radtan", (0.1, -0.05, 0.0, 0.0))
LENS = Camera(320, 240, 230.0, 230.0, 158.0, 121.0)
PLACE = se3_exp(np.array([0.008, -0.010, 0.006, 0.045, -0.010, 0.006]))
TRUTH = DepthFormat(5000.0, time_offset_s=-0.025, own=DepthCamera(LENS, PLACE))
BOARDS = np.random.default_rng(4).uniform((-1.3, -1.0, 0.9, 0.1, 70.0), (1.3, 1.0, 2.6, 0.3, 250.0), (26, 5))


def pose(t_s: float) -> np.ndarray:
    turn = 0.10 * np.sin([3.7 * t_s + 1.0, 2.9 * t_s, 4.1 * t_s])
    return se3_exp(np.array([*turn, 0.3 * np.sin(3.9 * t_s), 0.2 * np.sin(4.3 * t_s + 1.0), 0.15 * np.sin(2.1 * t_s)]))


def drawn(camera: Camera, T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey and depth [H, W] of square boards (x, y, z, half a side, grey) before a wall at 3.5 m."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    right, down, ahead = T_world_cam[:3, :3] @ camera.unproject(np.column_stack([u.ravel(), v.ravel()])).T
    begin = T_world_cam[:3, 3]
    depth, grey = (3.5 - begin[2]) / ahead, np.full(u.size, 40.0)
    for x, y, z, half, shade in BOARDS:
        z_m = (z - begin[2]) / ahead
        hit = np.abs(begin[0] + right * z_m - x) < half
        hit &= (np.abs(begin[1] + down * z_m - y) < half) & (z_m < depth)
        depth[hit], grey[hit] = z_m[hit], shade
    return grey.reshape(u.shape), depth.reshape(u.shape)


def write_scene(folder: Path, frames: int) -> Path:
    generator = np.random.default_rng(5)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
        stamps = 1000.0 + np.arange(frames) / 30.0
        (folder / f"{name}.txt").write_text("".join(f"{t:.6f} {name}/{i}.png\n" for i, t in enumerate(stamps)))
    for i in range(frames):
        grey, _ = drawn(COLOR, pose(i / 30.0))
        noisy = cv2.GaussianBlur(grey, (0, 0), 0.7) + generator.normal(0.0, 3.0, grey.shape)
        cv2.imwrite(str(folder / "rgb" / f"{i}.png"), np.clip(noisy, 0, 255).astype(np.uint8))
        _, depth = drawn(LENS, pose(i / 30.0 + TRUTH.time_offset_s) @ PLACE)
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.rint(depth * 5000.0).astype(np.uint16))
    (folder / "sensor.yaml").write_text(camera_text(COLOR, None, "drawn") + depth_keys_text(TRUTH))
    return folder


def check(fit: PlaceFit | None, most_turn_deg: float, most_m: float) -> None:
    assert fit is not None and fit.how.own is not None
    turn_rad = se3_log(fit.how.own.T_color_depth @ invert(PLACE))[:3]
    off_m = (fit.how.own.T_color_depth - PLACE)[:3, 3]
    assert np.rad2deg(np.abs(turn_rad)).max() < most_turn_deg and np.abs(off_m).max() < most_m
    assert abs(fit.how.own.camera.fx / LENS.fx - 1.0) < 0.005
    assert abs(fit.how.time_offset_s - TRUTH.time_offset_s) < 0.004
    assert (np.abs(off_m) < 3.0 * fit.place_sigma_m).all()
    assert fit.turn_sigma_rad.max() < 0.003 and fit.place_sigma_m.max() < 0.005 and fit.lag_sigma_s < 0.004


def test_all_is_found_together_from_starts_that_are_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = survey(f"tum:{write_scene(tmp_path / 'drawn', 30)}")
    assert found.rig is not None
    start = replace(TRUTH, time_offset_s=0.0, own=DepthCamera(LENS.with_focal(1.03), np.eye(4)))
    fit = fit_place(with_depth_format(found, start), found.rig)
    check(fit, 0.15, 0.003)
    assert fit is not None and fit.how.own is not None
    turn_rad = se3_log(fit.how.own.T_color_depth @ invert(PLACE))[:3]
    assert (np.abs(turn_rad) < 3.0 * fit.turn_sigma_rad).all()
    assert misplaced(found, found.rig) is None
    registered = with_depth_format(found, DepthFormat(5000.0))  # as who has no calibration of it takes it to be
    fit = misplaced(registered, found.rig)
    check(fit, 0.6, 0.006)  # the lens is taken to have colour's centre: 1.5 px are 0.4 degrees
    (found.root / "sensor.yaml").write_text(camera_text(COLOR, None, "drawn"))
    for room in ("rgbd.judgement", "extrinsics"):  # it was found above
        monkeypatch.setattr(f"vislam.datasets.{room}.misplaced", lambda *_: fit)
    found = survey(str(found.root))
    (said,), _ = rgbd_findings(found, frame_table(found, Problems()), lambda *_: None)
    assert "does not lie where it is stated to be: depth sits at 4" in said.what and "calibrate rgbd" in said.next_step
    assert misplaced_depth(open_dataset(str(found.root))) == f"{said.what}: {said.next_step}"


def test_a_bare_wall_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "BOARDS", np.empty((0, 5)))
    found = survey(f"tum:{write_scene(tmp_path / 'drawn', 14)}")
    assert fit_place(found, found.rig) is None
