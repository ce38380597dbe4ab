"""The fast path: inertial samples through the filter to the published pose, whatever vision and graph are doing.

The filter here is a twin of the one beside vision. It gets the same samples, the same corrections and the same hints,
and as the answer of a filter depends on the set of measurements only, not on when they came, both agree at all times:
`odom` is one frame in all processes, and no state has to be sent around.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from vislam.config import Config
from vislam.core.geometry import invert, transform
from vislam.core.messages import Array, ImuSample, MagSample, NavState
from vislam.ekf.correction import AppliedReading, Correction, Hint
from vislam.ekf.loose.filter import Ekf
from vislam.hw.health import Health
from vislam.imu import BiasMemory, ImuBuffer, ImuNoise, PowerUp, RestDetector, is_slow
from vislam.live.inertial_only import InertialOnly
from vislam.live.notices import CameraHealth, Doubted, GaveUp, MapMoved, Rebase, Start, ToFast
from vislam.live.wire.published_pose import PublishedPose, of_base
from vislam.sensors import Suite
from vislam.trajectory.continuity import Continuity, in_odom

_IMU_TIMEOUT_S = 0.1  # without a sample for so long the pose is old: invalid
_NS = 1_000_000_000
_REST_STEP_NS = 100_000_000  # rest is asked for so often
_LOOK_NS = 50_000_000  # and the sensors for their health
_UNKNOWN = np.full((6, 6), np.inf)

BaseState = tuple[Array, Array, Array, Array, Array]  # pose, velocity, rate, covariances of both, see `of_base`


class FastPath:
    """Owns the filter that is published. One thread; no clock: the caller passes the time. `alone`: without vision."""

    def __init__(
        self, config: Config, noise: ImuNoise, T_body_camera: Array, publish: Callable[[PublishedPose], None],
        memory: BiasMemory | None = None, is_mag_calibrated: bool = False, suite: Suite | None = None,
    ) -> None:  # fmt: skip
        """Prepare an uninitialised filter.

        Args:
            config: `live`, `ekf`, `init`, `imu`, `power_up` and `attitude` of it are used.
            noise: of the IMU, until the front process sends what the samples show.
            T_body_camera: [4, 4] of the first camera.
            publish: takes each pose.
            memory: gyro biases that earlier power-ups found; None: none.
            is_mag_calibrated: without, its samples say nothing: iron on the cart turns the field as it turns the cart.
            suite: further sensors, of which vision's side hands over the readings; None: none.
        """
        self.counters = {"samples": 0, "rests_without_vision": 0, "wheels_without_vision": 0, "rebases": 0}
        self._config = config
        self._noise = noise
        self._publish = publish
        self._ekf = Ekf(config.ekf, noise, config.machine, T_body_camera, suite)
        self._buffer = ImuBuffer(config.imu, config.machine)
        self._is_mag_calibrated = is_mag_calibrated
        self.alone = InertialOnly(config, noise, BiasMemory(config.power_up.remembered) if memory is None else memory)
        self._rest = RestDetector(config.init, noise)
        self._rest_t_ns: int | None = None  # until when rest was looked for
        self._gyro = np.zeros(3)
        self._offset = np.array(config.live.base_offset_m)
        self._started = 0
        self._resets = 0  # states that took the place of another one, that of the IMU alone included
        self._at_rest = False
        self._is_blind = config.frontend.mode == "none"  # there is no camera: further sensors take its place
        self._sees = False  # the newest frame was tracked
        self._heard_ns = 0  # stamp of the newest reading that corrected the filter
        self._rejects = False  # ... and contradicted the filter
        self._settled_variance = 0.0  # of position, when vision last corrected
        self._map = MapMoved(0, np.eye(4))
        self._in_odom, self._in_map = in_odom(config), Continuity(config.publish)
        self._T_map_odom = np.eye(4)  # that `_in_map` follows
        self._said = dict.fromkeys((CameraHealth, Doubted), Health(0))
        self._events: deque[tuple[int, Health]] = deque()
        self._sequence = 0
        self._newest: PublishedPose | None = None

    @property
    def filter_counters(self) -> dict[str, int]:
        """What came to the filter and what became of it."""
        return self._ekf.counters

    def status(self) -> dict[str, Any]:
        """Return what a person wants to see of the newest pose."""
        pose = self._newest
        if pose is None:
            return {}
        return {
            "health": int(pose.health),
            "samples": self.counters["samples"],
            "position_m": pose.T_odom_base[:3, 3].tolist(),
            "speed_m_s": float(np.linalg.norm(pose.velocity_m_s)),
            "sigma_m": float(np.sqrt(np.trace(pose.pose_covariance[:3, :3]))),
            "map_revision": pose.map_revision,
            "vision_age_s": pose.vision_age_s,
        }

    def add(self, value: ImuSample | MagSample) -> Hint | None:
        """Take a sample; return what the filter of the front process needs besides."""
        if isinstance(value, MagSample):
            if self._is_mag_calibrated:
                self.alone.add_field(value)
            return None
        self.counters["samples"] += 1
        if not self._buffer.add(value):
            return None
        self._ekf.predict(value)
        self._gyro = value.gyro_rad_s
        if not self._started:
            self.alone.add(value)
        return None if self._is_blind else self._look_for_rest(value.t_ns)

    def power_up(self, temperature_c: float | None) -> PowerUp | None:
        """Look whether the cart stands as it has to at power-up; return the result, once.

        With vision already there only while the body rests. Called twice a second: it takes a third of a millisecond.
        """
        return self.alone.look(self._buffer, temperature_c) if not self._started or self._at_rest else None

    @property
    def _uncorrected_s(self) -> float:
        """Seconds since vision, or without a camera a further sensor, corrected the filter."""
        since_heard_ns = (self._buffer.newest_t_ns or 0) - self._heard_ns
        return since_heard_ns / _NS if self._is_blind else self._ekf.dead_reckoning_s

    def correct(self, message: ToFast) -> None:
        """Take what vision, camera or graph say, late as it may be."""
        corrects = self._started and isinstance(message, (Correction, AppliedReading, Rebase))
        before = self._ekf.state() if corrects else None
        self._take(message)
        if before is not None:
            self._show(before.T_world_body, self._ekf.state())

    def _take(self, message: ToFast) -> None:
        if isinstance(message, Correction):
            answer = message.apply(self._ekf)
            is_seen = message.vo.tracking.sees
            self._follow_vision(is_seen, answer.accepted, is_seen and not np.isnan(answer.nis) and not answer.accepted)
            self._at_rest = message.at_rest
        elif isinstance(message, AppliedReading):
            if message.apply(self._ekf).accepted and self._is_blind:
                self._heard_ns = max(self._heard_ns, message.t_ns)
                self._follow_vision(True, True, False)
        elif isinstance(message, Rebase):
            self.counters["rebases"] += 1
            self._ekf.initialise(message.state)
            self._ekf.follow_noise(message.state.t_ns, message.noise)
            self._follow_vision(message.is_tracking, message.is_tracking, False)
            self._at_rest = message.at_rest
        elif isinstance(message, MapMoved):
            if message.revision >= self._map.revision:
                if message.is_in_map and not self._map.is_in_map:
                    self._in_map.clear()  # the place was found: map goes on from nothing
                self._map = message
        elif isinstance(message, CameraHealth | Doubted):
            self._said[type(message)] = message.health
        elif isinstance(message, GaveUp):
            self._started, self._resets = 0, self._resets + 1
        else:
            self._start(message)

    def publish(self, now_ns: int, look: Callable[[], Health]) -> None:
        """Hand out the pose of the newest sample.

        Args:
            now_ns: CLOCK_MONOTONIC.
            look: asks the inertial sensor for its health word; called now and then.
        """
        if not self._events or now_ns - self._events[-1][0] >= _LOOK_NS:
            self._events.append((now_ns, look()))
            while now_ns - self._events[0][0] > self._config.live.event_s * _NS:
                self._events.popleft()
        state = self._ekf.state() if self._started else None
        self._sequence += 1
        self._newest = self._pose(state, now_ns)
        self._publish(self._newest)

    def _pose(self, state: NavState | None, now_ns: int) -> PublishedPose:
        resets, T_map_odom = self._resets + self._ekf.counters["soft_resets"], self._map.T_map_odom
        if state is None:
            base = np.eye(4), np.zeros(3), np.zeros(3), _UNKNOWN, _UNKNOWN
            if self.alone.has_attitude:
                base = self.alone.base(self._gyro)
            newest_ns = self._buffer.newest_t_ns or 0
        else:
            variance = self._noise.gyroscope_noise_density**2 * self._noise.rate_hz
            base, newest_ns = of_base(state, self._gyro, variance, self._offset), state.t_ns
            base, T_map_odom = self._shown_base(base, state)
        T, velocity, rate, pose_covariance, twist_covariance = base
        return PublishedPose(
            newest_ns, now_ns, self._sequence, self._health(state, now_ns, now_ns - newest_ns), T, velocity, rate,
            pose_covariance, twist_covariance, T_map_odom, self._map.revision, resets,
            self._uncorrected_s,
        )  # fmt: skip

    def _show(self, T_before: Array, state: NavState) -> tuple[Array, Array]:
        """Return the body's pose [4, 4] in odom and in map as they are published: without the jumps of corrections."""
        T_map_odom, self._T_map_odom = self._T_map_odom, self._map.T_map_odom
        rate_sigma_rad_s = float(np.sqrt(np.diag(state.covariance)[9:12].max()))
        shown = self._in_odom.follow(state.t_ns, T_before, state.T_world_body, rate_sigma_rad_s)
        after = self._T_map_odom @ state.T_world_body
        return shown, self._in_map.follow(state.t_ns, T_map_odom @ T_before, after, rate_sigma_rad_s)

    def _shown_base(self, base: BaseState, state: NavState) -> tuple[BaseState, Array]:
        """Return the base as it is published, with what it still owes in its covariance, and T_map_odom [4, 4]."""
        _, velocity, rate, pose_covariance, twist_covariance = base
        T_odom_body, T_map_body = self._show(state.T_world_body, state)
        T = transform(T_odom_body[:3, :3], T_odom_body[:3, 3] + T_odom_body[:3, :3] @ self._offset)
        owed = np.concatenate([self._in_odom.owed_m, self._in_odom.owed_rad])
        shown = T, velocity, rate, pose_covariance + np.outer(owed, owed), twist_covariance
        return shown, T_map_body @ invert(T_odom_body)

    def _health(self, state: NavState | None, now_ns: int, age_ns: int) -> Health:
        config = self._config.live
        health = Health(0) if self._map.is_in_map else Health.NOT_IN_MAP
        for event in (*self._said.values(), *(event for _, event in self._events)):
            health |= event
        if age_ns > _IMU_TIMEOUT_S * _NS:
            health |= Health.IMU_MISSING | Health.INVALID
        if self.alone.is_field_good(now_ns):
            health |= Health.MAG_OK
        if state is None:
            knows_up = Health.LEVELLED | Health.DEAD_RECKONING if self.alone.has_attitude else Health(0)
            return health | knows_up | Health.INVALID
        health |= Health.LEVELLED
        sees = (self._sees or self._is_blind) and self._uncorrected_s <= config.vision_timeout_s
        health |= Health.VISION_OK if sees else Health.DEAD_RECKONING
        if self._at_rest:
            health |= Health.AT_REST
        if self._rejects:
            health |= Health.GATE_REJECT
        velocity_variance = np.trace(state.covariance[6:9, 6:9])
        if self._drifted_far or velocity_variance > config.velocity_sigma_m_s**2:
            health |= Health.INVALID
        return health

    @property
    def _drifted_far(self) -> bool:
        """Whether the position lost more certainty than `live.drift_sigma_m` since vision last corrected it."""
        drifted = self._ekf.position_variance_m2 - self._settled_variance
        return drifted > self._config.live.drift_sigma_m**2

    def _start(self, start: Start) -> None:
        """Begin at the first state, and catch up with the newest sample."""
        self._ekf.initialise(start.state, start.vo)
        self._in_odom.clear()
        self._in_map.clear()
        self._resets += self._started > 0 or self.alone.has_attitude
        self._started += 1
        self.alone.end()
        self._follow_vision(True, False, False)
        self._settled_variance = float(np.trace(start.state.covariance[3:6, 3:6]))

    def _follow_vision(self, sees: bool, accepted: bool, rejects: bool) -> None:
        self._sees, self._rejects = sees, rejects
        if accepted and self._ekf.initialised:
            self._resets += self._drifted_far
            self._settled_variance = self._ekf.position_variance_m2

    def _look_for_rest(self, t_ns: int) -> Hint | None:
        """Hold the drift while vision is away: by rest, or by wheels where `machine.slip_sigma_m_s` is set.

        Still inertial data mean rest where the filter itself sees no speed: an IMU alone cannot distinguish rest from
        uniform motion, so rest is not assumed while the filter is unsure of its speed.
        """
        if self._rest_t_ns is None:
            self._rest_t_ns = t_ns
        if t_ns - self._rest_t_ns < _REST_STEP_NS:
            return None
        rests = self._rest.add(self._buffer.span(self._rest_t_ns, t_ns))
        self._rest_t_ns = t_ns
        if not self._started or self._ekf.dead_reckoning_s <= self._config.live.vision_timeout_s:
            return None
        hint = Hint(t_ns, at_rest=rests and is_slow(self._ekf.state()))
        self._at_rest = hint.at_rest
        if not hint.at_rest and self._config.machine.slip_sigma_m_s is None:
            return None
        self._ekf.hold(hint)
        self.counters["rests_without_vision" if hint.at_rest else "wheels_without_vision"] += 1
        return hint
