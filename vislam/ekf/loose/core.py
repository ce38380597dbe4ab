"""The core of the loose filter: linearise a measurement, gate, correct; and what to do if the gate keeps saying no."""

import math
from dataclasses import replace

import numpy as np

from vislam.config import USUAL_SLIP_M_S, EkfConfig, MachineConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import invert, quaternion_wxyz, skew
from vislam.core.messages import Array, NavState, NoiseScale, VoMeasurement
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.filter_core import (
    RESET_REJECTS,
    RESET_S,
    REST_PAUSE_NS,
    REST_SIGMA_DEG,
    REST_SIGMA_M,
    ZERO_RATE_SIGMA_RAD_S,
    ZERO_VELOCITY_SIGMA_M_S,
    imu_sigmas,
    nominal,
    reset_sigmas,
    scaled,
)
from vislam.ekf.history import AtRest, Event, Outcome
from vislam.ekf.loose import kernels, visual_motion
from vislam.ekf.loose.measurements import (
    LinearMeasurement,
    NewKeyframe,
    OnWheels,
    absolute_pose,
    biases,
    on_wheels,
    where_rest_began,
    zero_velocity,
)
from vislam.ekf.loose.state import Ledger, LooseState
from vislam.ekf.regain import Watch, grown
from vislam.ekf.sensor_rows import OwnVariables, Sensing, body_of
from vislam.ekf.stretch import Stretch
from vislam.imu import ImuNoise
from vislam.sensors import Suite

