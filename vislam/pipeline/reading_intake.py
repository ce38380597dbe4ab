"""Readings of further sensors on their way: first to find where their frames are, then to the filter and the graph."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vislam.config import Config
from vislam.core.messages import Array, ImuSpan, KeyframePacket, MagSample, NavState
from vislam.core.readings import MotionReadings, OwnNow, OwnStart, PlacedReading, Reading, Station
from vislam.ekf.filtering import Filtering
from vislam.imu import ImuBuffer, ImuNoise, preintegrate
from vislam.pipeline.blind_start import Said, said_of
from vislam.pipeline.inertial_stages import Inertial
from vislam.pipeline.slip_watch import SlipWatch
from vislam.sensors import USER_ERRORS, BodyState, Sensor, Suite, wrong_jacobians
from vislam.sensors.body import between_keyframes

_MAX_WAITING = 4096  # readings that wait for the filter to begin; older ones go
_MAX_SINCE = 16384  # readings that wait for a keyframe; older ones go
_MAX_TRIED = 1024  # readings that a sensor begins with; of more every other one is kept
_MORE = 1.2  # times the readings of the last attempt, before the next one
_FREE_FORCE_M_S2 = 1.0  # noise assumed of a body's acceleration between keyframes, without an IMU
_PROOFS = 5  # readings of each sensor by which its own Jacobians are compared with its residual
_MIN_PATH_NS = 1_000  # a span of less is no span, and gains no speed that shows


@dataclass(slots=True, eq=False)
class _Beginning:
    """A sensor whose own variables have no values yet."""

    readings: list[Reading] = field(default_factory=list)
    bodies: list[BodyState] = field(default_factory=list)
    tried_at: int = 0  # readings of the last attempt
    newest_t_ns: int = 0


class ReadingIntake:
    """Takes readings as they come, in any order; those that cannot be used are counted and dropped.

    A sensor is a user's code: an exception in its `check` drops the reading, one in its `begin` the sensor.

    Own variables, as the heading of a map of fixes, have to be known roughly before one linear step can be trusted: a
    sensor's first readings are compared with the path until `Sensor.begin` knows them.

    Attributes:
        counters: by sensor, what became of readings before filter and graph had a word: `too_early` are from before
            the filter; `dropped` had to wait for it for too long; with those of `beginning` a sensor looked for its own
            variables; `told` are those that the filter was given. And of these the graph never saw those that are
            `late`, as it had their keyframe already; `unplaced`, where it has no inertial data; `crowded` out, as too
            many waited for a keyframe. Of wheels that slip neither got those that `slipped`, and the graph not those by
            which a `slip_began`.
        notes: by sensor, why its first unusable reading was that, or why the sensor is left out.
    """

    def __init__(
        self, suite: Suite, filtering: Filtering | None, buffer: ImuBuffer | None, gravity_m_s2: float,
        accelerometer_noise_density: float = 0.0, has_window: bool = False,
    ) -> None:  # fmt: skip
        """Set up for the sensors of a machine; without an IMU there is neither a filter nor inertial data.

        `accelerometer_noise_density` (m/s^2/sqrt(Hz)) sets the covariance of the inertial path between two keyframes.
        `has_window`: keyframes go to a sliding window.
        """
        became = ("readings", "unusable", "too_early", "dropped", "beginning", "told", "late", "unplaced", "crowded")
        self.counters = {name: dict.fromkeys(became, 0) for name in suite.names}
        self.notes: dict[str, str] = {}
        self._suite = suite
        self._of_magnetometer = [name for name in suite.names if suite[name].from_magnetometer]
        self._filter, self._buffer = filtering, buffer
        self._gravity = gravity_m_s2 if buffer is not None else 0.0
        self._accel_density, self._has_window = accelerometer_noise_density, has_window
        self._waiting: deque[Reading] = deque()
        self._beginning = {name: _Beginning() for name in suite.names if suite[name].variables}
        self._starts: list[OwnStart] = []  # for the next keyframe
        self._since: deque[Reading] = deque()  # the newest keyframe
        self._slips = {name: SlipWatch() for name in suite.names if suite[name].slips}
        self._left_out: set[str] = set()  # sensors whose code failed
        self._unproven = dict.fromkeys(suite.names, _PROOFS)  # readings that their Jacobians are still tried with
        self._path: deque[tuple[int, Array]] = deque(maxlen=2)  # times and poses of frames, where there is no filter

    @classmethod
    def of_run(cls, config: Config, suite: Suite, noise: ImuNoise | None, inertial: Inertial | None) -> ReadingIntake:
        """Return the intake of a run's further sensors; `noise` and `inertial` are of its IMU, None without one."""
        gravity_m_s2, has_window = config.machine.gravity_m_s2, config.graph.coupling == "tight"
        if noise is None or inertial is None:
            return cls(suite, None, None, gravity_m_s2, 0.0, has_window)
        filtering, buffer = inertial.filtering, inertial.buffer
        return cls(suite, filtering, buffer, gravity_m_s2, noise.accelerometer_noise_density, has_window)

    def report(self) -> dict[str, dict[str, Any]]:
        """Return, by sensor, what the filter found its own variables to be, and what was wrong with its readings."""
        out: dict[str, dict[str, Any]] = {}
        for name in self._suite.names:
            names = [variable.name for variable in self._suite[name].variables]
            entry: dict[str, Any] = {"begun": name not in self._beginning, "variables": names}
            queues = {"queued": self._waiting, "since_keyframe": self._since}
            entry |= {key: sum(one.sensor == name for one in queue) for key, queue in queues.items()}
            if self._filter is not None and self._filter.ekf.initialised and entry["begun"] and names:
                values, sigmas = self._filter.ekf.own(name)
                entry["filter"] = {"values": values.tolist(), "sigmas": sigmas.tolist()}
            if name in self._slips and (slip := self._slips[name].summary()):
                entry["slip"] = slip
            if name in self.notes:
                entry["note"] = self.notes[name]
            elif not self.counters[name]["readings"]:
                entry["note"] = "no reading came"
            out[name] = entry
        return out

    def doubts(self) -> dict[str, str]:
        """Return, of wheels that slip now, a word on it."""
        return {name: word for name, slip in self._slips.items() if (word := slip.status())}

    def add(self, reading: Reading) -> None:
        """Take a reading; the filter hears of it with the next `hand_on`."""
        counts = self.counters.get(reading.sensor)
        if counts is None:
            self.notes.setdefault(reading.sensor, self._suite.why_unusable(reading))
            return
        counts["readings"] += 1
        if reason := self._why_unusable(reading):
            counts["unusable"] += 1
            self.notes.setdefault(reading.sensor, f"{reason} (at {reading.t_ns} ns)")
            return
        self._queue(self._waiting, reading, _MAX_WAITING, "dropped")

    def add_field(self, sample: MagSample) -> None:
        """Take what the machine's own magnetometer measured, for the sensors that it feeds."""
        for name in self._of_magnetometer:
            self.add(Reading(name, sample.t_ns, sample.field_ut))

    def said(self, from_ns: int) -> Said:
        """Return what sensors of motion said last before the filter began, and fixes since `from_ns`."""
        return said_of(self._waiting, self._suite, from_ns)

    def give_up_filter(self) -> None:
        """Go on with the path of vision alone: gravity could not be found."""
        self._filter, self._buffer, self._gravity = None, None, 0.0

    def see(self, t_ns: int, T_odom_body: Array | None) -> None:
        """Take where a frame has the body; without a filter that is all there is to compare readings with."""
        if self._filter is None and T_odom_body is not None:
            self._path.append((t_ns, T_odom_body))
            self.hand_on(t_ns)

    def hand_on(self, newest_t_ns: int) -> None:
        """Give the filter, or those that begin, all readings of up to a time at which the body is known."""
        for _ in range(len(self._waiting)):
            reading = self._waiting.popleft()
            if reading.t_ns > newest_t_ns:
                self._waiting.append(reading)
            elif reading.sensor in self._left_out or self._is_found_wrong(reading):
                self.counters[reading.sensor]["unusable"] += 1
            elif reading.sensor in self._beginning:
                self._compare(reading)
            elif self._give_to_filter(reading):
                self._queue(self._since, reading, _MAX_SINCE, "crowded")

    def pack(self, packet: KeyframePacket, before_t_ns: int, state: NavState | None) -> KeyframePacket:
        """Return a keyframe's packet with the readings since the one before, at `before_t_ns`.

        `state` is the filter's at the keyframe; None without one, or where it has none.
        """
        t_ns = packet.keyframe.t_ns
        placed, later = [], deque[Reading]()
        path = None
        if self._since:
            path = _path_between(before_t_ns, t_ns, self._buffer, state, self._gravity, self._accel_density)
        for reading in self._since:
            if reading.t_ns > t_ns:
                later.append(reading)
            elif reading.t_ns <= before_t_ns:
                self.counters[reading.sensor]["late"] += 1
            elif path is not None and (station := path(reading.t_ns)) is not None:
                placed.append(PlacedReading(reading, station))
            else:
                self.counters[reading.sensor]["unplaced"] += 1
        self._since = later
        starts, self._starts = tuple(self._starts), []
        packet = replace(packet, readings=tuple(placed), own_starts=starts)
        if not self._has_window or self._filter is None:
            return packet
        begun = [name for name in self._suite.names if name not in self._beginning]
        return _with_motions(packet, self._suite, begun, state, self._filter.ekf.own)

    def _give_to_filter(self, reading: Reading) -> bool:
        """Give the filter a reading unless its wheels slip; return whether the graph shall have it as well."""
        if self._filter is None:
            return True
        slip, counts = self._slips.get(reading.sensor), self.counters[reading.sensor]
        if slip is not None and slip.slips:
            slip.judge(reading.t_ns, self._filter.ekf.agrees(reading))
            counts["slipped"] = counts.get("slipped", 0) + 1
            return False
        answer = self._filter.add_reading(reading)
        counts["told"] += 1
        if slip is None or not np.isfinite(answer.nis):
            return True
        slip.judge(reading.t_ns, answer.accepted)
        if slip.slips:
            self._take_back(reading.sensor, slip.begin_ns)
        return not slip.slips

    def _take_back(self, name: str, from_ns: int) -> None:
        """Keep from the graph the readings by which a slip began, this one among them."""
        counts, kept = self.counters[name], deque[Reading]()
        for reading in self._since:
            if reading.sensor != name or reading.t_ns < from_ns:
                kept.append(reading)
        counts["slip_began"] = counts.get("slip_began", 0) + len(self._since) - len(kept) + 1
        self._since = kept

    def _why_unusable(self, reading: Reading) -> str:
        if reading.sensor in self._left_out:
            return "its sensor is left out"
        try:
            return self._suite.why_unusable(reading)
        except USER_ERRORS as error:
            return f"its check failed: {_reason(error)}"

    def _queue(self, queue: deque[Reading], reading: Reading, most: int, left_as: str) -> None:
        queue.append(reading)
        if len(queue) > most:
            self.counters[queue.popleft().sensor][left_as] += 1

    def _is_found_wrong(self, reading: Reading) -> bool:
        """Whether a sensor's own Jacobians are wrong, as one of its first readings shows; then it is left out."""
        name, body = reading.sensor, self._body_at(reading.t_ns) if self._unproven[reading.sensor] else None
        if body is None:
            return False
        self._unproven[name] -= 1
        try:
            why = wrong_jacobians(self._suite[name], reading, body, self._suite.starts[self._suite.own(name)])
        except USER_ERRORS:  # the estimators count that, reading by reading
            return False
        if why:
            self.notes[name] = f"left out: {why}"
            self._left_out.add(name)
        return bool(why)

    def _compare(self, reading: Reading) -> None:
        """Compare a reading with the path, and begin the sensor once that determines its own variables."""
        beginning = self._beginning[reading.sensor]
        body = self._body_at(reading.t_ns)
        if body is None:
            self.counters[reading.sensor]["too_early"] += 1
            return
        self.counters[reading.sensor]["beginning"] += 1
        if len(beginning.readings) >= _MAX_TRIED:
            del beginning.readings[1::2], beginning.bodies[1::2]
            beginning.tried_at = len(beginning.readings)
        beginning.newest_t_ns = max(beginning.newest_t_ns, reading.t_ns)
        beginning.readings.append(reading)
        beginning.bodies.append(body)
        if len(beginning.readings) < _MORE * beginning.tried_at:
            return
        beginning.tried_at = len(beginning.readings)
        start = self._begun(reading.sensor, beginning)
        if start is None:
            return
        del self._beginning[reading.sensor]
        if self._filter is not None:
            # a start holds for what has its stamp, and the newest of its readings would be used twice
            self._filter.begin_sensor(beginning.newest_t_ns + 1, start)
        self._starts.append(start)

    def _begun(self, name: str, beginning: _Beginning) -> OwnStart | None:
        """Return first values of a sensor's own variables; None: too early, or the sensor is left out from here on."""
        try:
            return _first_values(name, self._suite[name], beginning)
        except USER_ERRORS as error:
            self.notes[name] = f"left out, it cannot begin: {_reason(error)}"
            self._left_out.add(name)
            beginning.readings.clear()
            beginning.bodies.clear()
            return None

    def _body_at(self, t_ns: int) -> BodyState | None:
        if self._filter is not None:
            return self._filter.ekf.body_at(t_ns)
        if len(self._path) < 2 or not self._path[0][0] <= t_ns <= self._path[1][0]:
            return None
        (t0_ns, T0), (t1_ns, T1) = self._path
        station = _freely((t_ns - t0_ns) * 1e-9, (t1_ns - t0_ns) * 1e-9)
        return between_keyframes(T0, T1, t_ns, station)


