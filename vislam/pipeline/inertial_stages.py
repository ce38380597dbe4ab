"""What an IMU gives the front half: its samples, the filter that runs on them, and rest."""

from dataclasses import dataclass, replace

import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.geometry import level_rotation, so3_exp, transform
from vislam.core.messages import AS_MODELLED, Array, GraphUpdate, ImuSpan, NavState, NoiseScale, Tracking
from vislam.ekf.filtering import Filtering
from vislam.frontend import TrackResult
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.result import lost_motion
from vislam.frontend.stillness import Stillness
from vislam.imu import (
    ConditionWatch,
    ImuBuffer,
    ImuNoise,
    MotionWitness,
    RestDetector,
    is_slow,
    pose_after,
    subtract_bias,
)
from vislam.pipeline.steps import Estimate
from vislam.sensors import Suite

_KNOWN_MOTION_M = 0.02  # sigma of the motion between two frames below which the filter may overrule the image
_FELT_NS, _FRESH_NS = 100_000_000, 1_000_000_000  # of samples that say what is level, and how old they may be
_ASTRAY_RAD, _ASTRAY_M_S = 0.4, 10.0  # sigmas of a filter that is to begin again
_SWAY_M_S = 0.03  # that a filter at rest may take for speed; a body that sets off is soon faster


@dataclass(frozen=True, slots=True, eq=False)
class Since:
    """What is known of the motion since the last frame before the next one is looked at."""

    span: ImuSpan | None = None  # None: no IMU, or a hole
    state: NavState | None = None  # the filter's newest
    unbiased: ImuSpan | None = None  # the span, with the biases of the state taken off
    gyro_sigma_rad_s: float = np.inf  # how well the rate of turn is known
    T_last_now: Array | None = None  # [4, 4] where the filter knows it to centimetres


