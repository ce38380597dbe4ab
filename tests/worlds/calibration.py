"""Recordings of sensors whose errors are known, for tests of calibration: written with plain code."""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.cli import run_verb
from vislam.core.messages import Array

T0_NS = 1_700_000_000_000_000_000


def write_table(folder: Path, sensor: str, t_s: Array, values: Array) -> Path:
    """Write `mav0/SENSOR/data.csv` of a recording and return the recording's folder."""
    path = folder / "mav0" / sensor / "data.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    stamps = T0_NS + np.round(np.asarray(t_s) * 1e9).astype(np.int64)
    rows = [f"{t},{','.join(f'{x:.7g}' for x in row)}\n" for t, row in zip(stamps.tolist(), values, strict=True)]
    path.write_text("#timestamp [ns],values\n" + "".join(rows))
    (folder / "mav0" / "imu0").mkdir(exist_ok=True)  # by which the folder is recognised
    return folder


def still_imu(seed: int, duration_s: float, rate_hz: float, white: Array, walk: Array) -> Array:
    """Return samples [N, 6] of an IMU at rest with these densities [6]."""
    rng = np.random.default_rng(seed)
    count = round(duration_s * rate_hz)
    drift = np.cumsum(rng.normal(size=(count, 6)) * walk / np.sqrt(rate_hz), axis=0)
    return rng.normal(size=(count, 6)) * white * np.sqrt(rate_hz) + drift + [0.01, -0.02, 0.03, 0.1, 0.2, 9.8]


def calibrate(capsys: pytest.CaptureFixture[str], *arguments: Any) -> dict[str, Any]:
    """Run `vislam calibrate ... --json` and return what it printed."""
    code = run_verb(["calibrate", *map(str, arguments), "--json"])
    out, err = capsys.readouterr()
    assert code == 0, err
    answer: dict[str, Any] = json.loads(out)
    return answer


def refusal(capsys: pytest.CaptureFixture[str], *arguments: Any, code: int = 3) -> str:
    """Run `vislam calibrate ...`, which must end with `code`, and return what it complained."""
    assert run_verb(["calibrate", *map(str, arguments)]) == code
    out, err = capsys.readouterr()
    assert out == ""
    return err


ACCEL_MATRIX = np.array([[1.05, 0.004, -0.006], [0.0, 0.96, 0.01], [0.0, 0.0, 1.08]])  # calibrated = M (raw - b)
ACCEL_BIAS = np.array([0.9, -1.2, 2.0])
GYRO_MATRIX = np.array([[1.02, 0.01, -0.008], [-0.006, 0.97, 0.012], [0.009, -0.011, 1.01]])
GYRO_BIAS = np.array([0.2, -0.35, 0.5])  # rad/s: the ITG3205's data sheet allows 40 deg/s
GYRO_DENSITY, ACCEL_DENSITY = 5.2e-4, 4.2e-3  # those of a GY-85 at 100 Hz
RATE_HZ = 100.0


def hand_held(
    seed: int, ups: Array, rest_s: float = 3.0, move_s: float = 1.5, noise: float = 1.0
) -> tuple[Array, Array]:
    """Return times and raw samples [N, 6] of a sensor that is held with each of `ups` [M, 3] up, turned in between.

    Turns are at a smooth rate about one axis each, with a twist about the vertical, so that all axes are turned about.
    """
    rng = np.random.default_rng(seed)
    R_world_body = Rotation.align_vectors([[0.0, 0.0, 1.0]], [ups[0]])[0]
    steps = round(move_s * RATE_HZ)
    shape = 1.0 - np.cos(2.0 * np.pi * (np.arange(steps) + 0.5) / steps)  # its mean is one
    rates = [np.zeros((round(rest_s * RATE_HZ), 3))]
    attitudes = [np.tile(R_world_body.as_matrix(), (len(rates[0]), 1, 1))]
    for up in ups[1:]:
        target = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]
        target = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-2.0, 2.0)]) * target
        turn = (R_world_body.inv() * target).as_rotvec()
        angle = np.cumsum(shape) / steps
        rates.append(np.outer(shape / move_s, turn))
        attitudes.append((R_world_body * Rotation.from_rotvec(np.outer(angle, turn))).as_matrix())
        R_world_body = target
        rates.append(np.zeros((round(rest_s * RATE_HZ), 3)))
        attitudes.append(np.tile(R_world_body.as_matrix(), (len(rates[-1]), 1, 1)))
    rate, R = np.vstack(rates), np.vstack(attitudes)
    force = 9.81 * R[:, 2] + 0.5 * np.gradient(rate, axis=0) * RATE_HZ * 0.1  # the arm of the hand
    rate_samples = np.vstack([0.5 * (rate[1:] + rate[:-1]), rate[-1:]])
    gyro = rate_samples @ np.linalg.inv(GYRO_MATRIX).T + GYRO_BIAS
    accel = force @ np.linalg.inv(ACCEL_MATRIX).T + ACCEL_BIAS
    gyro += noise * rng.normal(0.0, GYRO_DENSITY * np.sqrt(RATE_HZ), gyro.shape)
    accel += noise * rng.normal(0.0, ACCEL_DENSITY * np.sqrt(RATE_HZ), accel.shape)
    return np.arange(len(gyro)) / RATE_HZ, np.hstack([gyro, accel])


def ups(seed: int, count: int = 12) -> Array:
    """Return directions all over the sphere [M, 3]: six sides, then corners, all a little off."""
    rng = np.random.default_rng(seed)
    sides = np.vstack([np.eye(3), -np.eye(3)])[rng.permutation(6)]
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))[rng.permutation(8)] / np.sqrt(3.0)
    chosen = np.vstack([sides, corners])[:count] + rng.normal(0.0, 0.06, (count, 3))
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
