"""Sensors of the cart: inertial chips, serial bridge, webcam. Every driver stamps at capture and counts its faults."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.hw.health import Health
    from vislam.hw.port_readings import PortReadings

__all__ = [
    "Health",
    "PortReadings",
]

__getattr__ = late(
    __name__,
    {
        "Health": "vislam.hw.health",
        "PortReadings": "vislam.hw.port_readings",
    },
)
