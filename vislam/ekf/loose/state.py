"""What the loose filter estimates, and what it knows besides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from vislam.core.messages import AS_MODELLED, Array, NoiseScale
from vislam.ekf.loose.kernels import ERRORS, NOMINAL
from vislam.ekf.regain import Watch
from vislam.ekf.sensor_rows import OwnVariables


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
    own_since_ns: Mapping[str, int] = field(default_factory=dict)  # see `OwnVariables`
    watch: Watch = field(default_factory=Watch)  # which sensors it believes


@dataclass(slots=True, eq=False)
class LooseState:
    """The filter at one instant; x and P are changed in place."""

    x: Array  # [23 + K] see `kernels`
    P: Array  # [21 + K, 21 + K]
    ledger: Ledger
    sigmas: Array  # [6] of the IMU, with the noise that goes on now, see `Ekf.follow_noise`

    @property
    def last_vision_t_ns(self) -> int:
        """When visual odometry last corrected it; the start, before."""
        return self.ledger.last_vo_t_ns

    @property
    def own(self) -> OwnVariables:
        """The sensors' own variables; views."""
        return OwnVariables(self.x[NOMINAL:], self.P[ERRORS:, ERRORS:], self.ledger.own_since_ns)

    def copy(self) -> LooseState:
        """Return a copy that further steps leave alone."""
        return LooseState(self.x.copy(), self.P.copy(), self.ledger, self.sigmas)
