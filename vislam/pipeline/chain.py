"""The chain of keyframes: where visual odometry has the body on it, and the packet of each new keyframe."""

from dataclasses import replace

import numpy as np

from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import invert, se3_adjoint, se3_log
from vislam.core.memory import Learned
from vislam.core.messages import (
    Array,
    Frame,
    ImuSpan,
    Keyframe,
    KeyframePacket,
    MagSample,
    NavState,
    VoMeasurement,
    no_observations,
)
from vislam.frontend import FrontEnd, TrackResult
from vislam.frontend.result import lost_motion, scaled_motion
from vislam.pipeline.coasting import Coasting
from vislam.pipeline.inertial_stages import Inertial

_CONTRADICTION = chi_square_limit(0.9999, 6)
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
        is_torn: whether an unknown time has passed since the keyframe.
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
        self._is_lost, self.is_torn = False, False
        self._coasting = Coasting()
        self._placed: tuple[Array, Array] | None = None  # newest frame that was: motion, covariance
        self._most_m2 = submap_sigma_m**2

    def begin_at(self, T_vo_body: Array) -> None:
        """Take the pose [4, 4] of the keyframe at which an earlier run ended."""
        self._T_vo_keyframe, self.T_vo_body = T_vo_body, T_vo_body.copy()

    def tear(self) -> None:
        """Forget how the body moved: what comes next is after an unknown time."""
        self._coasting.restart()
        self._placed, self.is_torn = None, True

    def follow(self, vo: VoMeasurement, at_rest: bool) -> None:
        """Take a frame's motion since the keyframe, and whether the body rested over it."""
        self._rests, self._is_lost = self._rests and at_rest, not vo.tracking.sees
        if vo.T_keyframe_body is not None:
            self.T_vo_body = self._T_vo_keyframe @ scaled_motion(vo)
            if vo.has_scale:
                sigma_m = float(np.sqrt(np.linalg.eigvalsh(vo.covariance[3:, 3:])[-1]))
                if self._coasting.follow(vo.t_ns, self.T_vo_body, sigma_m):
                    self._placed = vo.T_keyframe_body, vo.covariance
        elif (coasted := self._coasted(vo.t_ns)) is not None:
            self.T_vo_body = self._T_vo_keyframe @ coasted[0]

    def contradicts(self, vo: VoMeasurement) -> bool:
        """Return whether a keyframe is seen from where the body cannot have come: what is seen there looks alike.

        After a loss, habit decides; while tracks are followed a body may be jerked out of it, but hardly thrown.
        """
        if not vo.tracking.sees or vo.T_keyframe_body is None or not vo.has_scale:
            return False
        coasted = self._coasted(vo.t_ns)
        if coasted is None or vo.keyframe_id != self.id:
            return False
        off = se3_log(invert(coasted[0]) @ vo.T_keyframe_body)
        if not self._is_lost and np.linalg.norm(off[3:]) < self._coasting.jerked_m(vo.t_ns):
            return False
        return bool(off @ np.linalg.solve(coasted[1] + vo.covariance, off) > _CONTRADICTION)

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
        is_led = self.id < 0 or track.vo.tracking.sees or self.is_bridged(keyframe.t_ns, imu, state)
        vo = track.vo if is_led or imu is not None else self._with_habit(track.vo)
        begins_submap = not is_led or keyframe.id == self.first_id > 0
        at_rest = self._rests and self.id >= 0
        return KeyframePacket(keyframe, vo, track.observations, imu, self.mag, at_rest, offset_s, begins_submap)

    def extend(self, packet: KeyframePacket, T_odom_body: Array | None, state: NavState | None) -> None:
        """Make the keyframe of a packet the newest."""
        if packet.begins_submap and packet.vo.T_keyframe_body is None:
            self._coasting.restart()
        elif self._coasting.newest_ns != packet.keyframe.t_ns:
            self._coasting.go_on(packet.keyframe.t_ns, self.T_vo_body)
        self._variance_m2 = _variance_m2(state)
        self.id, self.t_ns = packet.keyframe.id, packet.keyframe.t_ns
        self._rests, self.mag = True, None
        self._T_vo_keyframe = self.T_vo_body.copy()
        self._T_odom_keyframe = T_odom_body
        self._placed, self.is_torn = (np.eye(4), np.zeros((6, 6))), False

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
        self._coasting.restart()

    def is_bridged(self, t_ns: int, imu: ImuSpan | None, state: NavState | None) -> bool:
        """Return whether inertial data since the keyframe tie a frame to it that vision does not.

        `state` is the filter's at the frame.
        """
        if imu is None:
            return False
        if not np.isfinite(self._variance_m2):
            return (t_ns - self.t_ns) * 1e-9 <= _BLIND_S
        return bool(_variance_m2(state) - self._variance_m2 <= self._most_m2)

    def _coasted(self, t_ns: int) -> tuple[Array, Array] | None:
        """Return the motion [4, 4] since the keyframe at constant velocity from the last placed frame on.

        And its covariance [6, 6]; None before there is a velocity.
        """
        ahead = self._coasting.ahead(t_ns)
        if ahead is None or self._placed is None:
            return None
        back = se3_adjoint(invert(ahead[0]))
        return self._placed[0] @ ahead[0], back @ self._placed[1] @ back.T + ahead[1]

    def _with_habit(self, vo: VoMeasurement) -> VoMeasurement:
        """Return the measurement of a frame that vision lost, with the motion that habit makes likely."""
        if (coasted := self._coasted(vo.t_ns)) is None:
            return vo
        return replace(vo, T_keyframe_body=coasted[0], covariance=coasted[1], has_scale=True)


def seek_place(frontend: FrontEnd, keyframe_id: int) -> None:
    """Let a front end begin again with its next frame, as keyframe `keyframe_id`, as after a loss."""
    frontend.begin_at(keyframe_id, Learned(frontend.learned.next_track_id), seeks_place=True)


def believed(track: TrackResult, chain: KeyframeChain, frontend: FrontEnd) -> TrackResult:
    """Return a track; lost, and the front end begins again, where the keyframe is found where the body cannot be."""
    if not chain.contradicts(track.vo):
        return track
    seek_place(frontend, chain.id + 1)
    vo = lost_motion(track.vo.t_ns, chain.id, track.vo.has_scale)
    return TrackResult(vo, no_observations(), None, 0.0, "what was found looks like the keyframe, too far away")


def torn(
    frame: Frame, chain: KeyframeChain, frontend: FrontEnd, imu: Inertial | None, last_t_ns: int | None = None
) -> bool:
    """Tie nothing from a frame on to what was before, if the clock stepped there; return whether it did.

    After a hole in camera and IMU since `last_t_ns` the filter alone begins again; None: other sensors go on in it.
    """
    if not frame.follows_step:
        if imu is not None and last_t_ns is not None:
            imu.level_after_hole(last_t_ns, frame.t_ns, chain.id, chain.T_odom_body)
        return False
    seek_place(frontend, chain.id + 1)
    chain.tear()
    if imu is not None:
        imu.filtering.tear(lost_motion(frame.t_ns, chain.id, True))
    return True


def _variance_m2(state: NavState | None) -> float:
    """Return how unsure a filter is of where the body is; infinite before it has a state."""
    return np.inf if state is None else float(np.trace(state.covariance[3:6, 3:6]))
