"""What the live driver asks of a sensor: read with a limit on waiting, a health word, close."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from vislam.core.messages import Array, ImageU8, ImuSample, MagSample
from vislam.hw.health import Health


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


class ImageSource(Protocol):
    """A camera that keeps its newest image only."""

    def read(self, timeout_s: float) -> CapturedImage | None:
        """Return the newest image not yet returned, waiting at most `timeout_s`; None if none came."""
        ...

    def health(self) -> Health:
        """Return CAMERA_MISSING or nothing."""
        ...

    def counters(self) -> dict[str, int]:
        """Return images captured, dropped as too old, and faults since the start."""
        ...

    def close(self) -> None:
        """Give the device back; may be called twice."""
        ...
