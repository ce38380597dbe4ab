"""Calibrations of inertial and magnetic sensors in YAML: Kalibr's imu.yaml, and our keys for scale, axes and bias.

Our keys may stand in a file of their own (as `vislam calibrate imu` writes it) or in a recording's `sensor.yaml`, which
states that its samples are raw; docs/formats.md lists them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.datasets.calibration import NOISE_KEYS, SCALE_KEYS, Keys, is_neutral, load_yaml, numbers_in, parse_noise
from vislam.datasets.calibration_text import list_text
from vislam.datasets.foreign_cameras import load_keys
from vislam.imu import ImuCalibration, ImuNoise, MagCalibration

Calibration = TypeVar("Calibration", ImuCalibration, MagCalibration)

_KEYS: dict[type, dict[str, str]] = {  # of files, and what they are called in the value
    ImuCalibration: {key: key for key in ("gyro_bias_rad_s", "gyro_matrix", "accel_bias_m_s2", "accel_matrix")},
    MagCalibration: {"mag_bias_ut": "bias_ut", "mag_matrix": "matrix"},
}
_ORB_NOISE = dict(
    zip(("IMU.NoiseGyro", "IMU.NoiseAcc", "IMU.GyroWalk", "IMU.AccWalk"), NOISE_KEYS, strict=True),
    **{"IMU.Frequency": "update_rate"},
)
_OKVIS_NOISE = dict(
    zip(("sigma_g_c", "sigma_a_c", "sigma_gw_c", "sigma_aw_c"), NOISE_KEYS, strict=True), imu_rate="update_rate"
)
_BIASES = {"calib_accel_bias": 3, "calib_gyro_bias": 3, "a0": 3, "g0": 3, "s_a": 0}  # numbers; behind: scale and axes
_INSTEAD = "poses of cameras in this IMU and its scale in a file for --calibration.imu"
_BASALT_NOISE = dict(
    zip(("gyro_noise_std", "accel_noise_std", "gyro_bias_std", "accel_bias_std"), NOISE_KEYS, strict=True),
    imu_update_rate="update_rate",
)


def imu_noise_text(noise: ImuNoise, comment: str) -> str:
    """Return Kalibr's imu.yaml for a noise model; `comment` becomes its first line."""
    return (
        f"# {' '.join(comment.split())}\n"
        f"rostopic: /imu0\n"
        f"update_rate: {float(noise.rate_hz)!r}  # Hz\n"
        f"gyroscope_noise_density: {float(noise.gyroscope_noise_density)!r}  # rad/s/sqrt(Hz)\n"
        f"gyroscope_random_walk: {float(noise.gyroscope_random_walk)!r}  # rad/s^2/sqrt(Hz)\n"
        f"accelerometer_noise_density: {float(noise.accelerometer_noise_density)!r}  # m/s^2/sqrt(Hz)\n"
        f"accelerometer_random_walk: {float(noise.accelerometer_random_walk)!r}  # m/s^3/sqrt(Hz)\n"
    )


def read_noise(path: Path, topic: str = "") -> ImuNoise:
    """Return the noise model in a file of Kalibr (also its results), OpenVINS, ORB-SLAM, Basalt, or an ASL sensor.yaml.

    Of several IMUs it is the one whose `rostopic` is `topic`. Raises DataError naming the key; also for a place, clock
    or scale of the IMU (T_i_b, time_offset, Tw) that means anything. Other keys that are not used are warned of.
    """
    data = _foreign_noise(load_keys(path), path)
    nested = [str(key) for key, value in data.items() if isinstance(value, dict) and set(NOISE_KEYS) & set(value)]
    chosen = [key for key in nested if len(nested) == 1 or (topic and data[key].get("rostopic") == topic)]
    if len(chosen) != len(nested[:1]):
        named, of = ", ".join(nested), f", not one with rostopic {topic}" if topic else ""
        raise DataError(f"{path} holds {len(nested)} IMUs: {named}{of}; give a file with the recording's block alone")
    if chosen:
        data.name_unused(path, known=nested)
        data = Keys(data[chosen[0]])
    noise = parse_noise(data, "update_rate" if "update_rate" in data else "rate_hz", path)
    data.name_unused(path, _INSTEAD, known=("model", *(key for key, value in data.items() if is_neutral(value))))
    return noise


