"""How soon the system lets the process of the pose run when a sample is there."""

from __future__ import annotations

import ctypes
import os
import struct

from vislam.config import LiveConfig
from vislam.live.processes.child import Life

_ATTRIBUTES = struct.Struct("<IIQiIQQQ")  # sched_attr: size, policy, flags, nice, priority, runtime, deadline, period
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}  # the number of the system call; Python has no function for it
_TURN_NS = 500_000  # for a sample and a late frame; in shorter ones, cut apart, it falls behind on a busy machine


def take_priority(live: LiveConfig, life: Life) -> None:
    """Run before others: always where the system permits `live.realtime_priority`, else sooner than usual."""
    if live.realtime_priority > 0:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(live.realtime_priority))
            return
        except OSError as error:
            life.note(
                warning=f"no real-time priority for the pose ({error}); see docs/cart.md, or --live.realtime-priority 0"
            )
    take_short_turns()


def take_short_turns() -> None:
    """Ask for short turns on the processor: since Linux 6.12 these may cut in on another's long one when they come.

    Anybody may ask. An older kernel, or another processor than the usual ones, goes on as before.
    """
    number = _SCHED_SETATTR.get(os.uname().machine)
    if number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return
    attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, os.nice(0), 0, _TURN_NS, 0, 0)
    ctypes.CDLL(None).syscall(number, 0, attributes, 0)
