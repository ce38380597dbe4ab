"""Real drives without a camera that come with GTSAM's package, as recordings for `vislam run` and the plans here.

    python experiments/gtsam_drives.py --out $VISLAM_DATA/drives
    vislam compare experiments/drives.toml

Plaza 1 and 2: a robot's gyroscope, wheels, and ranges to four surveyed anchors that are 7 % too long, 1.9 and 1.4 km
(Djugash, Hamner and Roth, "Navigating with ranging radios: five data sets with ground truth", Journal of Field Robotics
2009). An accelerometer is not in the tables; a force is put in its place that keeps a turning robot on its curve.

KITTI: a car's inertial data and a fix each second, 3.7 km through Karlsruhe (Geiger, Lenz, Stiller and Urtasun, "Vision
meets robotics: the KITTI dataset", IJRR 2013). It drives from the first on: `start` is its speed in the first seconds,
by the fixes. Every tenth fix is held out as the truth; in further recordings the fixes of a minute are cut, and all
fixes are the truth. `car.toml` is a file of sensors which says besides that nothing goes sideways or up.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.io import loadmat

from vislam.core import Array, ImuSample, transform
from vislam.datasets.recorder import Recorder
from vislam.imu import ImuNoise

_GRAVITY_M_S2 = 9.81
_PLAZA_NOISE = (0.01, 0.5, 1e-4, 1e-4)
_FIRST = 1  # of KITTI's fixes: the one before is 3 s older
_START_S = 10.0  # in which the speed at the beginning is given
_HELD_OUT = 10  # one fix of so many
_CUT, _AFTER = 60, 10  # fixes, a second each, and as many of them after a cut
_CUTS = (72, 345)  # last fix before each: here the inertial data are whole
_STRAIGHT, _FILLED = 1e-6, 20  # off a line by the tables' digits, for so many samples in a row: nobody measured these
_PAIR_S = 0.05  # before and after a true fix: what is run is compared with the truth where that has no gap of 0.1 s
_FIXES = """[sensors.gnss]
kind = "position"
file = "gnss.csv"
sigma_m = 0.3
sigma_up_m = 0.3
gate_probability = 0.999999     # nothing else would bring a filter back that has refused a good one

[sensors.start]
kind = "twist"
file = "start.csv"
scale_sigma = 0.001
sigma_m_s = 0.3
sigma_rad_s = 1000.0            # it knows nothing of turns
sideways_m_s = 0.5
upward_m_s = 0.5
"""
_CAR = """
[sensors.car]
kind = "twist"
file = "car.csv"                # of zeros, with a sigma of a kilometre a second
sigma_m_s = 1000.0
sigma_rad_s = 1000.0
sideways_m_s = 0.3              # a car leans, and its tyres yield, for a second or two
upward_m_s = 0.3
mount_sigma_rad = 0.02
"""
_PLAZA = """[sensors.uwb]
kind = "range"
file = "uwb.csv"
anchors = {{{places}}}
sigma_m = 0.6
scale_sigma = 0.1
frame_z_sigma_m = 0.01

[sensors.wheels]
kind = "twist"
file = "wheels.csv"
sigma_m_s = 0.05
slip = 0.05
sigma_rad_s = 10.0              # of turns the gyroscope knows more
"""


class Drive(NamedTuple):
    """One recording; times in seconds."""

    noise: ImuNoise
    imu: Array  # [N, 7] time, rates, forces
    truth: Array  # [M, 4] time, place
    readings: dict[str, tuple[str, Array]]  # columns, and rows with the time first, of each sensor
    files: dict[str, str]  # of sensors


def plaza(folder: Path, number: int) -> Drive:
    """Return drive 1 or 2 of Plaza from the package's folder."""
    table = loadmat(str(folder / f"Plaza{number}_.mat"))
    steps, ranges, true, anchors = (table[name] for name in ("DR", "TD", "GT", "TL"))
    t_s, dt_s = steps[:, 0], np.diff(steps[:, 0], prepend=2 * steps[0, 0] - steps[1, 0])
    speed, rate, none = steps[:, 1] / dt_s, steps[:, 2] / dt_s, np.zeros(len(t_s))
    force = np.full(len(t_s), _GRAVITY_M_S2)
    middles = t_s - 0.5 * dt_s
    dense_s = np.arange(true[0, 0], true[-1, 0], 0.1)
    places = ", ".join(f"{name:.0f} = [{x}, {y}, 0.0]" for name, x, y in anchors.tolist())
    return Drive(
        ImuNoise(*_PLAZA_NOISE, 1.0 / float(np.median(dt_s))),
        np.column_stack([middles, none, none, rate, none, speed * rate, force]),
        np.column_stack([dense_s, *(np.interp(dense_s, true[:, 0], true[:, k]) for k in (1, 2)), 0.0 * dense_s]),
        {
            "uwb": ("anchor,range_m", ranges[:, [0, 2, 3]]),
            "wheels": ("vx_m_s,wz_rad_s", np.column_stack([middles, speed, rate])),
        },
        {"sensors.toml": _PLAZA.format(places=places)},
    )  # fmt: skip


