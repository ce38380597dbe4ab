"""Recordings of sensors whose errors are known, for tests of calibration: written with plain code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.messages import Array

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