# fixed R of accumulated vision; 0.005 to 0.1 err alike, below this motions fail
_ACCUMULATED_SIGMA_M = 0.02
_ACCUMULATED_SIGMA_DEG = 0.5  # the gate, for the sum has drifted by more than R states
LooseMeasurement = VoMeasurement | NewKeyframe | OnWheels
LooseEvent = Event[LooseMeasurement]
_COUNTERS = (
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


def begin(sensing: Sensing, state: LooseState, start: OwnStart, t_ns: int, out: Outcome) -> None:
    """Set a sensor's own variables in a state, in place."""
    out.accept(f"{start.sensor}_begun")
    sensing.begin(start, state.x[kernels.NOMINAL :], state.P)
    _note(state, start.sensor, t_ns)
    state.ledger = replace(state.ledger, watch=state.ledger.watch.begun(start.sensor, t_ns))


def correct_by_reading(sensing: Sensing, state: LooseState, reading: Reading, gyro_rad_s: Array, out: Outcome) -> None:
    """Correct a state in place by a reading, unless its gate refuses it.

    The past moves as well, also where `odom` is continuous: a reading may show where in `odom` the body is, and that is
    no business of the clone.
    """
    name, since_ns = reading.sensor, state.ledger.own_since_ns
    x, P = state.x.copy(), state.P.copy()  # copies: a reading that the gate refuses leaves no walk behind
    own = OwnVariables(x[kernels.NOMINAL :], P[kernels.ERRORS :, kernels.ERRORS :], since_ns)
    sensing.grow(name, reading.t_ns, since_ns, own.values, P)
    rows = sensing.rows(reading, body_of(reading.t_ns, x, gyro_rad_s), own, out)
    if rows is None:
        return
    m = len(rows.residual)
    H = np.zeros((m, len(P)))
    H[:, :15], H[:, kernels.ERRORS :][:, sensing.suite.own(name)] = rows.H, rows.H_own
    S = H @ P @ H.T + np.eye(m)
    everything = np.eye(len(P))
    nis = kernels.update(x, P, H, np.eye(m), rows.residual, sensing.limit(name, m), everything)
    watch = state.ledger.watch
    if not sensing.judge(reading, rows, S, nis, out):
        body = body_of(reading.t_ns, state.x, gyro_rad_s)
        watch, regain = sensing.refuse(watch, reading, rows, body, out)
        if regain is None:
            state.ledger = replace(state.ledger, watch=watch)
            return
        sensing.regained(name, regain, out)
        P = grown(P, regain, np.eye(15), (3, 18), body.R_world_body[2])
        x[0:3] += regain.place_m
        x[3:6] += regain.velocity_m_s
        x[16:19] += regain.place_m  # the clone
    state.x, state.P = x, P
    _note(state, name, reading.t_ns)
    state.ledger = replace(state.ledger, watch=watch.accepted(name, reading.t_ns, rows.H))


def _note(state: LooseState, name: str, t_ns: int) -> None:
    since_ns = {**state.ledger.own_since_ns, name: t_ns}
    state.ledger = replace(state.ledger, own_since_ns=since_ns)


class LooseCore:
    """Moves and corrects a `LooseState`, as `ekf.core.Core` has it."""

    def __init__(
        self, config: EkfConfig, noise: ImuNoise, machine: MachineConfig, T_body_camera: Array | None,
        suite: Suite | None,
    ) -> None:  # fmt: skip
        self.sensing = Sensing(suite, _COUNTERS)
        self.counters = (*_COUNTERS, *self.sensing.counters)
        own = self.sensing.suite.size
        self._config = config
        self._gravity = float(machine.gravity_m_s2)
        self._stated_sigmas = imu_sigmas(noise)
        self._lever = np.zeros(3) if T_body_camera is None else T_body_camera[:3, 3].copy()
        self._white_rate_sigma = float(noise.gyroscope_noise_density * np.sqrt(noise.rate_hz))
        self._limits = np.array([0.0] + [chi_square_limit(config.gate_probability, dof) for dof in range(1, 13)])
        self._axle = np.array(machine.axle_m, dtype=np.float64)
        self._floor_sigma = float(machine.floor_sigma_m or 0.0)
        self._slip_sigma_m_s = float(USUAL_SLIP_M_S if machine.slip_sigma_m_s is None else machine.slip_sigma_m_s)
        self._vo_variance = float(config.vo_inflation) ** 2
        self._fraction = float(config.vo_shared_fraction)
        self._nothing = np.zeros((6, 6))
        self._reset_sigmas = reset_sigmas()
        self._all = np.eye(kernels.ERRORS + own)
        self._only_biases = np.diag(np.repeat([0.0, 1.0, 0.0], [9, 6, 6 + own]))
        self._not_the_past = np.eye(kernels.ERRORS + own)  # the body moves as much as its place against the clone
        self._not_the_past[3:6, 18:21] = -np.eye(3)
        self._not_the_past[18:21] = 0.0

    def blank(self) -> LooseState:
        """Return a state of nothing, before there is one."""
        n = len(self._all)
        x = np.concatenate((np.zeros(kernels.NOMINAL), self.sensing.suite.starts))
        return LooseState(x, np.zeros((n, n)), Ledger(), self._stated_sigmas)

    def begin(self, start: NavState, vo: VoMeasurement | None, noise: NoiseScale) -> LooseState:
        """Return the filter at a state; `vo` places the keyframe it refers to. Raises ValueError, see `Ekf`."""
        state = self.blank()
        state.x[:16] = nominal(start)
        covariance = 0.5 * (start.covariance + start.covariance.T)
        if np.linalg.eigvalsh(covariance)[0] < -1e-6 * np.trace(covariance):
            raise ValueError(f"the filter cannot start from an indefinite covariance (at {start.t_ns} ns)")
        state.P[:15, :15] = covariance
        kernels.clone(state.x, state.P)
        if self._config.vision == "accumulated":
            state.P[15:] = state.P[:, 15:] = 0.0  # no clone, and no sensor has begun: the 16 numbers of the paper
        state.ledger = Ledger(
            last_vo_t_ns=start.t_ns, floor_z_m=float(state.x[2]), noise=noise, watch=Watch(start.t_ns, start.t_ns)
        )
        state.sigmas = scaled(self._stated_sigmas, noise)
        if vo is not None:
            self._place_keyframe(state, vo)
        return state

    def time_of(self, event: LooseEvent, state: LooseState) -> int:
        """Return the event's stamp."""
        return event.t_ns

    def step(self, state: LooseState, before: Array, after: Array, dt_s: float) -> None:
        """Move a state by one step between two samples [6]."""
        kernels.predict(state.x, state.P, before, after, dt_s, 0.0, state.sigmas, self._gravity)

    def run(self, state: LooseState, piece: Stretch, track: Array) -> None:
        """Move a state through a stretch; write x[:10] at each sample into `track` [N, 10]."""
        kernels.predict_run(
            state.x, state.P, piece.t_ns, piece.samples, piece.gaps_s, track, state.sigmas, self._gravity
        )

    def covariance(self, state: LooseState) -> Array:
        """Return [15, 15] with the error of scale that vision cannot see: it stretches the whole way from the origin.

        That is what a considered (Schmidt) parameter without gain adds to P. Its influence need not be propagated:
        positions and velocities are as much too long as vision's metres are, rotations and biases are not touched.
        """
        covariance = state.P[:15, :15].copy()
        if self._config.scale_sigma > 0.0:  # asked at the rate of the IMU
            by_scale = self._config.scale_sigma * state.x[:6]
            covariance[3:9, 3:9] += np.outer(by_scale, by_scale)
        return covariance

    def position_variance_m2(self, state: LooseState) -> float:
        """Return the sum of the three axes of `covariance`, sooner."""
        x, P = state.x, state.P
        far = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
        return float(P[3, 3] + P[4, 4] + P[5, 5] + self._config.scale_sigma**2 * far)

    def apply(self, state: LooseState, event: LooseEvent, gyro_rad_s: Array, ago_s: float) -> Outcome:
        """Correct a state in place by an event, while the gyro [3] showed a rate."""
        out = Outcome()
        what = event.measurement
        if isinstance(what, NoiseScale):
            out.accept("noise_changes")
            state.ledger = replace(state.ledger, noise=what)
            state.sigmas = scaled(self._stated_sigmas, what)
        elif isinstance(what, NewKeyframe):
            out.accept("keyframes")
            state.ledger = self._begin_keyframe(state, what.keyframe_id, event.t_ns)
        elif isinstance(what, VoMeasurement):
            state.ledger = self._apply_vo(state, what, out)
        elif isinstance(what, AtRest):
            state.ledger = self._apply_rest(state, event.t_ns, gyro_rad_s, out)
        elif isinstance(what, OnWheels):
            floor_z_m = state.ledger.floor_z_m
            slip_m_s = self._slip_sigma_m_s
            known = on_wheels(state.x, gyro_rad_s, self._axle, slip_m_s, floor_z_m, self._floor_sigma)
            self._correct(state, known, self._all, "nonholonomic", out)
        elif isinstance(what, Reading):
            correct_by_reading(self.sensing, state, what, gyro_rad_s, out)
        elif isinstance(what, OwnStart):
            begin(self.sensing, state, what, event.t_ns, out)
        else:
            known = biases(state.x, what.values[:3], what.values[3:6], what.values[6:])
            self._correct(state, known, self._only_biases, "bias", out)
        return out

    def _begin_keyframe(self, state: LooseState, keyframe_id: int, t_ns: int) -> Ledger:
        ledger = state.ledger
        if self._config.vision == "relative":
            rests = ledger.rested_t_ns == t_ns
            if rests and ledger.clone_rests:  # it stands where the clone does; a new clone would add its own error
                return replace(ledger, clone_id=keyframe_id, shared=None)
            kernels.clone(state.x, state.P)
            return replace(ledger, clone_id=keyframe_id, shared=np.zeros((6, 6)), clone_rests=rests)
        chained = ledger.T_odom_vo if ledger.vo_t_ns == t_ns else None  # vision was lost there: start over
        T_odom_keyframe = kernels.pose(state.x, 0, 6) if chained is None else chained
        return replace(ledger, clone_id=keyframe_id, T_odom_keyframe=T_odom_keyframe)

    def _place_keyframe(self, state: LooseState, vo: VoMeasurement) -> None:
        """Put the clone where its keyframe is by `vo`, with the uncertainty of the body and of `vo`."""
        assert vo.T_keyframe_body is not None
        T_body = kernels.pose(state.x, 0, 6)
        T_body_keyframe = invert(vo.T_keyframe_body)
        T_keyframe = T_body @ T_body_keyframe
        state.ledger = replace(state.ledger, clone_id=vo.keyframe_id, T_odom_keyframe=T_keyframe)
        if self._config.vision == "accumulated":
            return
        R_body = T_body[:3, :3]
        J = np.eye(6)
        J[:3, :3] = vo.T_keyframe_body[:3, :3]
        J[3:, :3] = -R_body @ skew(T_body_keyframe[:3, 3].copy())
        to_world = np.eye(6)
        to_world[3:, 3:] = R_body
        JM = J @ to_world
        noise = self._config.vo_inflation**2 * (JM @ vo.covariance @ JM.T)
        state.x[16:19] = T_keyframe[:3, 3]
        state.x[19:23] = quaternion_wxyz(T_keyframe[:3, :3].copy())
        P = state.P
        P[15:21, :15] = J @ P[0:6, :15]
        P[:15, 15:21] = P[15:21, :15].T
        P[15:21, 15:21] = J @ P[0:6, 0:6] @ J.T + noise
        kernels.symmetrise(P)

    def _apply_rest(self, state: LooseState, t_ns: int, gyro_rad_s: Array, out: Outcome) -> Ledger:
        """Use that the body is at rest; once a keyframe was taken at rest, the body is where that one is."""
        ledger = state.ledger
        goes_on = ledger.rested_t_ns is not None and t_ns - ledger.rested_t_ns <= REST_PAUSE_NS
        holds = ledger.clone_rests and goes_on
        rate_sigma = max(ZERO_RATE_SIGMA_RAD_S, self._white_rate_sigma * ledger.noise.gyro)
        at_rest = zero_velocity(state.x, gyro_rad_s, float(ZERO_VELOCITY_SIGMA_M_S), rate_sigma)
        if holds:
            sway = math.radians(REST_SIGMA_DEG), float(REST_SIGMA_M)
            at_rest = where_rest_began(state.x, at_rest, *sway)
        self._correct(state, at_rest, self._all, "zero_velocity", out)
        if not out.accepted:
            return replace(ledger, clone_rests=False, rested_t_ns=None)
        return replace(ledger, clone_rests=holds, rested_t_ns=t_ns, watch=ledger.watch.seen(t_ns))

    def _apply_vo(self, state: LooseState, vo: VoMeasurement, out: Outcome) -> Ledger:
        ledger = state.ledger
        if vo.keyframe_id != ledger.clone_id:
            have = "none" if ledger.clone_id is None else f"keyframe {ledger.clone_id}"
            out.count("vo_no_keyframe")
            out.reason = f"relative to keyframe {vo.keyframe_id}, but the filter holds {have}"
            return ledger
        if self._config.vision == "accumulated":
            return self._apply_accumulated(state, vo, out)
        assert vo.T_keyframe_body is not None
        # a clone that several keyframes share has their errors already
        fraction, already = (0.0, self._nothing) if ledger.shared is None else (self._fraction, ledger.shared)
        T, covariance = visual_motion.numbers(vo.T_keyframe_body), visual_motion.numbers(vo.covariance)
        motion = visual_motion.Seen(T, self._vo_variance * covariance, vo.has_scale, self._lever)
        shared = visual_motion.Shared(fraction, already)
        out.nis, degrees, opposed_m, more = visual_motion.correct(
            state.x, state.P, motion, shared, self._limits, self._moves(vo)
        )
        self._judge(degrees, "vo", out, opposed_m)
        return self._after_vo(state, vo.t_ns, None if ledger.shared is None else ledger.shared + more, out)

    def _apply_accumulated(self, state: LooseState, vo: VoMeasurement, out: Outcome) -> Ledger:
        """Chain the motion to the keyframe's pose, and take the sum for a measured pose in `odom`."""
        ledger = state.ledger
        if not vo.has_scale or vo.T_keyframe_body is None or ledger.T_odom_keyframe is None:
            out.count("vo_no_scale")
            out.reason = "accumulated vision needs metric motion; use ekf.vision relative, a second camera or depth"
            return ledger
        T_odom_vo = ledger.T_odom_keyframe @ vo.T_keyframe_body
        sigma_rad = np.deg2rad(_ACCUMULATED_SIGMA_DEG)
        chained = absolute_pose(state.x, T_odom_vo, sigma_rad, _ACCUMULATED_SIGMA_M)
        self._correct(state, chained, self._moves(vo), "vo", out)
        state.ledger = replace(ledger, T_odom_vo=T_odom_vo, vo_t_ns=vo.t_ns)
        return self._after_vo(state, vo.t_ns, ledger.shared, out)

    def _after_vo(self, state: LooseState, t_ns: int, shared: Array | None, out: Outcome) -> Ledger:
        """Count rejections in a row; too many for too long widen the covariance. `shared`: if it was accepted."""
        ledger = state.ledger
        if out.accepted:
            return replace(ledger, rejects=0, last_vo_t_ns=t_ns, shared=shared, watch=ledger.watch.seen(t_ns))
        since = t_ns if ledger.rejects == 0 else ledger.rejects_since_ns
        rejects = ledger.rejects + 1
        if rejects >= RESET_REJECTS and t_ns - since >= RESET_S * 1e9:
            state.P[np.arange(15), np.arange(15)] += self._reset_sigmas**2
            out.count("soft_resets")
            out.reason += f"; {rejects} in a row, covariance inflated"
            rejects = 0
        return replace(ledger, rejects=rejects, rejects_since_ns=since)

    def _moves(self, vo: VoMeasurement) -> Array:
        """Return [n, n] what becomes of the optimal gain: not all that it would move may move (Schmidt-Kalman).

        A continuous odom: tilt that is learned metres away from the origin would swing the body about it. With the gain
        of the clone's position at zero the past stays where it is, and P keeps the uncertainty of it.
        """
        return self._not_the_past if vo.has_scale and self._config.odom == "continuous" else self._all

    def _correct(
        self, state: LooseState, measurement: LinearMeasurement, moves: Array, name: str, out: Outcome
    ) -> None:
        """Gate and apply a measurement; `moves` [n, n]: what becomes of the optimal gain."""
        residual, H, noise = measurement
        out.nis = kernels.update(state.x, state.P, H, noise, residual, self._limits[len(residual)], moves)
        self._judge(len(residual), name, out)

    def _judge(self, degrees: int, name: str, out: Outcome, opposed_m: float = 0.0) -> None:
        """Write down what the gate said."""
        limit = self._limits[degrees]
        if opposed_m > 0.0:
            out.count(f"{name}_opposed")
            out.reason = f"moved {opposed_m:.2f} m against the direction seen"
        elif not out.nis <= limit:
            out.count(f"{name}_gated")
            out.reason = f"innovation {out.nis:.1f} of at most {limit:.1f}"
        else:
            out.accept(f"{name}_accepted")
            out.test(name, 1, out.nis, degrees)
