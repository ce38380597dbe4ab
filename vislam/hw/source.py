"""What the live driver asks of a sensor: read with a limit on waiting, a health word, close."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

from vislam.core.messages import Array, Frame, ImageU8, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.hw.health import Health
from vislam.sensors.geodetic import Geodetic


class InertialSource(Protocol):
    """An IMU, and its magnetometer if any, that yields calibrated body-frame samples stamped at capture."""

    rate_hz: float

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the gyro; None where it has none."""
        ...

    def zeroed_at(self, temperature_c: float, gyro_per_c: Array) -> None:
        """Set at which temperature biases were taken, and by how much [3] the gyro's change per deg C (rad/s).

        From then on samples come without that drift, so that an estimator's bias stays what it was there.
        """
        ...

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured since the last call, in time order (CLOCK_MONOTONIC ns).

        Waits at most `timeout_s` for the first one; an empty list: none came, and `health` has the reason. A sensor
        that went away is looked for again in later calls. Never raises for what a plug or a cable can cause.
        """
        ...

    def health(self) -> Health:
        """Return the sensor bits that hold now; passing events (a gap, saturation) stay set until this call."""
        ...

    def counters(self) -> dict[str, int]:
        """Return how often each fault occurred since the start."""
        ...

    def close(self) -> None:
        """Give the device back; may be called twice."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class CapturedImage:
    """The newest image of a camera."""

    t_ns: int  # of capture, CLOCK_MONOTONIC: middle of the exposure where the device knows it, else the driver's stamp
    index: int  # counts captured images, so that a hole shows how many were dropped
    image: ImageU8  # [H, W] or [H, W, 3] BGR


Shot_co = TypeVar("Shot_co", CapturedImage, Frame, covariant=True)


class ShotSource(Protocol[Shot_co]):
    """A camera, or the cameras of a rig, that keep their newest shot only; gaps in its index count what was dropped."""

    def read(self, timeout_s: float) -> Shot_co | None:
        """Return the newest shot not yet returned, waiting at most `timeout_s`; None if none came."""
        ...

    def health(self) -> Health:
        """Return CAMERA_MISSING or nothing."""
        ...

    def counters(self) -> dict[str, int]:
        """Return shots captured, dropped as too old, and faults since the start."""
        ...

    def close(self) -> None:
        """Give the device back; may be called twice."""
        ...


ImageSource = ShotSource[CapturedImage]
FrameSource = ShotSource[Frame]


class ReadingSource(Protocol):
    """Sensors that are read beside the camera; nothing here may wait."""

    def read(self) -> list[Reading]:
        """Return the readings that came since the last call, at once, stamped by CLOCK_MONOTONIC."""
        ...

    def status(self) -> dict[str, str]:
        """Return by sensor "well", or its problem."""
        ...

    def counters(self) -> dict[str, dict[str, int]]:
        """Return by sensor how many readings came, and how often each fault occurred."""
        ...

    def datums(self) -> dict[str, Geodetic]:
        """Return by receiver where its frame begins, as far as it has reported."""
        ...

    def close(self) -> None:
        """Give all devices back; may be called twice."""
        ...
