"""Twelve poses by hand: scale, axes and bias of an IMU with errors at the limits of its data sheet, and refusals."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.calibration.inertial.imu import ImuResult, solve_imu
from vislam.calibration.inertial.stillness import movement
from vislam.calibration.inertial.tables import Table
from vislam.calibration.options import ImuOptions
from vislam.core.messages import Array
from vislam.datasets.imu_files import read_imu_calibration
from worlds.calibration import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    RATE_HZ,
    T0_NS,
    calibrate,
    hand_held,
    refusal,
    ups,
    write_table,
)

OPTIONS = ImuOptions(Path("recording"))


def table(t_s: Array, values: Array) -> Table:
    return Table(Path("recording"), T0_NS + np.round(t_s * 1e9).astype(np.int64), values, {})


def solved(t_s: Array, values: Array, options: ImuOptions = OPTIONS) -> ImuResult:
    recorded = table(t_s, values)
    return solve_imu(recorded, movement(recorded, 0.1), options)


def tilt_deg(matrix: Array, bias: Array) -> float:
    """Return the error of the direction of gravity per axis, rms over directions."""
    up = np.random.default_rng(9).normal(size=(500, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    raw = 9.81 * up @ np.linalg.inv(ACCEL_MATRIX).T + ACCEL_BIAS
    found = (raw - bias) @ matrix.T
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return float(np.rad2deg(np.sqrt(0.5 * np.mean(np.sum(np.cross(found, up) ** 2, axis=1)))))


def test_errors_are_as_large_as_their_sigmas() -> None:
    accel, gyro, tilts, claimed = [], [], [], []
    for seed in range(8):
        result = solved(*hand_held(seed, ups(seed)))
        fit = result.accel
        errors = np.concatenate([(fit.matrix - ACCEL_MATRIX)[np.triu_indices(3)], fit.bias - ACCEL_BIAS])
        accel.append(errors / np.sqrt(np.diag(fit.covariance)))
        turned = result.gyro
        errors = np.concatenate([(turned.matrix - GYRO_MATRIX).ravel(), turned.bias - GYRO_BIAS])
        gyro.append(errors / np.sqrt(np.diag(turned.covariance)))
        tilts.append(tilt_deg(fit.matrix, fit.bias))
        claimed.append(np.rad2deg(fit.tilt_sigma_rad))
    assert 0.8 < np.sqrt(np.mean(np.square(accel))) < 1.25
    assert 0.8 < np.sqrt(np.mean(np.square(gyro))) < 1.3
    assert np.sqrt(np.mean(np.square(tilts))) < 0.03
    assert 0.6 < np.sqrt(np.mean(np.square(tilts)) / np.mean(np.square(claimed))) < 1.5


def test_a_hand_that_trembles_is_still_a_rest() -> None:
    t_s, values = hand_held(3, ups(3), rest_s=4.0)
    rng = np.random.default_rng(0)
    for axis in range(6):  # 3 to 12 Hz, as hands do
        phases, amplitude = rng.uniform(0, 6.3, 8), 0.02 if axis < 3 else 0.1
        waves = [np.sin(6.28 * f * t_s + p) for f, p in zip(rng.uniform(3, 12, 8), phases, strict=True)]
        values[:, axis] += amplitude * np.sum(waves, axis=0) / np.sqrt(8.0)
    result = solved(t_s, values)
    assert len(result.rests) == 12
    assert tilt_deg(result.accel.matrix, result.accel.bias) < 0.2


def test_chips_with_different_axes_are_aligned() -> None:
    t_s, values = hand_held(4, ups(4))
    values[:, :3] = values[:, [1, 0, 2]] * [1.0, -1.0, 1.0]
    found = solved(t_s, values).gyro.matrix
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # raw axes of before from those of now
    assert found == pytest.approx(GYRO_MATRIX @ turned, abs=0.01)


def test_seven_poses_do_for_scale_and_bias() -> None:
    t_s, values = hand_held(5, ups(5, 9))
    result = solved(t_s, values, ImuOptions(Path("r"), model="scale"))
    off_diagonal = result.accel.matrix[~np.eye(3, dtype=bool)]
    assert not off_diagonal.any()
    assert tilt_deg(result.accel.matrix, result.accel.bias) < 0.6  # what the axes leave
    assert np.diag(result.accel.matrix) == pytest.approx(np.diag(ACCEL_MATRIX), abs=0.02)


def test_the_verb_writes_a_file_that_the_config_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = write_table(tmp_path / "hand", "imu0", *hand_held(6, ups(6)))
    out = tmp_path / "out"
    answer = calibrate(capsys, "imu", recording, "--out", out)
    found = read_imu_calibration(out / "imu.yaml")
    assert found.accel_matrix.tolist() == answer["accel"]["matrix"]
    assert found.gyro_bias_rad_s == pytest.approx(GYRO_BIAS, abs=1e-3)
    assert found.accel_matrix == pytest.approx(ACCEL_MATRIX, abs=2e-3)
    assert answer["directions"] == 12 and answer["accel"]["tilt_sigma_deg"] < 0.05
    picture = cv2.imread(str(out / "imu.png"))
    assert picture is not None and picture.std() > 10.0


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ("--out", tmp_path / "out")

    def said(name: str, t_s: Array, values: Array) -> str:
        return refusal(capsys, "imu", write_table(tmp_path / name, "imu0", t_s, values), *out)

    few = said("few", *hand_held(1, ups(1, 5)))
    assert "5 rests" in few and "10 directions are the least" in few
    angles = np.arange(12) * 2.0 * np.pi / 12.0
    wheel = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(12)])
    flat = said("flat", *hand_held(1, wheel))
    assert "in a plane" in flat and "z up, z down" in flat
    upper = ups(2, 14)
    upper[:, 2] = np.abs(upper[:, 2])
    assert "z down" in said("upper", *hand_held(2, upper))
    t_s, values = hand_held(3, ups(3))
    assert "must be in m/s^2" in said("g", t_s, np.hstack([values[:, :3], values[:, 3:] / 9.81]))
    assert "rad/s" in said("deg", t_s, np.hstack([np.rad2deg(values[:, :3]), values[:, 3:]]))
    dead = values.copy()
    dead[:, 1] = 0.0
    assert "gyro y never changes" in said("dead", t_s, dead)
    shaken = values + np.random.default_rng(0).normal(size=values.shape) * [3.0, 3.0, 3.0, 9.0, 9.0, 9.0]
    assert "known to" in said("shaken", t_s, shaken) or "least" in said("shaken2", t_s, shaken)
    gaps = t_s + np.floor(np.arange(len(t_s)) / (4.5 * RATE_HZ) + 0.2) * 0.5
    assert "holes" in said("gaps", gaps, values)
    assert not list((tmp_path / "out").glob("*"))
