"""The IMU of an OAK, and the clock that it shares with the images: depthai's, put on the host's."""

import threading
import time
from contextlib import suppress
from datetime import timedelta
from typing import Any

import numpy as np

from vislam.config import OakConfig
from vislam.core.errors import HardwareError
from vislam.core.messages import Array
from vislam.hw.cameras.factory import looking_ahead, rigid
from vislam.hw.own_imu import OwnImu

CM = 0.01  # in which depthai states extrinsics
_EARLY_NS = 5_000_000  # depthai's match of clocks was seen to be early by a couple of milliseconds
_BRACKETS = 20  # readings of both clocks, of which the closest counts
_WAIT = timedelta(seconds=0.5)  # for samples; then it is looked whether to end
_JOIN_S = 2.0
_BATCH, _QUEUED = 1, 50  # reports in a message: each at once; messages that may wait
_STAMPED_BY = "the device, by depthai's match of its clock to the host's, which its images have too"


class OakClock:
    """Puts depthai's time on CLOCK_MONOTONIC, by one offset for all that a device stamps. For any thread."""

    def __init__(self, dai: Any, max_age_s: float) -> None:
        """Read both clocks some times; the closest bracket gives the offset."""
        self._max_age_ns = round(max_age_s * 1e9)
        self._age_ns = 0
        brackets = []
        for _ in range(_BRACKETS):
            before_ns = time.monotonic_ns()
            theirs_ns = in_ns(dai.Clock.now())
            after_ns = time.monotonic_ns()
            brackets.append((after_ns - before_ns, (before_ns + after_ns) // 2 - theirs_ns))
        self._offset_ns = min(brackets)[1]

    def host_ns(self, theirs_ns: int) -> int | None:
        """Return the host's time of what has just arrived; None for one that is of no clock of ours."""
        t_ns = theirs_ns + self._offset_ns
        age_ns = time.monotonic_ns() - t_ns
        if not -_EARLY_NS <= age_ns <= self._max_age_ns:
            return None
        self._age_ns = age_ns
        return t_ns

    def arrival_ns(self) -> int:
        """Return the time now less the last good age: for what carries no time."""
        return time.monotonic_ns() - self._age_ns


class OakMotion:
    """A thread that takes the reports of the device's IMU."""

    def __init__(
        self, dai: Any, pipeline: Any, device: Any, config: OakConfig, imu: OwnImu, clock: OakClock,
        T_cam_imu: Array | None,
    ) -> None:  # fmt: skip
        """Add the node to a pipeline that is not started yet. Raises HardwareError where the device has no IMU."""
        if device.getConnectedIMU() in ("", "NONE"):
            raise HardwareError("this OAK has no IMU; take another IMU (--imu)")
        node = pipeline.create(dai.node.IMU)
        node.enableIMUSensor(list(_kinds(dai)), round(config.imu_rate_hz))
        node.setBatchReportThreshold(_BATCH)
        node.setMaxBatchReports(_QUEUED)
        self._queue = node.out.createOutputQueue(maxSize=_QUEUED, blocking=False)
        self._imu, self._clock = imu, clock
        self._R_body_imu = None if T_cam_imu is None else looking_ahead(config) @ T_cam_imu[:3, :3]
        self._rate_hz = config.imu_rate_hz
        self.failure: Exception | None = None
        self._is_stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="oak imu", daemon=True)

    def start(self) -> None:
        """Begin; the pipeline runs."""
        self._imu.begin(self._R_body_imu, self._rate_hz)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; may be called before it was started."""
        self._is_stopping.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            while not self._is_stopping.is_set():
                message = self._queue.get(_WAIT)
                for packet in () if message is None else message.packets:
                    self._take(packet.gyroscope, self._imu.add_gyro)
                    self._take(packet.acceleroMeter, self._imu.add_accel)
        except Exception as error:  # depthai raises what it likes; the images' thread reports it and opens again
            if not self._is_stopping.is_set():
                self.failure = error

    def _take(self, report: Any, add: Any) -> None:
        t_ns = self._clock.host_ns(in_ns(report.getTimestamp()))
        if t_ns is None:
            self._imu.count("bad_stamps")
            return
        self._imu.stamped_by = _STAMPED_BY
        add(t_ns, np.array([report.x, report.y, report.z], dtype=np.float64))


def imu_pose(calibration: Any, socket: Any) -> Array | None:
    """Return the pose [4, 4] of the IMU in a camera by the factory; None where the device does not have it, as most."""
    T: Array | None = None
    with suppress(RuntimeError):  # there is none in its memory
        found = np.array(calibration.getCameraToImuExtrinsics(socket), dtype=np.float64)
        if np.any(found[:3, :3]):  # or it is left empty
            T = rigid(found[:3, :3], found[:3, 3] * CM)
    return T


def in_ns(since: timedelta) -> int:
    """Return a time of depthai in ns."""
    return (since // timedelta(microseconds=1)) * 1000


def _kinds(dai: Any) -> tuple[Any, Any]:
    """Return the streams of accelerometer and gyro: with the calibration in the device where depthai has that."""
    kinds = dai.IMUSensor
    if hasattr(kinds, "ACCELEROMETER_CALIBRATED"):  # depthai 3.12 and later
        return kinds.ACCELEROMETER_CALIBRATED, kinds.GYROSCOPE_CALIBRATED
    return kinds.ACCELEROMETER_RAW, kinds.GYROSCOPE_RAW
