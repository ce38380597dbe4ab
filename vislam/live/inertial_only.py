"""What a cart knows without its camera: the zero of power-up, attitude from there on, a watch on the magnetic field."""

from collections import deque
from dataclasses import asdict
from typing import Any

import numpy as np

from vislam.config import Config
from vislam.core.geometry import transform
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.imu import AttitudeFilter, BiasMemory, ImuBuffer, ImuNoise, PowerUp, Refusal, power_up

_NS = 1_000_000_000
_SETTLE_NS = 100_000_000  # more than the window, so that it is whole
_EARTH_UT = (22.0, 67.0)  # norm of its field, anywhere on the ground


class InertialOnly:
    """Owns the power-up test, the attitude filter that begins with it, and a watch on the magnetic field.

    The attitude is the baseline without vision; it ends when vision has a state, which knows all of it better.

    Attributes:
        zero: what standing still has shown; None until then.
        refusal: why there is no zero, when last tried.
    """

    def __init__(self, config: Config, noise: ImuNoise, memory: BiasMemory) -> None:
        """Begin without a zero; `memory` is what earlier power-ups found."""
        self._config = config
        self._noise = noise
        self._memory = memory
        self.zero: PowerUp | None = None
        self.refusal = "not tried yet"
        self._attitude: AttitudeFilter | None = None
        self._bias_sigma_rad_s = np.full(3, np.inf)
        self._field: MagSample | None = None
        self._field_waits = False  # the attitude has not had the newest field yet
        self._good_until_ns = 0  # the newest field was as long as it should be, and is not old before then
        self._is_over = False  # vision has a state
        self._fields: deque[MagSample] = deque()  # of the power-up window
        self._field_ut: float | None = None  # norm at power-up; None: there was none of the earth's

    @property
    def bias_per_c(self) -> Array:
        """The change [3] of the gyro's bias per deg C that is remembered, rad/s."""
        return self._memory.per_c()

    @property
    def has_attitude(self) -> bool:
        """Whether there is one."""
        return self._attitude is not None

    def look(self, buffer: ImuBuffer, temperature_c: float | None) -> PowerUp | None:
        """Return the zero if the newest samples are the first that give one; else `refusal` is the reason why not."""
        newest_ns = buffer.newest_t_ns
        if self.zero is not None or newest_ns is None or buffer.oldest_t_ns is None:
            return None
        begin_ns = newest_ns - round(self._config.power_up.window_s * _NS) - _SETTLE_NS
        span = buffer.span(max(begin_ns, buffer.oldest_t_ns), newest_ns)
        if span is None:
            return None
        found = power_up(span, self._config.power_up, self._config.machine.gravity_m_s2, temperature_c, self._memory)
        if isinstance(found, Refusal):
            self.refusal = found.reason
            return None
        self.zero, self.refusal = found, ""
        if not self._is_over:
            self._attitude = AttitudeFilter(
                self._config.attitude, self._config.machine.gravity_m_s2, found.R_level_body, found.gyro_bias_rad_s
            )
        self._bias_sigma_rad_s = found.gyro_bias_sigma_rad_s
        norms = [float(np.linalg.norm(field.field_ut)) for field in self._fields if field.t_ns >= int(span.t_ns[0])]
        if norms and _EARTH_UT[0] <= np.mean(norms) <= _EARTH_UT[1]:
            self._field_ut = float(np.mean(norms))
        self._fields.clear()
        return found

    def add(self, sample: ImuSample) -> None:
        """Carry the attitude on."""
        if self._attitude is not None:
            fresh, self._field_waits = self._field_waits, False
            self._attitude.add(sample, self._field if fresh and self.is_field_good(sample.t_ns) else None)

    def add_field(self, field: MagSample) -> None:
        """Take the magnetometer's newest."""
        self._field, self._field_waits = field, True
        if self.zero is None:
            self._fields.append(field)
            while field.t_ns - self._fields[0].t_ns > self._config.power_up.window_s * _NS + _SETTLE_NS:
                self._fields.popleft()
        self._good_until_ns = 0
        if self._field_ut is not None:
            off_ut = abs(float(np.linalg.norm(field.field_ut)) - self._field_ut)
            if off_ut <= self._config.attitude.mag_gate * self._field_ut:
                self._good_until_ns = field.t_ns + round(self._config.live.event_s * _NS)

    def is_field_good(self, now_ns: int) -> bool:
        """Return whether the field is as long as it was at power-up, within `attitude.mag_gate`, and not old."""
        return now_ns < self._good_until_ns

    def end(self) -> None:
        """Let vision's filter take over; the field is still watched, and a zero still looked for."""
        self._attitude, self._is_over = None, True

    def base(self, gyro_rad_s: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return pose, velocity, rate and their covariances as `of_base` does, with infinity for what is not known.

        That is the position, the velocity and, as nothing holds it, the heading.
        """
        assert self._attitude is not None
        tilt = self._attitude.tilt_sigma_rad**2
        unknown = [np.inf] * 3
        rate_variance = self._bias_sigma_rad_s**2 + self._noise.gyroscope_noise_density**2 * self._noise.rate_hz
        return (
            transform(self._attitude.R_world_body, np.zeros(3)), np.zeros(3),
            gyro_rad_s - self._attitude.gyro_bias_rad_s, np.diag([*unknown, tilt, tilt, np.inf]),
            np.diag([*unknown, *rate_variance]),
        )  # fmt: skip

    def report(self) -> dict[str, Any]:
        """Return the zero, or why there is none, for people and the next power-up, as JSON has it."""
        if self.zero is None:
            return {"refused": self.refusal}
        facts = asdict(self.zero)
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in facts.items()}
