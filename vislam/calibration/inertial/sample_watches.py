"""What a person sees while an IMU is held in poses, a magnetometer is turned, or a sensor stands still."""

import shutil
from array import array
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.calibration.inertial.field import fit_iron
from vislam.calibration.inertial.imu import ImuPoses, calibrate_imu, poses_so_far
from vislam.calibration.inertial.mag import calibrate_mag, largest_gap_deg, sphere_seen
from vislam.calibration.inertial.noise import ENOUGH_STILL_S, LEAST_STILL_S, calibrate_noise, longest_still_s
from vislam.calibration.inertial.tables import Table
from vislam.calibration.options import BoardOptions, ImuOptions, MagOptions, NoiseOptions
from vislam.calibration.outcome import Outcome
from vislam.calibration.watching import Progress, Value
from vislam.core.angles import angles_between
from vislam.core.files import write_text
from vislam.core.messages import Array, ImuSample, MagSample

_LEAST_S = 2.0  # before which nothing is judged
_WANTED_POSES = 12
_SPHERE_SHARE = 0.8  # of the directions, as the calibration asks
_TILTED_DEG = 12.0
_FLAT_GAP_DEG = 40.0
_MIN_FIELD = 100  # samples before which no centre is looked for
_MOST = 8_000_000  # samples of each: two hours at 1 kHz, 450 MB
_HEADS = {"imu0": "#timestamp [ns],gyro x y z [rad/s],force x y z [m/s^2]", "mag0": "#timestamp [ns],field x y z [uT]"}


class SampleLog:
    """Samples of IMU and magnetometer in the order in which they came."""

    def __init__(self) -> None:
        """Begin empty."""
        self._stamps = {"imu0": array("q"), "mag0": array("q")}
        self._values = {"imu0": array("d"), "mag0": array("d")}

    def add(self, value: object) -> None:
        """Keep a sample; what is none, is out of order or too much is left."""
        if isinstance(value, ImuSample):
            name, numbers = "imu0", (*value.gyro_rad_s.tolist(), *value.accel_m_s2.tolist())
        elif isinstance(value, MagSample):
            name, numbers = "mag0", tuple(value.field_ut.tolist())
        else:
            return
        stamps = self._stamps[name]
        if len(stamps) < _MOST and (not stamps or value.t_ns > stamps[-1]) and np.isfinite(numbers).all():
            stamps.append(value.t_ns)
            self._values[name].extend(numbers)

    def inertial(self) -> Table:
        """Return rates and forces [N, 6]."""
        return self._table("imu0", 6)

    def field(self) -> Table:
        """Return the magnetic field [N, 3]."""
        return self._table("mag0", 3)

    def write(self, folder: Path) -> Path:
        """Write a recording in place of an earlier one, and return it; raises StorageError."""
        shutil.rmtree(folder / "mav0", ignore_errors=True)
        for table, name in ((self.inertial(), "imu0"), (self.field(), "mag0")):
            if not len(table.t_ns):
                continue
            (folder / "mav0" / name).mkdir(parents=True, exist_ok=True)
            rows = (
                f"{t_ns},{','.join(map(repr, row))}\n"
                for t_ns, row in zip(table.t_ns.tolist(), table.values.tolist(), strict=True)
            )
            write_text(folder / "mav0" / name / "data.csv", f"{_HEADS[name]}\n" + "".join(rows))
        return folder

    def _table(self, name: str, columns: int) -> Table:
        # copies: an array that is exported cannot grow
        t_ns: NDArray[np.int64] = np.array(self._stamps[name], dtype=np.int64)
        values: Array = np.array(self._values[name], dtype=np.float64).reshape(-1, columns)
        return Table(Path(name), t_ns, values, {})


class _SampleWatch:
    """Keeps the samples of a sensor."""

    has_images = False

    def __init__(self, folder: Path, board: BoardOptions) -> None:
        """Begin with no sample."""
        self._folder, self._log = folder, SampleLog()

    def take(self, value: Value) -> None:
        """Keep a sample."""
        self._log.add(value)