class _InertialPath:
    """Inertial data between two keyframes, of which the whole is integrated once for all readings."""

    def __init__(
        self, buffer: ImuBuffer, whole: ImuSpan, state: NavState, gravity_m_s2: float, force_sigma_m_s2: float
    ) -> None:
        self._buffer, self._samples, self._gravity, self._sigma = buffer, whole, gravity_m_s2, force_sigma_m_s2
        self._biases = state.gyro_bias_rad_s, state.accel_bias_m_s2
        self._whole = preintegrate(whole, *self._biases)

    def station(self, t_ns: int) -> Station | None:
        """Return the station of a time; None where the samples held do not reach it."""
        t0_ns, whole, (gyro_bias, accel_bias) = int(self._samples.t_ns[0]), self._whole, self._biases
        dR, dv, dp, rate = np.eye(3), np.zeros(3), np.zeros(3), self._samples.gyro_rad_s[0]
        if t_ns - t0_ns > _MIN_PATH_NS:
            part = self._buffer.span(t0_ns, t_ns)
            if part is None:
                return None
            here = preintegrate(part, gyro_bias, accel_bias)
            dR, dv, dp, rate = here.dR, here.dv_m_s, here.dp_m, part.gyro_rad_s[-1]
        since_s, length_s = (t_ns - t0_ns) * 1e-9, (int(self._samples.t_ns[-1]) - t0_ns) * 1e-9
        return Station(
            since_s, length_s, dR, dv, dp, whole.dR, whole.dp_m, self._gravity, rate - gyro_bias, gyro_bias, accel_bias,
            self._sigma,
        )  # fmt: skip


