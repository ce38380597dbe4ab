"""Any object of an `adafruit_*` driver that has `acceleration` and `gyro` as a source of inertial samples."""

import importlib
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

from vislam.config import BoardConfig
from vislam.core.errors import HardwareError, UsageError, install_line
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.hw.timing import Clock, read_in_rounds

MAX_RATE_HZ = 200.0  # each sample costs such a driver two or three transfers and some hundred lines of Python
BNO085 = "adafruit_bno08x.i2c.BNO08X_I2C"
_NS = 1_000_000_000
_TEMPERATURE_S = 0.5  # between looks at the temperature
_BNO_REPORTS = {"acceleration": 0x01, "gyro": 0x02, "magnetic": 0x03}  # calibrated ones, by the BNO08X data sheet


class AdafruitImu(InertialSource):
    """An `InertialSource` with a driver object's `acceleration` (m/s^2), `gyro` (rad/s) and `magnetic` (uT).

    Stamps are the host's, in the middle between asking for the first value and having the second: such drivers give
    no time, and so the stamps jitter as the machine does. Values that are the last ones again are no new sample: chips
    that report by themselves (BNO085) may be asked more often than they report. One thread only.
    """

    stamped_by = "the host, when the driver had read the chip: jitter is the machine's"

    def __init__(
        self,
        device: Any,
        config: BoardConfig | None = None,
        clock: Clock | None = None,
        open_again: Callable[[], Any] | None = None,
    ) -> None:
        """Take the driver's object and read it once.

        Args:
            device: has `acceleration` and `gyro`, and maybe `magnetic` and `temperature`.
            config: rate (200 Hz at most), calibration, times; defaults if None.
            clock: the host's if None.
            open_again: makes a new object after the old one gave nothing for `config.silent_s`.

        Raises:
            UsageError: more than 200 Hz, or an object that has not both.
            HardwareError: it cannot be read.
        """
        self._config = BoardConfig() if config is None else config
        if self._config.rate_hz > MAX_RATE_HZ:
            raise UsageError(f"board.rate_hz must be at most {MAX_RATE_HZ:g} for such a driver; use a chip's own name")
        missing = [name for name in ("acceleration", "gyro") if not hasattr(type(device), name)]
        if missing:
            raise UsageError(f"{type(device).__name__} has no {' and no '.join(missing)}; it is no inertial sensor")
        super().__init__(self._config.calibration, self._config.silent_s, self._config.max_temperature_change_c, clock)
        self._device, self._open_again = device, open_again
        self.rate_hz = self._config.rate_hz
        self._last: tuple[list[float], ...] = ()
        self._last_ns = self._next_mag_ns = self._next_temperature_ns = 0
        self._vain_ns: int | None = None  # since when it is asked and gives nothing new
        self._has_mag = self._config.mag is not False and hasattr(type(device), "magnetic")
        try:
            _triple(device.acceleration)
            _triple(device.gyro)
        except Exception as error:  # a driver may raise anything
            raise HardwareError(
                f"{type(device).__name__} cannot be read: {error}; check power and wires, `vislam doctor` lists buses"
            ) from error
        if self._has_mag and self._config.mag is None:
            self._has_mag = self._read_field() is not None
        self._next_ns = self._last_out_ns = self._retry_ns = self._clock.now_ns()
        self._faults.counts.clear()
        self._faults.taken()

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the next sample, `timeout_s` at most."""
        return read_in_rounds(self._clock, timeout_s, lambda: self._next_ns, self._poll)

    def close(self) -> None:
        """Let the object go; may be called twice."""
        with suppress(Exception):  # most drivers have no such method, and some fail in it
            self._device.deinit()

    def _poll(self) -> list[ImuSample | MagSample]:
        samples: list[ImuSample | MagSample] = []
        asked = self._clock.now_ns()
        try:
            values = rate, force = _triple(self._device.gyro), _triple(self._device.acceleration)
        except Exception as error:  # a driver may raise anything
            self._failed(error)
        else:
            answered = self._clock.now_ns()
            t_ns = (asked + answered) // 2
            if values == self._last or not any(force):  # zeros: a BNO085 before its first report
                self._faults.add("repeated")
            elif t_ns > self._last_ns:
                self._last, self._last_ns, self._vain_ns = values, t_ns, None
                if all([self._gyro.sound([rate])[0], self._accel.sound([force])[0]]):
                    self._last_out_ns = answered
                    samples.append(self._inertial(t_ns, rate, force))
        self._look(asked)
        if self._has_mag and asked >= self._next_mag_ns:
            self._next_mag_ns = asked + round(_NS / self._config.mag_rate_hz)
            begin = self._clock.now_ns()
            field_ut = self._read_field()
            if field_ut is not None and any(field_ut):  # zeros as above
                samples += self._magnetic((begin + self._clock.now_ns()) // 2, field_ut)
        self._replace_silent(asked)
        period_ns = round(_NS / self.rate_hz)
        late = max(self._clock.now_ns() - self._next_ns, 0) // period_ns
        if late > 0:
            self._faults.add("rounds_missed", Health.IMU_GAP, late)
        self._next_ns += (late + 1) * period_ns
        return samples

    def _read_field(self) -> list[float] | None:
        try:
            return _triple(self._device.magnetic)
        except Exception as error:  # also of a report that is not switched on
            self._failed(error)
            self._faults.events |= Health.MAG_FAULT
            return None

    def _look(self, now: int) -> None:
        if now >= self._next_temperature_ns and hasattr(type(self._device), "temperature"):
            self._next_temperature_ns = now + round(_TEMPERATURE_S * _NS)
            with suppress(Exception):
                self._warmed(float(self._device.temperature))

    def _failed(self, error: Exception) -> None:
        name = "bad_values" if isinstance(error, ValueError | TypeError) else "read_failed"
        self._faults.add(name, Health.BUS_FAULT | Health.IMU_GAP)

    def _replace_silent(self, asked: int) -> None:
        """Make a new object where the old one gives nothing, every `config.reopen_s`.

        Only the time in which it was asked counts: a host put aside must not blame the driver.
        """
        if self._last_out_ns >= asked:
            return
        if self._vain_ns is None:
            self._vain_ns = asked
        if self._open_again is None or asked - self._vain_ns <= self._config.silent_s * _NS or asked < self._retry_ns:
            return
        self._retry_ns = asked + round(self._config.reopen_s * _NS)
        try:
            self._device = self._open_again()
        except Exception:  # as above
            self._faults.add("open_failures")
        else:
            self._faults.add("reopened")


def _triple(values: Sequence[float]) -> list[float]:
    """Return three finite numbers; raises ValueError or TypeError for anything else."""
    found = [float(value) for value in values]
    if len(found) != 3 or not all(map(math.isfinite, found)):
        raise ValueError(f"three finite numbers are needed, got {values!r}")
    return found


def open_adafruit(name: str, config: BoardConfig) -> AdafruitImu:
    """Open a driver by `MODULE.CLASS` on the board's own I2C bus, such as `adafruit_lsm6ds.lsm6dsox.LSM6DSOX`.

    Raises:
        UsageError: there is no such class, or it is no inertial sensor.
        HardwareError: the driver or Blinka is not installed, or the chip does not answer.
    """
    make = _maker(name, config)
    try:
        device = make()
    except (HardwareError, UsageError):
        raise
    except Exception as error:  # a driver may raise anything
        raise HardwareError(f"{name} cannot be opened: {error}; check power and wires") from error
    return AdafruitImu(device, config, open_again=make)


def check_driver(name: str) -> None:
    """Raise HardwareError where the driver `MODULE.CLASS` or Blinka is not installed, UsageError for no such name."""
    package = _module_of(name).partition(".")[0]
    for needed in (package, "board"):
        if find_spec(needed) is None:
            raise HardwareError(_why_not(name, f"there is no module {needed}"))


def _module_of(name: str) -> str:
    module_name = name.rpartition(".")[0]
    if not module_name:
        raise UsageError(f"'{name}' names no driver; write adafruit:MODULE.CLASS, such as adafruit:{BNO085}")
    return module_name


def _why_not(name: str, problem: object) -> str:
    package = f"adafruit-circuitpython-{name.split('.', maxsplit=1)[0].removeprefix('adafruit_')}"
    return f"{name} needs its driver and Blinka ({problem}); install {package} and: {install_line('boards')}"


def _maker(name: str, config: BoardConfig) -> Callable[[], Any]:
    module_name, class_name = _module_of(name), name.rpartition(".")[2]
    try:
        module, board = importlib.import_module(module_name), importlib.import_module("board")
        i2c = board.I2C
    except (ImportError, NotImplementedError, AttributeError) as error:  # the last two: a machine that Blinka knows not
        raise HardwareError(_why_not(name, error)) from error
    driver = getattr(module, class_name, None)
    if driver is None:
        raise UsageError(f"{module_name} has no class {class_name}; its documentation names it")

    def make() -> Any:
        device = driver(i2c())
        if hasattr(device, "enable_feature"):  # BNO08x: reports are off until asked for
            for attribute, report in _BNO_REPORTS.items():
                if attribute != "magnetic" or config.mag is not False:
                    device.enable_feature(report, round(1e6 / config.rate_hz))
        return device

    return make