class PoseWatch(_SampleWatch):
    """Satisfies `Watch`: an IMU that is held still in twelve poses or more."""

    def progress(self) -> Progress:
        """Return how many poses were held, which way was up in them, and whether it is held still now."""
        table = self._log.inertial()
        if len(table.t_ns) < 2 or table.duration_s < _LEAST_S:
            return Progress(0.0, False, "hold the sensor still, on one of its sides")
        poses: ImuPoses = poses_so_far(table, ImuOptions(self._folder))
        if poses.is_still:
            advice = "turn it to another side" if poses.held_s >= 2.0 * poses.rest_s else "hold it still"
        else:
            advice = "hold it still now"
        if poses.directions >= _WANTED_POSES:
            advice = "finish, or hold it in more poses"
        elif poses.unseen:
            advice += f" ({poses.unseen})"
        return Progress(
            share=min(1.0, poses.directions / _WANTED_POSES),
            can_finish=not poses.lacking,
            advice=advice,
            facts={
                "Now": f"still for {poses.held_s:.1f} s" if poses.is_still else "moving",
                "Poses": f"{poses.directions} of {_WANTED_POSES}",
                "Samples": f"{len(table.t_ns)} in {table.duration_s:.0f} s",
            },
            ways=[(x, y, z, True) for x, y, z in poses.up.tolist()],
        )

    def calibrate(self) -> Outcome:
        """Calibrate as `vislam calibrate imu`."""
        source = self._log.write(self._folder / "imu-recording")
        return calibrate_imu(ImuOptions(source, out=self._folder, overwrite=True))


class TurnWatch(_SampleWatch):
    """Satisfies `Watch`: a magnetometer that is turned, on the floor once around or by hand in figures of eight."""

    def progress(self) -> Progress:
        """Return which directions the field came from, seen from the sensor."""
        field, inertial = self._log.field(), self._log.inertial()
        if len(field.t_ns) < _MIN_FIELD or len(inertial.t_ns) < _MIN_FIELD:
            missing = "magnetometer" if len(field.t_ns) < _MIN_FIELD else "IMU"
            return Progress(0.0, False, f"waiting for the {missing}")
        step = 1 + len(field.t_ns) // 4000
        values = field.values[::step]
        fit = fit_iron(values)
        centre = 0.5 * (values.min(axis=0) + values.max(axis=0)) if fit is None else fit.centre
        ways, seen = sphere_seen(values, centre)
        up = inertial.values[:, 3:] / np.maximum(np.linalg.norm(inertial.values[:, 3:], axis=1, keepdims=True), 1e-9)
        usual = np.median(up, axis=0)
        usual /= max(float(np.linalg.norm(usual)), 1e-9)
        tilt_deg = float(np.rad2deg(np.quantile(angles_between(up, usual), 0.95)))
        gap_deg = largest_gap_deg(values, usual)
        share = float(np.mean(seen))
        is_flat = tilt_deg < _TILTED_DEG
        done = min(1.0, (360.0 - gap_deg) / (360.0 - _FLAT_GAP_DEG)) if is_flat else min(1.0, share / _SPHERE_SHARE)
        advice = (
            f"turn the cart once around on the floor (a sector of {gap_deg:.0f} degrees lacks), or take it in your hand"
            if is_flat
            else "turn it in figures of eight about all axes, up to upside down: the empty dots lack"
        )
        return Progress(
            share=done,
            can_finish=done >= 1.0,
            advice="finish when you like" if done >= 1.0 else advice,
            facts={
                "Way": "on the floor" if is_flat else "by hand",
                "Tilted by": f"{tilt_deg:.0f}°",
                "Directions": f"{share:.0%} of the sphere" if not is_flat else f"largest gap {gap_deg:.0f}°",
            },
            ways=[(x, y, z, bool(is_seen)) for (x, y, z), is_seen in zip(ways.tolist(), seen, strict=True)],
        )

    def calibrate(self) -> Outcome:
        """Calibrate as `vislam calibrate mag`."""
        source = self._log.write(self._folder / "mag-recording")
        return calibrate_mag(MagOptions(source, out=self._folder, overwrite=True))


class StillWatch(_SampleWatch):
    """Satisfies `Watch`: an IMU that stands still for an hour."""

    def progress(self) -> Progress:
        """Return how long it stood still in a row."""
        table = self._log.inertial()
        if len(table.t_ns) < 2 or table.duration_s < _LEAST_S:
            return Progress(0.0, False, "put the sensor on something heavy and leave it alone")
        still_s = longest_still_s(table)
        is_enough = still_s >= LEAST_STILL_S
        return Progress(
            share=min(1.0, still_s / ENOUGH_STILL_S),
            can_finish=is_enough,
            advice="an hour is good; you may finish earlier"
            if is_enough
            else "leave it alone for five minutes at least",
            facts={"Still in a row": f"{still_s / 60.0:.1f} min", "Samples": f"{len(table.t_ns)}"},
        )

    def calibrate(self) -> Outcome:
        """Calibrate as `vislam calibrate noise`."""
        source = self._log.write(self._folder / "noise-recording")
        return calibrate_noise(NoiseOptions(source, out=self._folder, overwrite=True))
