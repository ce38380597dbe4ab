"""The first state of a body without a camera: from rest, or in motion where a sensor measures its speed.

Even motion is rest to an IMU. Where there are fixes, still samples are rest only once these would have shown a glide.
Fixes too rough to show one in seconds are not waited for.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vislam.config import InitConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import DataError
from vislam.core.messages import ImuSample, ImuSpan, Observations, VoMeasurement
from vislam.core.readings import Reading
from vislam.frontend.start import Initialisation, level_at_once
from vislam.imu import ImuNoise, join, state_at_rest
from vislam.sensors import USER_ERRORS, BodyState, Sensor, Suite

_SPEED_SIGMA_M_S = 30.0  # of what drives, until its sensor of speed is heard
_GLIDE_M_S = 0.5  # a slower one is not distinguished from rest: fixes of a body at rest wander by a decimetre a second
_CERTAIN = 0.99
_PATIENCE_S = 5.0  # of stillness in which fixes may show a glide: who begins at rest may be asked for as much
_NS = 1_000_000_000


class Said(NamedTuple):
    """What further sensors say of the motion before the filter began."""

    moves: bool | None = None  # by sensors of motion; None: no reading
    doubt: str = ""  # why still samples are no rest yet, by fixes; empty: they have no objection
    is_sure: bool = False  # of that: more of them would not change it


def said_of(readings: Iterable[Reading], suite: Suite, from_ns: int) -> Said:
    """Return what sensors of motion said last, or where none did, what the best fixes since a time say."""
    last: dict[str, Reading] = {}
    fixes: dict[str, list[Reading]] = {}
    for one in readings:
        if suite[one.sensor].sees_motion_only:
            last[one.sensor] = one
        elif suite[one.sensor].gives_fixes and one.t_ns >= from_ns:
            fixes.setdefault(one.sensor, []).append(one)
    if last:
        return Said(any(_shows_motion(one, suite) for one in last.values()))
    objections = (_objection(of_one, suite[name]) for name, of_one in fixes.items())
    return Said(None, *min(objections, default=(0.0, "", False))[1:])


def _shows_motion(reading: Reading, suite: Suite) -> bool:
    """Return whether a reading of a sensor of motion is not that of a body at rest."""
    sensor, none = suite[reading.sensor], np.zeros(3)
    own = suite.starts[suite.own(reading.sensor)]
    try:
        off = sensor.residual(reading.values, BodyState(reading.t_ns, np.eye(3), *[none] * 5), own)
        noise = sensor.noise(reading.values) if reading.covariance is None else reading.covariance
        return bool(off @ np.linalg.solve(noise, off) > chi_square_limit(sensor.gate_probability, len(off)))
    except USER_ERRORS:  # it is left out once the filter runs
        return False


def _objection(readings: Sequence[Reading], sensor: Sensor) -> tuple[float, str, bool]:
    """Return how well fixes know the speed (m/s), as the slope of a line, and what `Said` has of it."""
    noise = [sensor.noise(one.values) if one.covariance is None else one.covariance for one in readings]
    weights = 1.0 / np.maximum(np.array([np.diag(covariance) for covariance in noise]), 1e-12)
    t_s = np.array([one.t_ns - readings[0].t_ns for one in readings])[:, None] * 1e-9
    off_s = t_s - (weights * t_s).sum(axis=0) / weights.sum(axis=0)
    information = np.maximum((weights * off_s**2).sum(axis=0), 1e-12)
    slope = (weights * off_s * np.array([one.values for one in readings])).sum(axis=0) / information
    sigma_m_s, speed_m_s = float(1.0 / np.sqrt(information[:2].min())), float(np.linalg.norm(slope))
    if speed_m_s > _GLIDE_M_S and (slope**2 * information).sum() > chi_square_limit(_CERTAIN, len(slope)):
        return sigma_m_s, f"samples are of rest, but fixes move at {speed_m_s:.1f} m/s: stand still to begin", True
    later_m_s = sigma_m_s * min(float(np.ptp(t_s)) / _PATIENCE_S, 1.0) ** 1.5
    if 3.0 * later_m_s < _GLIDE_M_S <= 3.0 * sigma_m_s:
        return sigma_m_s, "fixes do not distinguish rest from a glide yet: stand still longer", False
    return sigma_m_s, "", False


class BlindStart:
    """Owns the newest inertial data and decides, as `Initialiser` does with a camera.

    Attributes:
        refusals: how often a start was refused, by cause.
        taken_back: how many starts were; none is provisional here.
        time_offset_sigma_s: of a camera's clock, which is not there.
    """

    def __init__(self, config: InitConfig, noise: ImuNoise, gravity_m_s2: float, said: Callable[[int], Said]) -> None:
        """Start empty; `said` gives what further sensors say of the time since a stamp."""
        self.refusals: dict[str, int] = {}
        self.taken_back, self.time_offset_sigma_s = 0, 0.0
        self._config, self._noise, self._gravity, self._said = config, noise, gravity_m_s2, said
        self._spans: deque[ImuSpan] = deque()
        self._still_since_ns: int | None = None

    def add(
        self, span: ImuSpan | None, vo: VoMeasurement, still: bool, observations: Observations | None = None
    ) -> Initialisation:
        """Take one frame and answer.

        Args:
            span: inertial data since the frame before; None for the first frame or across a hole.
            vo: of the frame, which shows nothing.
            still: whether inertial data have been those of rest for `config.rest_s`.
            observations: of the frame, which there are none of.
        """
        if span is None:
            self._spans.clear()
            return self._refused("inertial data", "inertial data has a hole, or only begins")
        self._spans.append(span)
        while len(self._spans) > 1 and vo.t_ns - self._spans[1].t_ns[0] >= self._config.rest_s * _NS:
            self._spans.popleft()
        whole = join(list(self._spans))
        length_s = (vo.t_ns - int(whole.t_ns[0])) / _NS
        if length_s < self._config.rest_s:
            reason = f"{length_s:.2f} s of inertial data, {self._config.rest_s:g} s needed"
            return self._refused("duration", reason)
        since_ns = self._still_since_ns or int(whole.t_ns[0])
        self._still_since_ns, said = since_ns if still else None, self._said(since_ns)
        if still and not said.moves:
            is_open = bool(said.doubt) and (said.is_sure or vo.t_ns - since_ns < _PATIENCE_S * _NS)
            return self._refused("fixes", said.doubt) if is_open else self._from_rest(whole, length_s)
        if said.moves is None:
            reason = "the body moves, and no sensor measures its speed: begin at rest, or give wheels or another speed"
            return self._refused("motion", reason)
        return self._in_motion(whole)

    def restamp(self, shift_ns: int, cut: Callable[[int, int], ImuSpan | None]) -> None:
        """Do nothing: there is no camera whose clock could be off."""

    def _from_rest(self, span: ImuSpan, length_s: float) -> Initialisation:
        samples = [ImuSample(*row) for row in zip(span.t_ns.tolist(), span.gyro_rad_s, span.accel_m_s2, strict=True)]
        try:
            state = state_at_rest(samples, self._noise, self._gravity, self._config)
        except DataError:
            return self._refused("gravity", f"the last {length_s:.2f} s are not those of rest: keep the body still")
        reason = f"at rest for {length_s:.2f} s"
        return Initialisation("static", reason, state, state, np.eye(4), (state.t_ns,), state.T_world_body[None])

    def _in_motion(self, span: ImuSpan) -> Initialisation:
        """Level by the mean force; the filter has the speed at once from its sensor."""
        found = level_at_once(span, int(span.t_ns[-1]), np.eye(4), self._gravity, self._config)
        assert found.last is not None
        covariance = found.last.covariance.copy()
        covariance[6:9, 6:9] = np.eye(3) * _SPEED_SIGMA_M_S**2
        state = replace(found.last, covariance=covariance)
        reason = f"in motion, {found.reason}"
        return replace(found, status="moving", reason=reason, first=state, last=state, is_settled=True)

    def _refused(self, cause: str, reason: str) -> Initialisation:
        self.refusals[cause] = self.refusals.get(cause, 0) + 1
        return Initialisation("waiting", reason, cause=cause)
