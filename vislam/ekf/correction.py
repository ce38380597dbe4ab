"""What one frame gives the filter: the same value for the filter beside vision and for one in another process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from vislam.core.messages import Observations, Tracking, VoMeasurement, no_observations
from vislam.core.readings import OwnStart, Reading
from vislam.imu import SeenNoise

if TYPE_CHECKING:
    from vislam.ekf.loose.filter import Ekf
    from vislam.ekf.tight import MsckfEkf
    from vislam.ekf.timeline import UpdateResult


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The motion that vision saw, whether the body rests, and the keyframe that the frame became."""

    t_ns: int
    vo: VoMeasurement
    observations: Observations  # of no use to a loose filter
    at_rest: bool
    on_wheels: bool  # of a cart that moves: its axle goes neither sideways nor up; loose filters only
    keyframe_id: int | None  # None: no keyframe
    shows_scale: bool = True  # False: one camera, and motion too uniform; of no use to a loose filter
    noise: SeenNoise | None = None  # since when samples are noisier or calmer; None: as before
    imu_until_ns: int | None = None  # samples after this time are no information; None: all are

    def __reduce__(self) -> tuple[Callable[..., Correction], tuple[Any, ...]]:
        """Travel as plain numbers: dataclasses and arrays by themselves take a third of what the filter then takes."""
        motion = {one.name: _plain(getattr(self.vo, one.name)) for one in fields(VoMeasurement)}
        motion["tracking"] = self.vo.tracking.value
        seen = None if self.observations.are_none else self.observations
        others = (self.at_rest, self.on_wheels, self.keyframe_id, self.shows_scale, self.noise, self.imu_until_ns)
        return _correction, (self.t_ns, motion, seen, *others)

    def apply(self, ekf: Ekf | MsckfEkf) -> UpdateResult:
        """Give everything to a filter; return what it made of the motion at once."""
        if self.noise is not None:  # it is of before the frame, and what is replayed once only goes ahead
            ekf.follow_noise(self.noise.t_ns, self.noise.scale)
        ekf.believe(self.imu_until_ns)
        answer = ekf.correct(self)
        ekf.assume(self.t_ns)  # a frame does not wait for ever: no sample comes
        return answer


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _correction(t_ns: int, motion: dict[str, Any], seen: Observations | None, *others: Any) -> Correction:
    """Return what `Correction.__reduce__` took apart."""
    arrays = {name: np.array(value, dtype=np.float64) for name, value in motion.items() if isinstance(value, list)}
    vo = VoMeasurement(**motion | arrays | {"tracking": Tracking(motion["tracking"])})
    return Correction(t_ns, vo, no_observations() if seen is None else seen, *others)


@dataclass(frozen=True, slots=True)
class Hint:
    """What holds the drift of a body that the camera does not see: it rests, or moves as wheels let it."""

    t_ns: int
    at_rest: bool  # False: on wheels


@dataclass(frozen=True, slots=True)
class AppliedReading:
    """What a sensor other than IMU and camera measured, or first values of its own variables, and when that was."""

    t_ns: int
    what: Reading | OwnStart

    def apply(self, ekf: Ekf | MsckfEkf) -> UpdateResult:
        """Give it to a filter."""
        what = self.what
        return ekf.update_sensor(what) if isinstance(what, Reading) else ekf.begin_sensor(self.t_ns, what)