class Inertial:
    """Owns the buffer of samples, the filter and the two watches for rest.

    Attributes:
        buffer: the last seconds of samples, and what they show of their noise.
        condition: whether the IMU is used within its limits.
        filtering: the filter, and what is on its way to it.
    """

    def __init__(self, config: Config, rig: Rig, noise: ImuNoise, suite: Suite | None) -> None:
        """Set up for an IMU; `config` is as `settings.derived` gives it, `suite` are further sensors, if any."""
        self.buffer = ImuBuffer(config.imu, config.machine, noise)
        self.condition = ConditionWatch()
        self.filtering = Filtering(config.ekf, noise, config.machine, rig, suite)
        self._rest, self._stillness, self._witness = RestDetector(config.init, noise), Stillness(), MotionWitness()
        self._is_corrected = config.ekf.vision != "none"
        self._gravity_m_s2, self._bias_walk = config.machine.gravity_m_s2, noise.gyroscope_random_walk
        self._at_frame: NavState | None = None  # the filter's state at the last frame
        self._of_graph: NavState | None = None  # the graph's at its newest keyframe

    @property
    def noise_scale(self) -> NoiseScale:
        """White noise of the IMU over that of its model, as the newest samples show it."""
        floor = self.buffer.noise_floor
        return AS_MODELLED if floor is None else floor.now.scale

    @property
    def turns(self) -> tuple[tuple[Array, Array], ...]:
        """The last large turns [3, 3] of the body, by gyroscope and by vision."""
        return tuple(self._witness.turns)

    def since(self, last_t_ns: int | None, t_ns: int, clock: CameraClock) -> Since:
        """Return what is known of the motion since the last frame, None: there was none, with `clock` the camera's."""
        span = None if last_t_ns is None else self.buffer.unbroken(last_t_ns, t_ns)
        state = self.filtering.state
        if state is None or last_t_ns is None:
            return Since(span, state, span)
        if self._witness.doubts:
            return Since(span, state)  # vision is not to be drawn to what it contradicts
        dt_s, sigmas = (t_ns - last_t_ns) * 1e-9, state.covariance
        is_known = np.sqrt(np.trace(sigmas[6:9, 6:9])) * dt_s <= _KNOWN_MOTION_M
        motion = self.filtering.motion(last_t_ns, t_ns) if is_known else None
        if span is None:
            return Since(span, state, span, T_last_now=motion)
        sigma_rad_s = float(np.sqrt(np.diag(sigmas)[9:12].max())) + clock.gyro_sigma_rad_s(span)
        unbiased = subtract_bias(span, state.gyro_bias_rad_s, state.accel_bias_m_s2)
        return Since(span, state, unbiased, sigma_rad_s, motion)

    def compare(self, track: TrackResult, T_vo_body: Array, since: Since) -> Since:
        """Compare what vision saw of a frame with the samples; return what is known of the motion before it by now.

        T_vo_body [4, 4] is where vision has the body.
        """
        witness, state = self._witness, since.state
        if state is None or not self._is_corrected:
            return since
        biases = state.gyro_bias_rad_s, state.accel_bias_m_s2
        witness.see(track.vo, track.outliers, T_vo_body, self.buffer.as_felt, biases)
        if track.vo.has_scale and (burst_ns := self.buffer.burst_ns(track.vo.t_ns)) is not None:
            witness.doubt(burst_ns, track.vo.t_ns)  # stamps of arrival are no times of measurement
        self.buffer.believe(witness.until_ns, witness.since_ns)
        return since if witness.until_ns is None else Since(None, state)

    def level_after_hole(self, last_t_ns: int, t_ns: int, keyframe_id: int, T_odom_body: Array | None) -> None:
        """Begin the filter again, level by the newest samples, after a hole in which neither camera nor IMU measured.

        A body has turned by an unknown angle meanwhile, and a linear filter comes back from half a radian at most. Many
        holes among frames that vision lost come to the same. `T_odom_body` [4, 4] is where it was at the last frame.
        """
        felt = self.buffer.after_hole(last_t_ns, t_ns) or self._felt_astray(t_ns)
        if felt is None or T_odom_body is None or self.filtering.state is None:
            return
        yaw = float(np.arctan2(T_odom_body[1, 0], T_odom_body[0, 0]))
        R = so3_exp(np.array([0.0, 0.0, yaw])) @ level_rotation(felt.accel_m_s2.mean(axis=0))
        known_m2 = np.zeros((3, 3)) if self._at_frame is None else self._at_frame.covariance[3:6, 3:6]
        self.filtering.tear(lost_motion(t_ns, keyframe_id, True), transform(R, T_odom_body[:3, 3].copy()), known_m2)

    def _felt_astray(self, t_ns: int) -> ImuSpan | None:
        """Return the newest samples before a frame, if the filter knows too little there; those to come may do."""
        until_ns = min(self.buffer.newest_t_ns or 0, t_ns)
        from_ns, state = until_ns - _FELT_NS, self.filtering.ekf.state_at(until_ns)
        if state is None or not _is_astray(state) or self.buffer.gap_s(from_ns, until_ns) * 1e9 > _FELT_NS:
            return None
        return self.buffer.span(from_ns, until_ns) if t_ns - until_ns < _FRESH_NS else None

    def between_keyframes(self, from_ns: int, to_ns: int) -> ImuSpan | None:
        """Return the samples between two keyframes, if what was seen between them does not contradict them."""
        return None if self._witness.doubted_ns > from_ns else self.buffer.span(from_ns, to_ns)

    def rests(self, track: TrackResult, span: ImuSpan | None) -> tuple[bool, bool]:
        """Return whether the image stood still up to a frame, and whether the body rests by image and samples.

        Without a camera: whether the samples were still, and whether the body rests by them and the filter's speed.
        """
        if track.vo.tracking is Tracking.BLIND:
            still, state = self._rest.add(span), self.filtering.state
            return still, still and state is not None and is_slow(state)
        still_image = self._stillness.add(track.vo.t_ns, track.observations)
        return still_image, self._rest.add(span) and self._stillness.resting

    def correct(
        self, track: TrackResult, at_rest: bool, shows_scale: bool, span: ImuSpan | None, T_by_vision: Array | None
    ) -> tuple[Estimate | None, NavState | None]:
        """Give the filter a frame; return the pose in `odom` and the filter's state there, None where it has none.

        Args:
            track: what was seen in the frame.
            at_rest: whether the body rests.
            shows_scale: whether the motion lets one camera see scale.
            span: inertial data since the last frame; None: there is a hole.
            T_by_vision: [4, 4] the pose where samples do not reach the frame.
        """
        t_ns = track.vo.t_ns
        ekf, floor = self.filtering.ekf, self.buffer.noise_floor
        if not ekf.initialised:
            return None, None
        assert floor is not None
        keyframe_id, until_ns = None if track.keyframe is None else track.keyframe.id, self._witness.until_ns
        self.filtering.see(t_ns, track.vo, track.observations, at_rest, keyframe_id, shows_scale, floor.now, until_ns)
        after, state = ekf.pose_at(t_ns), ekf.state_at(t_ns)
        if after is None:
            after = T_by_vision
        if after is None:
            return None, state
        last, self._at_frame = self._at_frame, state
        # uncorrected, the filter is not to be turned by the graph's bias either
        if not self._is_corrected or state is None or last is None or span is None or span.t_ns[0] != last.t_ns:
            return Estimate(after, after, 0.0), state
        gyro_bias, sigma_rad_s = _surer_gyro_bias(last, self._of_graph, self._bias_walk)
        before = _uncorrected(replace(last, gyro_bias_rad_s=gyro_bias), span, self._gravity_m_s2, at_rest)
        return Estimate(before, after, sigma_rad_s), state

    def feed_back(self, update: GraphUpdate) -> None:
        """Let the graph's biases correct the filter's, if the configuration wants that; the pose does not move."""
        self._of_graph = update.newest
        self.filtering.feed_back(update)


