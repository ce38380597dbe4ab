"""The chain of keyframes: where visual odometry has the body on it, and the packet of each new keyframe."""

from __future__ import annotations

import numpy as np

from vislam.core.geometry import invert
from vislam.core.messages import (
    Array,
    ImuSpan,
    Keyframe,
    KeyframePacket,
    MagSample,
    NavState,
    Tracking,
    VoMeasurement,
)
from vislam.frontend import TrackResult
from vislam.frontend.result import scaled_motion

_BLIND_S = 5.0  # dead reckoning from an unknown velocity is off by metres after so long


class KeyframeChain:
    """Owns the newest keyframe's pose and what has happened since; a packet ends what happened.

    Poses are in `vo`, the frame of visual odometry alone, and in `odom`; without an IMU these are the same.

    Attributes:
        first_id: the first keyframe's of this recording; above 0 it begins a submap of an earlier map.
        id: the newest keyframe's, -1 before the first.
        t_ns: its time.
        mag: the newest sample of the magnetometer since then.
        T_vo_body: [4, 4] at the newest frame.
        T_odom_body: [4, 4] there as it was last known; None: never, or lost.
    """

    def __init__(self, T_vo_body: Array, submap_sigma_m: float) -> None:
        """Begin at a pose [4, 4]; beyond `submap_sigma_m` of new uncertainty inertial data tie keyframes no longer."""
        self.first_id, self.id, self.t_ns = 0, -1, 0
        self.mag: MagSample | None = None
        self.T_vo_body = T_vo_body.copy()
        self.T_odom_body: Array | None = None
        self._T_vo_keyframe = T_vo_body
        self._T_odom_keyframe: Array | None = None
        self._rests = True  # since the keyframe
        self._variance_m2 = 0.0  # of the filter's position there
        self._most_m2 = submap_sigma_m**2

    def begin_at(self, T_vo_body: Array) -> None:
        """Take the pose [4, 4] of the keyframe at which an earlier run ended."""
        self._T_vo_keyframe, self.T_vo_body = T_vo_body, T_vo_body.copy()

    def follow(self, vo: VoMeasurement, at_rest: bool) -> None:
        """Take a frame's motion since the keyframe, and whether the body rested over it."""
        self._rests = self._rests and at_rest
        if vo.T_keyframe_body is not None:
            self.T_vo_body = self._T_vo_keyframe @ scaled_motion(vo)

    def by_vision(self, vo: VoMeasurement) -> Array | None:
        """Return the pose in `odom` of a frame that inertial data do not reach: vision carries the keyframe's on."""
        if self._T_odom_keyframe is None or vo.T_keyframe_body is None:
            return self.T_odom_body
        return self._T_odom_keyframe @ scaled_motion(vo)

    def since_keyframe(self, vo: VoMeasurement, T_odom_body: Array | None) -> Array | None:
        """Return the motion [4, 4] since the keyframe: as vision measured it, else by poses in `odom`."""
        if vo.has_scale and vo.T_keyframe_body is not None:
            return vo.T_keyframe_body
        if T_odom_body is None or self._T_odom_keyframe is None:
            return None
        return invert(self._T_odom_keyframe) @ T_odom_body

    def packet(
        self, track: TrackResult, keyframe: Keyframe, imu: ImuSpan | None, state: NavState | None, offset_s: float
    ) -> KeyframePacket:
        """Return all that the back end needs of a new keyframe.

        Args:
            track: the frame's.
            keyframe: that it became.
            imu: inertial data since the keyframe before.
            state: the filter's at the keyframe.
            offset_s: by which the camera's stamp was moved.
        """
        begins_submap = track.vo.tracking is Tracking.LOST and not self.is_bridged(keyframe.t_ns, imu, state)
        begins_submap = begins_submap or keyframe.id == self.first_id > 0
        at_rest = self._rests and self.id >= 0
        return KeyframePacket(keyframe, track.vo, track.observations, imu, self.mag, at_rest, offset_s, begins_submap)

    def extend(self, keyframe: Keyframe, T_odom_body: Array | None, state: NavState | None) -> None:
        """Make a keyframe, whose packet is made, the newest."""
        self._variance_m2 = _variance_m2(state)
        self.id, self.t_ns = keyframe.id, keyframe.t_ns
        self._rests, self.mag = True, None
        self._T_vo_keyframe = self.T_vo_body.copy()
        self._T_odom_keyframe = T_odom_body

    def place(self, T_odom_keyframe: Array | None) -> None:
        """Take where the newest keyframe is in `odom` [4, 4], None: that is not known."""
        self._T_odom_keyframe = T_odom_keyframe

    @property
    def T_vo_keyframe(self) -> Array:
        """The newest keyframe's pose [4, 4] in `vo`."""
        return self._T_vo_keyframe

    def stand_up(self, T_upright: Array) -> None:
        """Turn `vo` by T_upright [4, 4]: it is `odom` from now on."""
        self._T_vo_keyframe, self.T_vo_body = T_upright @ self._T_vo_keyframe, T_upright @ self.T_vo_body

    def is_bridged(self, t_ns: int, imu: ImuSpan | None, state: NavState | None) -> bool:
        """Return whether inertial data since the keyframe tie a frame to it that vision does not.

        `state` is the filter's at the frame.
        """
        if imu is None:
            return False
        if not np.isfinite(self._variance_m2):
            return (t_ns - self.t_ns) * 1e-9 <= _BLIND_S
        return bool(_variance_m2(state) - self._variance_m2 <= self._most_m2)


def _variance_m2(state: NavState | None) -> float:
    """Return how unsure a filter is of where the body is; infinite before it has a state."""
    return np.inf if state is None else float(np.trace(state.covariance[3:6, 3:6]))
