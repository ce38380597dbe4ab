"""What one frame tells the filter: the same value for the filter beside vision and for one in another process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vislam.ekf.filter import Ekf
from vislam.messages import Observations, VoMeasurement

if TYPE_CHECKING:
    from vislam.ekf.filter import UpdateResult
    from vislam.ekf.msckf import MsckfEkf


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

    def apply(self, ekf: Ekf | MsckfEkf) -> UpdateResult:
        """Give everything to a filter; return what it said to the motion."""
        if isinstance(ekf, Ekf):
            answer = ekf.update_vision(self.vo, self.observations)
        else:
            answer = ekf.update_vision(self.vo, self.observations, self.shows_scale)
        if self.at_rest:
            ekf.update_zero_velocity(self.t_ns)
        elif self.on_wheels and isinstance(ekf, Ekf):
            ekf.update_nonholonomic(self.t_ns)
        if self.keyframe_id is not None:
            ekf.add_keyframe(self.keyframe_id, self.t_ns)
        return answer


@dataclass(frozen=True, slots=True)
class Hint:
    """What holds the drift of a body that the camera does not see: it rests, or moves as wheels let it."""

    t_ns: int
    at_rest: bool  # False: on wheels

    def apply(self, ekf: Ekf) -> UpdateResult:
        """Give it to a filter."""
        return ekf.update_zero_velocity(self.t_ns) if self.at_rest else ekf.update_nonholonomic(self.t_ns)