def _foreign_noise(data: Keys, path: Path) -> Keys:
    """Return the noise that ORB-SLAM, Basalt or OKVIS states in Kalibr's keys, the data itself where it is of neither.

    Raises DataError for VINS, whose figures are no densities.
    """
    if "acc_n" in data:
        raise DataError(
            f"{path} is VINS's: its acc_n and gyr_n are tuned figures, not densities; give Kalibr's imu.yaml, or run "
            "`vislam calibrate noise`"
        )
    inner = data.get("value0")
    listed = data.get("imu_params", data.get("imu_parameters"))
    for names, holder in ((_BASALT_NOISE, inner), (_ORB_NOISE, data), (_OKVIS_NOISE, listed)):
        if isinstance(holder, dict) and any(name in holder for name in names):
            stated = {key: numbers_in(holder, name, path) for name, key in names.items() if name in holder}
            rest = {name: numbers_in(holder, name, path) for name in _BIASES if name in holder}
            scales = {f"scale in {name}": values[_BIASES[name] :] for name, values in rest.items()}
            biases = {name: values[: _BIASES[name]] for name, values in rest.items()}
            return Keys({key: max(values, default=None) for key, values in stated.items()} | biases | scales)
    return data


def calibration_text(calibration: ImuCalibration | MagCalibration, comment: str) -> str:
    """Return the file of a calibration."""
    sensor = "imu" if isinstance(calibration, ImuCalibration) else "magnetometer"
    return f"sensor_type: {sensor}\ncomment: {json.dumps(comment)}\n{calibration_keys(calibration)}"


def calibration_keys(calibration: ImuCalibration | MagCalibration) -> str:
    """Return the lines that state, in any sensor file, that samples are raw and how they are calibrated."""
    values = {key: getattr(calibration, name) for key, name in _KEYS[type(calibration)].items()}
    lines = (f"{key}: {_rows(value) if value.ndim == 2 else list_text(value)}\n" for key, value in values.items())
    matrices = "matrices" if len(values) > 2 else "matrix"
    return f"# calibrated = matrix @ (raw - bias); {matrices} by row\n{''.join(lines)}"


def read_imu_calibration(path: Path) -> ImuCalibration:
    """Return the calibration of an IMU in a file; raises DataError when it holds none."""
    return _wanted(path, ImuCalibration, "imu")


def read_mag_calibration(path: Path) -> MagCalibration:
    """Return the calibration of a magnetometer in a file; raises DataError when it holds none."""
    return _wanted(path, MagCalibration, "mag")


def calibration_in(data: Mapping[str, Any], path: Path, of: type[Calibration]) -> Calibration | None:
    """Return the calibration in the keys of a sensor file, None without any; raises DataError when some are missing."""
    there = [key for key in _KEYS[of] if data.get(key) is not None]
    if not there:
        return None
    if missing := [key for key in _KEYS[of] if key not in there]:
        raise DataError(f"{path} holds {', '.join(there)} but not {', '.join(missing)}; calibrate again")
    values = {
        name: np.array(numbers_in(data, key, path, 9)).reshape(3, 3)
        if key.endswith("matrix")
        else np.array(numbers_in(data, key, path, 3))
        for key, name in _KEYS[of].items()
    }
    return of(**values)


def _wanted(path: Path, of: type[Calibration], kind: str) -> Calibration:
    found = calibration_in(data := Keys(load_yaml(path)), path, of)
    if found is None:
        raise DataError(f"{path} holds none of {', '.join(_KEYS[of])}; `vislam calibrate {kind}` writes such a file")
    data.name_unused(path, known=(*NOISE_KEYS, *SCALE_KEYS, "rate_hz"))
    return found


def _rows(matrix: Array) -> str:
    return "[" + ",\n  ".join(list_text(row)[1:-1] for row in matrix) + "]"
