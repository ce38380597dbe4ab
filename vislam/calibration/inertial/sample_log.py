"""Raw samples kept in memory while a user moves the sensor, and written as a recording in the end."""

from __future__ import annotations

import shutil
from array import array
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.calibration.inertial.tables import Table
from vislam.core.files import write_text
from vislam.core.messages import Array, ImuSample, MagSample

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