def _path_between(
    t0_ns: int, t1_ns: int, buffer: ImuBuffer | None, state: NavState | None, gravity_m_s2: float, accel_density: float
) -> Callable[[int], Station | None] | None:
    """Return what gives the station of a time between two keyframes; None where inertial data do not cover them."""
    length_s = (t1_ns - t0_ns) * 1e-9
    if buffer is None:
        return lambda t_ns: _freely((t_ns - t0_ns) * 1e-9, length_s)
    whole = None if state is None else buffer.span(t0_ns, t1_ns)
    if state is None or whole is None:
        return None
    white = accel_density * whole.noise.accel
    force_variance = float(np.diag(state.covariance)[12:15].max()) + white**2 / length_s
    return _InertialPath(buffer, whole, state, gravity_m_s2, float(np.sqrt(force_variance))).station


def _first_values(name: str, sensor: Sensor, beginning: _Beginning) -> OwnStart | None:
    """Return what a sensor begins with; None: too early. Raises ValueError where that cannot be used."""
    begun = sensor.begin(beginning.readings, beginning.bodies)
    if begun is None:
        return None
    start = OwnStart(name, np.asarray(begun.values, float), np.asarray(begun.sigmas, float))
    wanted = (len(sensor.variables),)
    if start.values.shape != wanted or start.sigmas.shape != wanted:
        raise ValueError(f"{start.values.shape} values and {start.sigmas.shape} sigmas, {wanted} asked")
    if not (np.isfinite(start.values).all() and np.isfinite(start.sigmas).all() and (start.sigmas >= 0).all()):
        raise ValueError("values that are not finite, or sigmas that are not finite and at least 0")
    return start


