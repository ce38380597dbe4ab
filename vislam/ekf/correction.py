"""What one frame tells the filter: the same value for the filter beside vision and for one in another process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vislam.core.messages import Observations, Tracking, VoMeasurement, no_observations
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.loose.filter import Ekf
from vislam.imu import SeenNoise

if TYPE_CHECKING:
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

    def __reduce__(self) -> tuple[Callable[..., Correction], tuple[Any, ...]]:
        """Travel as plain numbers: dataclasses and arrays by themselves take a third of what the filter then takes."""
        vo = self.vo
        T = None if vo.T_keyframe_body is None else vo.T_keyframe_body.tolist()
        motion = (vo.t_ns, vo.keyframe_id, T, vo.covariance.tolist(), vo.has_scale, vo.tracking.value, vo.inliers)
        seen = self.observations if len(self.observations.track_ids) else None
        others = (self.at_rest, self.on_wheels, self.keyframe_id, self.shows_scale, self.noise)
        return _correction, (self.t_ns, motion, seen, *others)

    def apply(self, ekf: Ekf | MsckfEkf) -> UpdateResult:
        """Give everything to a filter; return what it said to the motion."""
        if self.noise is not None:  # it is of before the frame, and what is replayed once only goes ahead
            ekf.follow_noise(self.noise.t_ns, self.noise.scale)
        if isinstance(ekf, Ekf):
            return self._apply_loosely(ekf)
        answer = ekf.update_vision(self.vo, self.observations, self.shows_scale)
        if self.at_rest:
            ekf.update_zero_velocity(self.t_ns)
        if self.keyframe_id is not None:
            ekf.add_keyframe(self.keyframe_id, self.t_ns)
        return answer

    def _apply_loosely(self, ekf: Ekf) -> UpdateResult:
        with ekf.replayed_once():
            answer = ekf.update_vision(self.vo, self.observations)
            if self.at_rest:
                ekf.update_zero_velocity(self.t_ns)
            elif self.on_wheels:
                ekf.update_nonholonomic(self.t_ns)
            if self.keyframe_id is not None:
                ekf.add_keyframe(self.keyframe_id, self.t_ns)
            return answer


def _correction(t_ns: int, motion: tuple[Any, ...], seen: Observations | None, *others: Any) -> Correction:
    """Return what `Correction.__reduce__` took apart."""
    vo_t_ns, clone_id, T, covariance, has_scale, tracking, inliers = motion
    T_keyframe_body = None if T is None else np.array(T, dtype=np.float64)
    covariance = np.array(covariance, dtype=np.float64)
    vo = VoMeasurement(vo_t_ns, clone_id, T_keyframe_body, covariance, has_scale, Tracking(tracking), inliers)
    return Correction(t_ns, vo, no_observations() if seen is None else seen, *others)


@dataclass(frozen=True, slots=True)
class Hint:
    """What holds the drift of a body that the camera does not see: it rests, or moves as wheels let it."""

    t_ns: int
    at_rest: bool  # False: on wheels

    def apply(self, ekf: Ekf) -> UpdateResult:
        """Give it to a filter."""
        return ekf.update_zero_velocity(self.t_ns) if self.at_rest else ekf.update_nonholonomic(self.t_ns)


@dataclass(frozen=True, slots=True)
class ToldReading:
    """What a sensor other than IMU and camera told, or first values of its own variables, and when that was."""

    t_ns: int
    what: Reading | OwnStart

    def apply(self, ekf: Ekf | MsckfEkf) -> UpdateResult:
        """Give it to a filter."""
        what = self.what
        return ekf.update_sensor(what) if isinstance(what, Reading) else ekf.begin_sensor(self.t_ns, what)
