"""What the live driver asks of cameras and further sensors; of an IMU it asks what `InertialSource` has."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

from vislam.core.messages import Frame, ImageU8
from vislam.core.readings import Reading
from vislam.hw.health import Health
from vislam.sensors.geodetic import Geodetic


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