def _is_astray(state: NavState) -> bool:
    """Return whether a filter knows less of tilt or speed than one that begins again."""
    R, P = state.T_world_body[:3, :3], state.covariance
    tilt_rad2 = np.diag(R @ P[:3, :3] @ R.T)[:2].max()
    return bool(tilt_rad2 > _ASTRAY_RAD**2 or np.trace(P[6:9, 6:9]) > _ASTRAY_M_S**2)


def _uncorrected(last: NavState, span: ImuSpan, gravity_m_s2: float, at_rest: bool) -> Array:
    """Return the pose [4, 4] after a span by inertial data alone.

    A correction may enter with a later sample only, so the filter's own prediction is no measure of it.
    """
    after = pose_after(last, span, gravity_m_s2)
    way_m = float(np.linalg.norm(after[:3, 3] - last.T_world_body[:3, 3]))
    sways = way_m < _SWAY_M_S * (int(span.t_ns[-1]) - int(span.t_ns[0])) * 1e-9
    return last.T_world_body if at_rest and sways else after


def _surer_gyro_bias(state: NavState, graph: NavState | None, walk: float) -> tuple[Array, float]:
    """Return the gyroscope's bias [3] and its largest sigma, of the filter or of the graph: whichever is surer.

    For what is published only: the graph has seen the same images longer, and the filter stays what it is alone.
    `walk` is that of the bias, in rad/s^2/sqrt(Hz).
    """
    sigma_rad_s = float(np.sqrt(np.diag(state.covariance)[9:12].max()))
    if graph is None:
        return state.gyro_bias_rad_s, sigma_rad_s
    walked = walk**2 * max(state.t_ns - graph.t_ns, 0) * 1e-9
    graph_rad_s = float(np.sqrt(np.diag(graph.covariance)[9:12].max() + walked))
    if graph_rad_s < sigma_rad_s:
        return graph.gyro_bias_rad_s, graph_rad_s
    return state.gyro_bias_rad_s, sigma_rad_s
