"""A recording in real time, as if its sensors were plugged in: for trying out settings, and for tests."""

import heapq
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vislam.config import CalibrationConfig
from vislam.core.errors import DataError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.core.recording import Recording
from vislam.hw.health import Health
from vislam.hw.source import FrameSource, ReadingSource
from vislam.live.epoch import Epoch
from vislam.live.frames import NoCamera
from vislam.live.processes.child import Life
from vislam.live.reading_source import ReplayedReadings, refuse_unread
from vislam.live.replayed_imu import InertialTable, ReplayedImu
from vislam.runs.further_sensors import FurtherReadings
from vislam.runs.sources import open_source
from vislam.sensors import SensorSetup
from vislam.sensors.simulated import within
from vislam.trajectory import Trajectory

_NS = 1_000_000_000
_NO_FRAMES_NS = 1 << 62
_CAMERA_TIMEOUT_NS = 1_000_000_000
_BEGIN_S = 1.0  # most that it takes all processes to begin: none of the recording is left out


@dataclass(frozen=True, slots=True)
class Outages:
    """When sensors are unplugged, in seconds since the beginning: [begin, end) each."""

    imu: tuple[tuple[float, float], ...] = ()
    camera: tuple[tuple[float, float], ...] = ()


class ReplaySource:
    """Satisfies `LiveSource`: any source of `vislam run` that has an IMU."""

    def __init__(
        self,
        uri: str,
        seed: int = 0,
        outages: Outages | None = None,
        calibration: CalibrationConfig | None = None,
    ) -> None:
        """Read the inertial data of a recording; images are read as they are played.

        `calibration` names files that take the place of the recording's own, as in `vislam run`. Raises
        UsageError for an unknown source, or for such files where it takes none; DataError when it cannot be used or has
        no inertial data.
        """
        self._open: Callable[[], Recording] = partial(open_source, uri, seed, calibration)
        recording = self._open()
        self.name = f"live {recording.name}"
        self.rig, self.imu_noise = recording.rig, recording.imu_noise
        self.frame_count, self.problems = 0, recording.problems
        if recording.imu_noise is None:
            raise DataError(f"{uri} has no inertial data to play")
        self._table = _inertial_table(recording, uri, recording.imu_noise.rate_hz)
        self.duration_s: float | None = float(self._table.t_ns[-1] - self._table.t_ns[0]) / _NS + _BEGIN_S
        self._zero_ns = int(self._table.t_ns[0])
        self.is_mag_calibrated = False  # its magnetometer is not played
        self._uri, self._seed = uri, seed
        self._outages = outages or Outages()
        self._epoch = Epoch()

    def wrapped(self) -> Recording:
        """Return the recording that is played."""
        return self._open()

    def check(self) -> None:
        """Do nothing: the recording is there."""

    def inertial(self) -> Callable[[], ReplayedImu]:
        """Return what plays the samples."""
        return partial(ReplayedImu, self._table, self._epoch, self._outages.imu)

    def cameras(self) -> Callable[[], FrameSource]:
        """Return what plays the frames."""
        if self.rig.is_blind:
            return NoCamera
        return partial(ReplayedFrames, self._open, self._zero_ns, self._epoch, self._outages.camera)

    def readings(self, setup: SensorSetup) -> Callable[[], ReadingSource]:
        """Return what plays the files of further sensors, and draws those that are simulated on the truth.

        Raises UsageError for a sensor that has neither.
        """
        refuse_unread(setup, {**setup.files, **setup.simulated_hz}, "a replay needs its file, or simulated_hz")
        streams = partial(read_along, self._open, setup, self._seed)
        return partial(ReplayedReadings, setup.suite.names, streams, self._zero_ns, self._epoch)

    def helpers(self) -> dict[str, Callable[[Life], None]]:
        """Return nothing: it needs no other processes."""
        return {}

    def close(self) -> None:
        """Do nothing: no memory is shared."""

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Raise DataError: live sensors cannot be read twice."""
        raise DataError(f"{self.name} is live; run {self._uri} to process the recording itself")

    def truth(self) -> Trajectory | None:
        """Return the truth at the times when it was played."""
        truth = self._open().truth()
        shift_ns = self._epoch.begin_ns() - self._zero_ns
        return None if truth is None else Trajectory(truth.t_ns + shift_ns, truth.T_world_body)


class ReplayedFrames:
    """Plays the frames of a recording at their times; those that were not taken in time are dropped and counted."""

    def __init__(
        self,
        opener: Callable[[], Recording],
        zero_ns: int,
        epoch: Epoch,
        outages: tuple[tuple[float, float], ...] = (),
    ) -> None:
        """Open the recording; `zero_ns` of it is the epoch."""
        self._frames = (value for value in opener().events() if isinstance(value, Frame))
        self._zero_ns, self._epoch, self._outages = zero_ns, epoch, outages
        self._next: Frame | None = next(self._frames, None)
        self._counts = {"captured": 0, "dropped": 0}
        self._newest_ns: int | None = None

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame whose time has come; see `FrameSource`."""
        shift_ns = self._epoch.begin_ns() - self._zero_ns
        deadline_ns = time.monotonic_ns() + round(timeout_s * _NS)
        newest: Frame | None = None
        while True:
            now_ns = time.monotonic_ns()
            while self._next is not None and self._next.t_ns + shift_ns <= now_ns:
                since_s = (self._next.t_ns - self._zero_ns) / _NS
                if not within(since_s, self._outages):
                    self._counts["captured"] += 1
                    self._counts["dropped"] += newest is not None
                    newest = self._next
                self._next = next(self._frames, None)
            if newest is not None:
                self._newest_ns = now_ns
                return replace(newest, t_ns=newest.t_ns + shift_ns)
            if now_ns >= deadline_ns:
                return None
            time.sleep(min((deadline_ns - now_ns) / _NS, 0.002))

    def health(self) -> Health:
        """Return CAMERA_MISSING after a second without a frame."""
        since_ns = self._epoch.begin_ns() if self._newest_ns is None else self._newest_ns
        return Health.CAMERA_MISSING if time.monotonic_ns() - since_ns > _CAMERA_TIMEOUT_NS else Health(0)

    def counters(self) -> dict[str, int]:
        """Return frames captured, and dropped as too old."""
        return dict(self._counts)

    def close(self) -> None:
        """Stop reading."""
        self._next = None


def _inertial_table(recording: Recording, uri: str, rate_hz: float) -> InertialTable:
    """Return the inertial samples of a recording, 56 bytes each; raises DataError when it has none."""
    t_ns, values = array("q"), array("d")
    for value in recording.events(_NO_FRAMES_NS):
        if isinstance(value, ImuSample):
            t_ns.append(value.t_ns)
            values.extend((*value.gyro_rad_s, *value.accel_m_s2))
    if len(t_ns) < 2:
        raise DataError(f"{uri} has no inertial data to play")
    return InertialTable(
        np.frombuffer(t_ns, dtype=np.int64), np.frombuffer(values, dtype=np.float64).reshape(-1, 6), rate_hz
    )


def read_along(opener: Callable[[], Recording], setup: SensorSetup, seed: int) -> Iterator[Reading]:
    """Return the readings of all further sensors beside a recording in time order.

    Raises DataError where one cannot be read, or shall be drawn and the recording has no truth.
    """
    further = FurtherReadings(opener(), setup, seed)
    return heapq.merge(*further.streams(), key=lambda reading: reading.t_ns)
