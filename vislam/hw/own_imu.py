"""The IMU inside a camera: threads of the device put samples in, the reader of inertial samples takes them."""

import threading
import time
from collections import deque

import numpy as np

from vislam.config import DepthCameraConfig
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.accel_at_gyro import AccelAtGyro
from vislam.hw.affine import Affine
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource

_NS = 1_000_000_000
_KEPT = 4000  # samples that wait to be taken: 20 s at 200 Hz
_GAP_PERIODS = 2.5  # between two samples of the gyro; beyond, some were lost


class OwnImu(InertialSource):
    """An `InertialSource`; any thread may put in, one takes out.

    Attributes:
        stamped_by: where the stamps come from, for a person.
        problem: why no samples come, empty when they do or it is unknown.
    """

    def __init__(self, name: str, config: DepthCameraConfig) -> None:
        """Nothing is opened here: the camera does that, and calls `begin`."""
        super().__init__(config.calibration, config.imu_silent_s)
        self.path = name
        self.rate_hz = config.imu_rate_hz
        self.stamped_by, self.problem = "not known yet", ""
        self._pairs = AccelAtGyro(_KEPT)
        self._samples: deque[ImuSample | MagSample] = deque()
        self._has_come = threading.Condition()
        self._gyro_ns = self._accel_ns = 0
        self._is_closed = False

    # ---- the device's side ------------------------------------------------------------------------------------

    def begin(self, R_body_imu: Array | None, rate_hz: float) -> None:
        """Take what is known of a device that was opened.

        Args:
            R_body_imu: [3, 3] by its maker's extrinsics; None: by the axes of the settings.
            rate_hz: of the gyro.
        """
        c = self._calibration
        with self._has_come:
            self.rate_hz = rate_hz
            if R_body_imu is not None:
                gyro = _turned(R_body_imu, np.array(c.gyro_matrix), np.array(c.gyro_bias_rad_s))
                accel = _turned(R_body_imu, np.array(c.accel_matrix), np.array(c.accel_bias_m_s2))
                self._maps = (gyro, accel, self._maps[2])
            self._pairs.clear()
            self._faults.add("opened", Health.IMU_GAP if self._faults.counts["opened"] else Health(0))
            self.problem = ""

    def add_gyro(self, t_ns: int, rate: Array) -> None:
        """Take a rate [3], rad/s in the axes of the IMU, of a time of CLOCK_MONOTONIC."""
        if not self._is_sound(t_ns, self._gyro_ns, rate):
            return
        with self._has_come:
            if self._gyro_ns and (t_ns - self._gyro_ns) * self.rate_hz > _GAP_PERIODS * _NS:
                self._faults.add("gaps", Health.IMU_GAP)
            self._gyro_ns = t_ns
            if self._gyro.sound([rate.tolist()])[0]:
                self._pairs.add_gyro(t_ns, rate)
                self._merge()

    def add_accel(self, t_ns: int, force: Array) -> None:
        """Take a specific force [3], m/s^2 in the axes of the IMU."""
        if not self._is_sound(t_ns, self._accel_ns, force):
            return
        with self._has_come:
            self._accel_ns = t_ns
            if self._accel.sound([force.tolist()])[0]:
                self._pairs.add_accel(t_ns, force)
                self._merge()
            else:
                self._pairs.clear()

    def count(self, what: str, *events: Health) -> None:
        """Count a fault, with the bit that reports it."""
        with self._has_come:
            self._faults.add(what, *events)

    def _is_sound(self, t_ns: int, before_ns: int, value: Array) -> bool:
        """Return whether a sample can be used; counts what cannot."""
        if not np.isfinite(value).all():
            self.count("bad_values", Health.BUS_FAULT)
        elif t_ns < before_ns:
            self.count("stamps_not_rising")
        else:
            return t_ns > before_ns  # the same report again is no fault
        return False

    def _merge(self) -> None:
        for t_ns, rate, force in self._pairs.merged():
            if len(self._samples) >= _KEPT:
                self._samples.popleft()
                self._faults.add("not_taken", Health.IMU_GAP)
            self._samples.append(self._inertial(t_ns, rate, force))
            self._faults.add("samples")
            self._last_out_ns = time.monotonic_ns()
            self._has_come.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Return whether a sample has come, waiting at most so long for the first one."""
        with self._has_come:
            return self._has_come.wait_for(lambda: self._faults.counts["samples"] > 0, timeout_s)

    # ---- the reader's side ------------------------------------------------------------------------------------

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what came since the last call, waiting at most `timeout_s`; see `InertialSource`."""
        with self._has_come:
            self._has_come.wait_for(lambda: bool(self._samples) or self._is_closed, timeout_s)
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def health(self) -> Health:
        """Return the bits that hold now and the events since the last call."""
        with self._has_come:
            return super().health()

    def counters(self) -> dict[str, int]:
        """Return samples, and how often each fault occurred since the start."""
        with self._has_come:
            return super().counters()

    def close(self) -> None:
        """Wake who waits; the camera gives the device back."""
        with self._has_come:
            self._is_closed = True
            self._has_come.notify_all()


def _turned(R_body_imu: Array, matrix: Array, bias: Array) -> Affine:
    """Return the map of a calibration `matrix @ (turned - bias)` in body axes."""
    return Affine(matrix @ R_body_imu, -matrix @ bias)