def kitti(folder: Path, cut: int | None = None) -> Drive:
    """Return KITTI's drive from the package's folder: one fix of ten held out, or those of a minute after a fix cut."""
    imu = np.loadtxt(folder / "KittiEquivBiasedImu.txt", skiprows=1)
    fixes = np.loadtxt(folder / "KittiGps_converted.txt", skiprows=1, delimiter=",")[_FIRST:]
    told = np.loadtxt(folder / "KittiEquivBiasedImu_metadata.txt", skiprows=1)
    accel, gyro, _, accel_walk, gyro_walk, period_s = told[6:].tolist()
    numbers = np.arange(len(fixes)) + _FIRST
    if cut is None:
        is_out = true = (numbers > _FIRST) & ((numbers - _FIRST) % _HELD_OUT == 0)
    else:
        fixes, numbers = fixes[numbers <= cut + _CUT + _AFTER], numbers[numbers <= cut + _CUT + _AFTER]
        is_out, true = (numbers > cut) & (numbers <= cut + _CUT), np.ones(len(fixes), dtype=np.bool_)
    path, kept = CubicSpline(fixes[:, 0], fixes[:, 1:]), fixes[~is_out]
    imu = imu[measured(imu[:, 0], imu[:, 2:])]
    imu = imu[(imu[:, 0] > fixes[0, 0] - 1.0) & (imu[:, 0] < fixes[-1, 0] + 0.5)]
    start_s = np.arange(imu[0, 0], imu[0, 0] + _START_S, 0.1)
    speeds = np.linalg.norm(CubicSpline(kept[:, 0], kept[:, 1:])(start_s, 1), axis=1)
    car_s = np.arange(imu[0, 0], imu[-1, 0], 0.1)
    true_s = (fixes[true, :1] + [-_PAIR_S, _PAIR_S]).ravel()
    return Drive(
        ImuNoise(gyro, accel, gyro_walk, accel_walk, 1.0 / period_s), imu[:, [0, 5, 6, 7, 2, 3, 4]],
        np.column_stack([true_s, path(true_s)]),
        {
            "gnss": ("east_m,north_m,up_m", kept),
            "start": ("vx_m_s,wz_rad_s", np.column_stack([start_s, speeds, 0.0 * speeds])),
            "car": ("vx_m_s,wz_rad_s", np.column_stack([car_s, np.zeros((len(car_s), 2))])),
        },
        {"sensors.toml": _FIXES, "car.toml": _FIXES + _CAR},
    )  # fmt: skip


def measured(t_s: Array, values: Array) -> NDArray[np.bool_]:
    """Return which of values [N, C] at times [N] somebody measured: no noise lies on a straight line for long.

    KITTI's tables have eight holes of 1.6 s that were filled by straight lines, as if nothing had been missing.
    """
    share = ((t_s[1:-1] - t_s[:-2]) / (t_s[2:] - t_s[:-2]))[:, None]
    off = np.abs(values[1:-1] - values[:-2] - share * (values[2:] - values[:-2])).max(axis=1)
    straight = np.concatenate([[False], off < _STRAIGHT, [False]])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], straight, [False]]).astype(int)))
    kept = np.ones(len(t_s), dtype=np.bool_)
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin >= _FILLED:
            kept[begin:end] = False
    return kept


def write(drive: Drive, out: Path) -> None:
    """Write a recording with its further sensors, as `vislam record` does."""
    with Recorder(out, None, drive.noise, comment="a drive of GTSAM's package") as recorder:
        for name, (columns, rows) in drive.readings.items():
            recorder.begin_readings(name, f"t_ns,{columns}")
            for t_s, *values in rows.tolist():
                recorder.write_reading(name, round(t_s * 1e9), np.array(values))
        for t_s, *values in drive.imu.tolist():
            recorder.write(ImuSample(round(t_s * 1e9), np.array(values[:3]), np.array(values[3:])))
        for t_s, *place in drive.truth.tolist():
            recorder.write_truth(round(t_s * 1e9), transform(np.eye(3), np.array(place)))
    for name, text in drive.files.items():
        (out / name).write_text(text)
    print(out)


def main(out: Path, tables: Path | None = None) -> None:
    """Write all recordings.

    Args:
        out: new folder for them.
        tables: with GTSAM's tables; None: those of the installed package.
    """
    if tables is None:
        spec = find_spec("gtsam")
        assert spec is not None and spec.submodule_search_locations is not None
        tables = Path(spec.submodule_search_locations[0]) / "Data"
    for number in (1, 2):
        write(plaza(tables, number), out / f"plaza{number}")
    write(kitti(tables), out / "kitti")
    for cut in _CUTS:
        write(kitti(tables, cut), out / f"kitti-cut{cut}")


if __name__ == "__main__":
    tyro.cli(main)
