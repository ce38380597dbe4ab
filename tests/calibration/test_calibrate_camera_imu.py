"""Rotation and time offset between camera and IMU from turns: simulated, real, and where motion does not tell."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.calibration.extrinsics.hand_eye import HandEye, RotationPair, solve_hand_eye
from vislam.datasets import open_dataset
from vislam.datasets.camera_files import read_cameras
from worlds.calibration import calibrate, refusal

R_BODY_CAM = Rotation.from_rotvec([1.2, -1.1, 1.3])
OFFSET_S, BIAS = 0.037, np.array([0.01, -0.02, 0.03])
SIGMA_RAD = 0.002


def solved(seed: int, axes: np.ndarray, offset_s: float = OFFSET_S, seconds: float = 16.0) -> HandEye | None:
    """Solve for a body that turns to and fro about `axes` [3] (amplitudes), exactly but for noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.005)
    phases = rng.uniform(0.0, 6.3, 3)
    rates = axes * np.cos(np.outer(t, [2.1, 2.9, 3.7]) + phases)
    steps = Rotation.from_rotvec(0.5 * (rates[1:] + rates[:-1]) * 0.005)
    attitude = [Rotation.identity()]
    for step in steps:
        attitude.append(attitude[-1] * step)
    gyro = rates + BIAS + rng.normal(0.0, 4e-4 * np.sqrt(200.0), rates.shape)
    frames = np.arange(100, len(t) - 100, 10)
    pairs = []
    for key, later in zip(frames[:-5], frames[5:], strict=True):
        turn = R_BODY_CAM.inv() * attitude[key].inv() * attitude[later] * R_BODY_CAM
        seen = turn * Rotation.from_rotvec(rng.normal(0.0, SIGMA_RAD, 3))
        stamps = [round((t[k] - offset_s) * 1e9) for k in (key, later)]
        pairs.append(RotationPair(stamps[0], stamps[1], seen.as_matrix(), SIGMA_RAD**2 * np.eye(3)))
    return solve_hand_eye(pairs, np.round(t * 1e9).astype(np.int64), gyro)


def test_errors_are_as_large_as_their_sigmas() -> None:
    ratios = []
    for seed in range(5):
        found = solved(seed, np.array([0.5, 0.4, 0.6]))
        assert found is not None
        turn = (Rotation.from_matrix(found.R_body_cam) * R_BODY_CAM.inv()).as_rotvec()
        errors = np.array([*turn, found.time_offset_s - OFFSET_S])
        ratios.append(errors / found.sigmas[:4])
        assert found.gyro_bias_rad_s == pytest.approx(BIAS, abs=2e-3)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.35


@pytest.mark.parametrize("offset_s", [-0.12, 0.0, 0.2])
def test_large_offsets_are_found(offset_s: float) -> None:
    found = solved(3, np.array([0.5, 0.4, 0.6]), offset_s)
    assert found is not None and found.time_offset_s == pytest.approx(offset_s, abs=1e-3)


def test_a_cart_that_only_yaws_leaves_one_rotation_open() -> None:
    found = solved(4, np.array([0.0, 0.0, 0.6]))
    assert found is not None
    values, vectors = np.linalg.eigh(found.covariance[:3, :3])
    assert np.sqrt(values[-1]) > np.deg2rad(0.5)
    assert abs(vectors[2, -1]) > 0.95
    assert found.time_offset_s == pytest.approx(OFFSET_S, abs=1e-3)


def test_the_verb_on_a_simulated_walk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = "points:laps,duration_s=20,time_offset_s=0.02,extrinsic_rotation_deg=3,tracks=100"
    out = tmp_path / "out"
    answer = calibrate(capsys, "camera-imu", source, "--out", out)
    assert abs(answer["time_offset_s"] - 0.02) < 2e-3
    assert answer["from_recording_deg"] == pytest.approx(3.0, abs=0.5)
    assert answer["translation_determined"] is False
    chain = read_cameras(out / "camera-imu.yaml")
    assert chain[0].time_offset_s == answer["time_offset_s"]
    assert chain[0].T_body_cam is not None
    assert chain[0].T_body_cam[:3, :3] == pytest.approx(np.array(answer["R_body_cam"]), abs=1e-9)
    assert len(chain) == 2
    assert (out / "camera-imu.png").stat().st_size > 10_000


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ("--out", tmp_path / "out")
    still = refusal(capsys, "camera-imu", "points:still,duration_s=8,tracks=60", *out)
    assert "would be known to" in still and "time offset" in still
    yaw = refusal(capsys, "camera-imu", "points:turn-in-place,duration_s=15,tracks=60", *out)
    assert "about two axes at least" in yaw
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.data
def test_a_real_camera_as_it_was_calibrated(
    data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = str(data_root / "euroc_mh01_17s")
    answer = calibrate(capsys, "camera-imu", source, "--out", tmp_path / "out")
    print(answer["from_recording_deg"], answer["rotation_sigma_deg"], answer["time_offset_s"])
    assert answer["from_recording_deg"] < 0.5
    assert abs(answer["time_offset_s"]) < 2e-3
    told = open_dataset(source).rig.T_body_cams[0][:3, 3]
    assert answer["translation_m"] == pytest.approx(told.tolist())