def _with_motions(
    packet: KeyframePacket,
    suite: Suite,
    begun: Iterable[str],
    state: NavState | None,
    own: Callable[[str], tuple[Array, Array]],
) -> KeyframePacket:
    """Return a keyframe's packet, its readings of motion set apart where vision does not tie it to the one before.

    By inertial data alone a window is soon lost. With any sensor of motion among those that have `begun`, the filter's
    `state` goes along. `own` gives values and sigmas [V] of a sensor's own variables, as the filter has them.
    """
    if any(suite[name].sees_motion_only for name in begun):
        packet = replace(packet, filter_state=state)
    if packet.begins_submap or packet.vo.tracking.sees:
        return packet
    by_sensor: dict[str, list[PlacedReading]] = {}
    rest: list[PlacedReading] = []
    for one in packet.readings:
        name = one.reading.sensor
        (by_sensor.setdefault(name, []) if suite[name].sees_motion_only else rest).append(one)
    motions = (MotionReadings(name, tuple(placed), OwnNow(*own(name))) for name, placed in by_sensor.items())
    return replace(packet, readings=tuple(rest), motions=tuple(motions))


def _reason(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _freely(since_s: float, length_s: float) -> Station:
    """Return a station of a body of which only both ends are known."""
    none = np.zeros(3)
    return Station(
        since_s, length_s, np.eye(3), none, none, np.eye(3), none, 0.0, none, none, none, _FREE_FORCE_M_S2
    )  # fmt: skip
