"""What the filter remembers so that it can go back: measurements in time order and states to start again from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from vislam.ekf.timeline import Timeline
from vislam.messages import AS_MODELLED, Array, NoiseScale, VoMeasurement

OUTCOMES = (  # every counter a measurement can end in, and what they cause
    "keyframes",
    "vo_accepted",
    "vo_gated",  # failed the chi-square gate
    "vo_opposed",  # moved against the direction seen
    "vo_no_keyframe",  # relative to a keyframe that is not the cloned one
    "vo_no_scale",  # accumulated vision needs metric motion
    "vo_lost",
    "vo_invalid",
    "zero_velocity_accepted",
    "zero_velocity_gated",
    "nonholonomic_accepted",
    "nonholonomic_gated",
    "bias_accepted",
    "bias_gated",
    "bias_invalid",
    "noise_changes",
    "noise_invalid",
    "before_start",
    "too_late",
    "too_early",
    "rewinds",
    "soft_resets",
)


class Kind(StrEnum):
    """What an event does to the filter."""

    KEYFRAME = "keyframe"
    VO = "vo"
    ZERO_VELOCITY = "zero_velocity"
    NONHOLONOMIC = "nonholonomic"
    BIAS = "bias"
    NOISE = "noise"


@dataclass(slots=True, eq=False)
class Event:
    """A measurement, and what became of it the last time it was applied."""

    t_ns: int
    kind: Kind
    keyframe_id: int = -1
    vo: VoMeasurement | None = None
    bias: Array | None = None  # [12] gyro, accel, and their sigmas
    noise: NoiseScale = AS_MODELLED  # from here on, over what the filter was made with
    outcome: str = ""  # the counter it stands in; "" while it waits for the IMU
    was_reset: bool = False
    accepted: bool = False
    nis: float = float("nan")
    degrees: int = 0  # of freedom, of `nis`
    reason: str = "waits for an inertial sample as new"


@dataclass(frozen=True, slots=True, eq=False)
class Ledger:
    """What the filter knows besides x and P."""

    clone_id: int | None = None
    # added to the clone for shared landmark errors; None: several keyframes stand there, each with its own
    shared: Array | None = field(default_factory=lambda: np.zeros((6, 6)))
    clone_rests: bool = False  # the clone was taken in the rest that goes on
    rested_t_ns: int | None = None  # when the body was last seen at rest
    rejects: int = 0  # in a row
    rejects_since_ns: int = 0
    last_vo_t_ns: int = 0
    T_odom_keyframe: Array | None = None  # [4, 4] where accumulated vision has the keyframe
    T_odom_vo: Array | None = None  # [4, 4] where it had the body last, and when
    vo_t_ns: int = 0
    noise: NoiseScale = AS_MODELLED  # white noise of the IMU over that of the model
    floor_z_m: float = 0.0  # height of the body in `odom` at the start, where a floor keeps it


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """The whole filter at one instant, after `applied` events since the start."""

    t_ns: int
    applied: int
    x: Array
    P: Array
    ledger: Ledger


class History(Timeline[Event, Checkpoint]):
    """What came to the filter and where it can go back to."""

    def rewind(self, number: int, t_ns: int) -> Checkpoint:
        """Drop the checkpoints that an event of this number and time invalidates; return the newest that is left.

        The caller has made sure that the event is not older than the first checkpoint.
        """
        while self.checkpoints[-1].t_ns > t_ns or self.checkpoints[-1].applied > number:
            self.checkpoints.pop()
        return self.checkpoints[-1]


def add_nis(sums: dict[str, tuple[int, float, int]], events: Iterable[Event]) -> dict[str, tuple[int, float, int]]:
    """Return count, sum of NIS and sum of degrees of freedom by kind, with those of accepted events added."""
    out = dict(sums)
    for event in events:
        if event.accepted and event.degrees:
            count, nis, degrees = out.get(event.kind.value, (0, 0.0, 0))
            out[event.kind.value] = count + 1, nis + event.nis, degrees + event.degrees
    return out
