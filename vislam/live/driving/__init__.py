"""Driving to goals: along a route, on the published pose alone, and standing still where that is in doubt."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.live.driving.driver import Driver
    from vislam.live.driving.lock_step import LockStepCart, drive
    from vislam.live.driving.orders import Goal
    from vislam.live.driving.pursuit import Limits

__all__ = ["Driver", "Goal", "Limits", "LockStepCart", "drive"]

__getattr__ = late(
    __name__,
    {
        "Driver": "vislam.live.driving.driver",
        "LockStepCart drive": "vislam.live.driving.lock_step",
        "Goal": "vislam.live.driving.orders",
        "Limits": "vislam.live.driving.pursuit",
    },
)
