"""The first gravity-aligned state: from rest, or in motion by aligning visual odometry with inertial data.

Fed with one entry per frame, it answers "waiting" and why until it is sure; a wrong start costs a whole run, a late one
a second.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from vislam.config import InitConfig
from vislam.geometry import invert, level_rotation, se3_adjoint, skew, transform
from vislam.imu import ImuNoise, RestDetector, join
from vislam.inertial_alignment import Alignment, LinearSolution, VisualMotion, Window, refine, solve_linear
from vislam.messages import Array, ImuSpan, NavState, Tracking, VoMeasurement

_NS = 1_000_000_000
_CHOSEN = 1e-3  # sigma, rad and m, of heading and position where odom is defined to be zero
_REST_SIGMA_M_S = 0.02  # a body at rest still sways
_CORRELATED_S = 0.05  # vibration at rest averages out over samples this far apart
_AGREE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Initialisation:
    """An answer: "waiting", "failed" (the window contradicts physics; still trying), or a state "static" or "moving".

    `T_odom_vo` takes poses chained from visual odometry (identity at the first frame fed) to `odom`: gravity-aligned,
    heading and position zero at that frame. Without scale the chain has no lengths; then odom's position is zero at the
    first frame of the window, and only the rotation of `T_odom_vo` means something.
    """

    status: str
    reason: str
    first: NavState | None = None  # at the first frame of the window
    last: NavState | None = None  # at its last
    T_odom_vo: Array | None = None  # [4, 4]
    t_ns: tuple[int, ...] = ()  # of the frames in the window that were solved for
    T_odom_body: Array | None = None  # [N, 4, 4] at these times


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    """A frame in the window."""

    span: ImuSpan | None  # since the entry before; None for the very first
    vo: VoMeasurement
    T_vo_body: Array
    keyframe: int  # number of the frame that is its keyframe
    number: int
    still: bool  # image and IMU


class Initialiser:
    """Owns a window of the last frames. Losing vision or inertial data empties it."""

    def __init__(self, config: InitConfig, noise: ImuNoise, gravity_m_s2: float, T_body_cam0: Array) -> None:
        """Start empty; `T_body_cam0` [4, 4] is only needed for one camera without scale."""
        self._config = config
        self._noise = replace(
            noise,
            gyro_noise_density=noise.gyro_noise_density * config.imu_inflation,
            accel_noise_density=noise.accel_noise_density * config.imu_inflation,
        )
        self._gravity = float(gravity_m_s2)
        self._lever = T_body_cam0[:3, 3].copy()
        self._rest = RestDetector(config, noise)
        self._entries: list[_Entry] = []
        self._count = 0
        self._T_vo_keyframe = np.eye(4)
        self._keyframe_id: int | None = None
        self._keyframe_number = 0
        self._T_vo_body = np.eye(4)
        self._next_attempt_ns = 0
        self._last = Initialisation("waiting", "no frame yet")

    def add(self, span: ImuSpan | None, vo: VoMeasurement, at_rest_by_image: bool) -> Initialisation:
        """Take one frame and answer.

        Args:
            span: inertial data since the frame before, no bias taken off; None for the first frame or across a hole.
            vo: visual motion at the frame.
            at_rest_by_image: the image hardly moved since the frame before (below `config.still_px`).
        """
        still_by_imu = self._rest.add(span)
        follows = span is not None and bool(self._entries) and int(span.t_ns[0]) == self._entries[-1].vo.t_ns
        if vo.tracking is Tracking.LOST or vo.T_keyframe_body is None:
            return self._restart("vision is lost")
        if self._entries and not follows:
            self._restart("inertial data has a hole")
        self._append(span if follows else None, vo, vo.T_keyframe_body, at_rest_by_image and follows)
        self._trim(vo.t_ns)
        if still_by_imu and at_rest_by_image:
            found = self._from_rest()
        elif vo.t_ns >= self._next_attempt_ns:
            found = self._from_motion()
            self._next_attempt_ns = vo.t_ns + round(self._config.attempt_s * _NS)
        else:
            return self._last
        self._last = found if found.first is None else Initialisation("waiting", "already found")
        return found

    def _restart(self, reason: str) -> Initialisation:
        self._entries = []
        self._rest.clear()
        self._next_attempt_ns = 0
        self._last = Initialisation("waiting", reason)
        return self._last

    def _append(self, span: ImuSpan | None, vo: VoMeasurement, T_keyframe_body: Array, still: bool) -> None:
        """Chain the motion to a pose in the visual frame. After a loss the chain goes on from the last good pose."""
        number = self._count
        if vo.keyframe_id != self._keyframe_id:  # the frame before became the keyframe
            self._T_vo_keyframe = self._T_vo_body
            self._keyframe_number = number if self._keyframe_id is None else number - 1  # the first is its own
            self._keyframe_id = vo.keyframe_id
        self._T_vo_body = self._T_vo_keyframe @ T_keyframe_body
        self._entries.append(_Entry(span, vo, self._T_vo_body.copy(), self._keyframe_number, number, still))
        self._count += 1

    def _trim(self, now_ns: int) -> None:
        """Drop what is older than the window; without scale it has to begin at a keyframe, which can be older."""
        metric = self._entries[-1].vo.has_scale
        oldest_ns = now_ns - round((self._config.window_s if metric else self._config.mono_window_s) * _NS)
        keep = 0
        for i, entry in enumerate(self._entries):
            if entry.vo.t_ns > oldest_ns:
                break
            if metric or self._is_keyframe(i):
                keep = i
        del self._entries[:keep]

    def _is_keyframe(self, i: int) -> bool:
        number = self._entries[i].number
        return i + 1 < len(self._entries) and self._entries[i + 1].keyframe == number

    def _waiting(self, reason: str) -> Initialisation:
        return Initialisation("waiting", reason)

    def _from_rest(self) -> Initialisation:
        """Gravity and gyro bias from the means over the frames at rest."""
        start = len(self._entries) - 1
        while start > 0 and self._entries[start].still:
            start -= 1
        entries = self._entries[start:]
        spans = [entry.span for entry in entries[1:] if entry.span is not None]
        rested_s = (entries[-1].vo.t_ns - entries[0].vo.t_ns) / _NS
        if not spans or rested_s < self._config.rest_s:
            return self._waiting(f"at rest for {rested_s:.2f} s of {self._config.rest_s:.2f} s")
        span = join(spans)
        gyro, force = span.gyro_rad_s.mean(axis=0), span.accel_m_s2.mean(axis=0)
        excess = float(np.linalg.norm(force)) - self._gravity
        if abs(excess) > self._config.gravity_tolerance_m_s2:
            return Initialisation("failed", self._contradiction(excess + self._gravity))
        up_vo = entries[-1].T_vo_body[:3, :3] @ force
        T_odom_vo = transform(level_rotation(up_vo), np.zeros(3))
        poses = np.array([T_odom_vo @ entry.T_vo_body for entry in entries])
        covariance = self._rest_covariance(span, poses[-1][:3, :3])
        up_body = force / np.linalg.norm(force)
        prior, measured = self._config.accel_bias_sigma_m_s2**2, self._rest_variance(span.accel_m_s2, rested_s)
        accel_bias = up_body * (excess * prior / (prior + measured))
        first, last = (
            NavState(entry.vo.t_ns, pose, np.zeros(3), gyro, accel_bias, covariance)
            for entry, pose in ((entries[0], poses[0]), (entries[-1], poses[-1]))
        )
        times = tuple(entry.vo.t_ns for entry in entries)
        return Initialisation("static", f"at rest for {rested_s:.2f} s", first, last, T_odom_vo, times, poses)

    def _rest_variance(self, values: Array, rested_s: float) -> float:
        """Return the variance of the mean of one axis, given that vibration is correlated for a while."""
        return float(values.var(axis=0).max()) / max(rested_s / _CORRELATED_S, 1.0)

    def _rest_covariance(self, span: ImuSpan, R: Array) -> Array:
        """Return the covariance [15, 15] of a state at rest: tilt and accelerometer bias cannot be told apart."""
        rested_s = (int(span.t_ns[-1]) - int(span.t_ns[0])) / _NS
        sigma_gyro = np.sqrt(self._rest_variance(span.gyro_rad_s, rested_s)) + self._noise.gyro_noise_density
        sigma_force = np.sqrt(self._rest_variance(span.accel_m_s2, rested_s)) + self._noise.accel_noise_density
        information = np.zeros((6, 6))  # rotation, accel bias
        heading = R[2]  # rotation about the vertical, on the body side
        information[:3, :3] = np.outer(heading, heading) / _CHOSEN**2 + np.eye(3)  # and tilt within 1 rad
        information[3:, 3:] = np.eye(3) / self._config.accel_bias_sigma_m_s2**2
        J = np.hstack([skew(R.T @ np.array([0.0, 0.0, self._gravity])), np.eye(3)])
        information += J.T @ J / sigma_force**2
        both = np.linalg.inv(information)
        covariance = np.diag(np.repeat([0.0, _CHOSEN**2, _REST_SIGMA_M_S**2, sigma_gyro**2, 0.0], 3))
        covariance[:3, :3], covariance[:3, 12:] = both[:3, :3], both[:3, 3:]
        covariance[12:, :3], covariance[12:, 12:] = both[3:, :3], both[3:, 3:]
        return covariance

    def _from_motion(self) -> Initialisation:
        """Gravity, velocity, biases and scale from the window, if it says enough about them."""
        config, entries = self._config, self._entries
        metric = entries[-1].vo.has_scale
        seen_s = (entries[-1].vo.t_ns - entries[0].vo.t_ns) / _NS
        need_s = config.window_min_s if metric else config.mono_window_min_s
        if seen_s < need_s:
            return self._waiting(f"{seen_s:.2f} s of motion seen, {need_s:.2f} s needed")
        chosen = self._choose_nodes()
        window = self._window(chosen)
        if not metric:
            directions = sum(motion.has_direction for motion in window.motions)
            if directions < config.min_directions:
                return self._waiting(f"parallax in {directions} of {config.min_directions} motions needed")
        try:
            linear = solve_linear(window)
            refusal = self._gravity_refusal(linear)
            if refusal is not None:
                return refusal
            aligned = refine(window, linear)
        except np.linalg.LinAlgError:
            return self._waiting("the motion does not determine gravity and velocity yet; accelerate or turn")
        refusal = self._quality_refusal(aligned, metric)
        return refusal if refusal is not None else self._moving(chosen, aligned, metric)

    def _choose_nodes(self) -> list[_Entry]:
        """Return the entries that become unknowns: keyframes, the ends, and others at a spacing."""
        entries, config = self._entries, self._config
        seen_ns = entries[-1].vo.t_ns - entries[0].vo.t_ns
        spacing_ns = max(round(config.node_spacing_s * _NS), seen_ns // config.max_nodes)
        chosen, last_ns = [], -(1 << 62)
        for i, entry in enumerate(entries):
            at_end = i == len(entries) - 1
            if at_end or self._is_keyframe(i) or entry.vo.t_ns - last_ns >= spacing_ns - spacing_ns // 16:
                chosen.append(entry)
                last_ns = entry.vo.t_ns
        return chosen

    def _window(self, chosen: list[_Entry]) -> Window:
        first = self._entries[0].number
        spans = []
        for a, b in pairwise(chosen):
            between = self._entries[a.number - first + 1 : b.number - first + 1]
            spans.append(join([entry.span for entry in between if entry.span is not None]))
        return Window(
            spans=spans,
            motions=self._motions(chosen),
            rotations=np.array([entry.T_vo_body[:3, :3] for entry in chosen]),
            noise=self._noise,
            gravity_m_s2=self._gravity,
            lever_m=self._lever,
            gyro_bias_sigma_rad_s=self._config.gyro_bias_sigma_rad_s,
            accel_bias_sigma_m_s2=self._config.accel_bias_sigma_m_s2,
        )

    def _motions(self, chosen: list[_Entry]) -> list[VisualMotion]:
        """Return the visual motions among the nodes; if a keyframe is older than the window, from its first frame."""
        inflation = self._config.vo_inflation**2
        place = {entry.number: i for i, entry in enumerate(chosen)}
        start = chosen[0]
        motions = []
        for i, entry in enumerate(chosen[1:], start=1):
            T, covariance = entry.vo.T_keyframe_body, entry.vo.covariance
            assert T is not None and start.vo.T_keyframe_body is not None
            a = place.get(entry.keyframe)
            if a is None and entry.vo.has_scale and entry.keyframe == start.keyframe:
                a = 0
                T = invert(start.vo.T_keyframe_body) @ T
                turned = se3_adjoint(invert(T))
                covariance = covariance + turned @ start.vo.covariance @ turned.T
            if a is not None and a != i:
                motions.append(VisualMotion(a, i, T, inflation * covariance, entry.vo.has_scale))
        return motions

    def _contradiction(self, norm: float) -> str:
        return (
            f"gravity norm {norm:.2f} m/s2, expected {self._gravity:.2f}: check the accelerometer's unit and "
            "calibration and the camera-IMU extrinsics"
        )

    def _gravity_refusal(self, linear: LinearSolution) -> Initialisation | None:
        norm, sigma = float(np.linalg.norm(linear.gravity_m_s2)), linear.gravity_norm_sigma_m_s2
        allowed = self._config.gravity_tolerance_m_s2
        if sigma > 2.0 * allowed:
            return self._waiting(f"gravity norm {norm:.1f} +- {sigma:.1f} m/s2: too little acceleration or turning")
        if abs(norm - self._gravity) > allowed + _AGREE_SIGMAS * sigma:
            return Initialisation("failed", self._contradiction(norm))
        return None

    def _quality_refusal(self, aligned: Alignment, metric: bool) -> Initialisation | None:
        config = self._config
        if aligned.residual_ratio > config.max_residual_ratio:
            reason = f"vision and IMU disagree: chi2 {aligned.residual_ratio:.1f} of {config.max_residual_ratio:.1f}"
            return Initialisation("failed", f"{reason} per degree of freedom; check time stamps and extrinsics")
        P = aligned.state_covariance(-1 + len(aligned.T_world_body))
        R = aligned.T_world_body[-1, :3, :3]
        tilt = np.rad2deg(np.sqrt(np.linalg.eigvalsh((R @ P[:3, :3] @ R.T)[:2, :2])[-1]))
        velocity = np.sqrt(np.linalg.eigvalsh(P[6:9, 6:9])[-1])
        gyro = np.sqrt(np.linalg.eigvalsh(P[9:12, 9:12])[-1])
        for name, value, limit, unit in (
            ("scale", 0.0 if metric else aligned.scale_sigma() * 100.0, config.max_scale_sigma * 100.0, "%"),
            ("tilt", tilt, config.max_tilt_sigma_deg, "deg"),
            ("velocity", velocity, config.max_velocity_sigma_m_s, "m/s"),
            ("gyro bias", gyro, config.max_gyro_bias_sigma_rad_s, "rad/s"),
        ):
            if not value <= limit:
                return self._waiting(f"{name} known to {value:.3g} {unit}, {limit:.3g} needed; accelerate or turn")
        return None

    def _moving(self, chosen: list[_Entry], aligned: Alignment, metric: bool) -> Initialisation:
        """Express the solution in odom."""
        up_vo = chosen[0].T_vo_body[:3, :3] @ aligned.T_world_body[0, 2, :3]
        T_odom_vo = transform(level_rotation(up_vo), np.zeros(3))
        origin = T_odom_vo @ chosen[0].T_vo_body
        turn = np.eye(4)
        turn[:3, :3] = origin[:3, :3] @ aligned.T_world_body[0, :3, :3].T
        turn[:3, 3] = origin[:3, 3] if metric else 0.0
        poses = turn @ aligned.T_world_body
        inflation = max(aligned.residual_ratio, 1.0)  # what the model does not explain makes the answer less certain
        first, last = (
            NavState(
                t_ns=chosen[i].vo.t_ns,
                T_world_body=poses[i],
                velocity_world_m_s=turn[:3, :3] @ aligned.velocities_m_s[i],
                gyro_bias_rad_s=aligned.gyro_bias_rad_s,
                accel_bias_m_s2=aligned.accel_bias_m_s2,
                covariance=_turn(aligned.state_covariance(i), turn[:3, :3]) * inflation,
            )
            for i in (0, len(chosen) - 1)
        )
        reason = f"{len(chosen)} frames over {(last.t_ns - first.t_ns) / _NS:.2f} s, chi2 {aligned.residual_ratio:.2f}"
        times = tuple(entry.vo.t_ns for entry in chosen)
        return Initialisation("moving", reason, first, last, T_odom_vo, times, poses)


def _turn(covariance: Array, R: Array) -> Array:
    """Return the covariance with position and velocity in turned world axes; the chosen origin gets its sigma back."""
    J = np.eye(15)
    J[3:6, 3:6] = J[6:9, 6:9] = R
    out = J @ covariance @ J.T
    out[:6, :6] += np.eye(6) * 1e-8
    return out
