"""The adapter for `adafruit_*` drivers: units and stamps, whatever such a driver raises, and what is not installed."""

import sys
import types
from typing import Any

import numpy as np
import pytest

from vislam.config import BoardConfig, SensorCalibration, SensorsConfig
from vislam.core.errors import HardwareError, UsageError
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.adafruit import AdafruitImu, open_adafruit
from vislam.hw.emulator import SteppedClock
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.hw.sensors import check_devices, open_inertial
from worlds.gy85 import FIELD_UT, driving

TRANSFER_NS = 400_000


class Driver:
    """What a driver's object looks like: properties in m/s^2, rad/s and uT, each a transfer."""

    def __init__(self, clock: SteppedClock) -> None:
        self._clock = clock
        self.fails: Exception | None = None
        self.value: Any = None
        self.closed = 0
        self.features: list[tuple[int, int]] = []

    def _read(self, k: int) -> Any:
        if self.fails is not None:
            raise self.fails
        self._clock.advance(TRANSFER_NS)
        return driving(self._clock.now_ns())[k] if self.value is None else self.value

    @property
    def gyro(self) -> Any:
        return self._read(0)

    @property
    def acceleration(self) -> Any:
        return self._read(1)

    @property
    def temperature(self) -> float:
        return 31.0

    def deinit(self) -> None:
        self.closed += 1


class Nine(Driver):
    @property
    def magnetic(self) -> Any:
        x, y, z = self._read(2)
        return x + 1e-3 * (self._clock.now_ns() // 20_000_000 % 3), y, z


class Bno(Nine):
    """Reports by itself every 20 ms: in between it gives the last one again; nothing but zeros before the first."""

    def enable_feature(self, feature: int, report_interval: int) -> None:
        self.features.append((feature, report_interval))

    def _read(self, k: int) -> Any:
        self._clock.advance(TRANSFER_NS)
        t_ns = self._clock.now_ns() // 20_000_000 * 20_000_000
        return driving(t_ns)[k] if t_ns > 1_000_100_000_000 else (0.0, 0.0, 0.0)


def collected(source: AdafruitImu, clock: SteppedClock, duration_s: float) -> tuple[list[ImuSample], list[MagSample]]:
    inertial: list[ImuSample] = []
    magnetic: list[MagSample] = []
    end_ns = clock.now_ns() + round(duration_s * 1e9)
    while clock.now_ns() < end_ns:
        begin_ns = clock.now_ns()
        for sample in source.read(0.1):
            (inertial if isinstance(sample, ImuSample) else magnetic).append(sample)  # type: ignore[arg-type]
        assert clock.now_ns() - begin_ns < 0.15e9
    return inertial, magnetic


def test_samples_are_the_truth_at_stamps_of_the_host_in_the_body_s_axes() -> None:
    clock = SteppedClock()
    driver = Nine(clock)
    source: InertialSource = AdafruitImu(driver, BoardConfig(rate_hz=100.0), clock)
    assert isinstance(source, AdafruitImu)
    inertial, magnetic = collected(source, clock, 4.0)
    assert len(inertial) == pytest.approx(400, abs=3)
    assert len(magnetic) == pytest.approx(200, abs=3)
    for sample in inertial:
        rate, force, _, _ = driving(sample.t_ns)
        assert abs(sample.gyro_rad_s - rate).max() < 5e-4, "read within 0.4 ms of the stamp"
        assert abs(sample.accel_m_s2 - force).max() < 2e-3
    np.testing.assert_allclose(magnetic[0].field_ut, FIELD_UT, atol=3e-3)
    assert source.health() == Health(0)
    assert source.counters() == {}
    assert source.temperature_c == 31.0
    assert "host" in source.stamped_by
    source.close()
    assert driver.closed == 1


def test_axes_calibration_and_temperature_are_the_board_s() -> None:
    clock = SteppedClock()
    calibration = SensorCalibration(gyro_axes=("-y", "x", "z"), gyro_bias_rad_s=(0.1, 0.0, 0.0))
    source = AdafruitImu(Driver(clock), BoardConfig(calibration=calibration), clock)
    source.zeroed_at(25.0, np.array([0.01, 0.0, 0.0]))
    sample = collected(source, clock, 0.1)[0][-1]
    x, y, z = driving(sample.t_ns)[0]
    np.testing.assert_allclose(sample.gyro_rad_s, [-y - 0.1 - 0.06, x, z], atol=1e-3)


def test_a_chip_that_reports_by_itself_gives_each_report_once() -> None:
    clock = SteppedClock()
    source = AdafruitImu(Bno(clock), BoardConfig(rate_hz=200.0), clock)
    inertial, _ = collected(source, clock, 4.0)
    assert len(inertial) == pytest.approx(195, abs=15)
    assert source.counters()["repeated"] > 500
    assert all(abs(sample.accel_m_s2[2]) > 9.0 for sample in inertial), "zeros before the first report are no sample"


@pytest.mark.parametrize("error", [OSError(121, "Remote I/O error"), RuntimeError("packet"), KeyError(5), ValueError()])
def test_whatever_a_driver_raises_is_counted_told_and_over_when_it_is_over(error: Exception) -> None:
    clock = SteppedClock()
    driver = Nine(clock)
    source = AdafruitImu(driver, BoardConfig(), clock)
    collected(source, clock, 0.5)
    driver.fails = error
    assert collected(source, clock, 1.0)[0] == []
    assert source.health() & (Health.IMU_MISSING | Health.BUS_FAULT) == Health.IMU_MISSING | Health.BUS_FAULT
    driver.fails = None
    collected(source, clock, 0.1)
    source.health()
    assert len(collected(source, clock, 1.0)[0]) == pytest.approx(200, abs=4)
    assert source.health() == Health(0)
    assert sum(source.counters().values()) > 100


@pytest.mark.parametrize("value", [(1.0, 2.0), (1.0, float("nan"), 3.0), None, "abc", (1e400, 0.0, 0.0), 5.0])
def test_values_that_are_none_make_no_sample(value: Any) -> None:
    clock = SteppedClock()
    driver = Driver(clock)
    source = AdafruitImu(driver, BoardConfig(), clock)
    driver.value = value if value is not None else (None, None, None)
    assert collected(source, clock, 0.3)[0] == []
    assert source.counters()["bad_values"] > 20


def test_an_accelerometer_that_hangs_alone_is_named_and_not_integrated() -> None:
    class Hung(Driver):
        @property
        def acceleration(self) -> Any:
            self._clock.advance(TRANSFER_NS)
            return 0.0, 0.0, 9.8

    clock = SteppedClock()
    source = AdafruitImu(Hung(clock), BoardConfig(), clock)
    assert len(collected(source, clock, 1.0)[0]) == 20
    assert set(source.counters()) == {"accel_stuck"}
    assert source.health() == Health.ACCEL_FAULT | Health.IMU_GAP | Health.IMU_MISSING


def test_one_that_gives_the_same_for_ever_is_missing_and_made_anew() -> None:
    clock = SteppedClock()
    driver = Driver(clock)
    made: list[Driver] = []

    def again() -> Driver:
        if not made:
            made.append(driver)
            raise OSError("not yet")
        made.append(Driver(clock))
        return made[-1]

    source = AdafruitImu(driver, BoardConfig(), clock, again)
    collected(source, clock, 0.2)
    driver.value = (1.0, 2.0, 3.0)
    collected(source, clock, 0.2)
    assert source.health() & Health.IMU_MISSING
    collected(source, clock, 1.0)
    assert source.counters()["open_failures"] == 1
    assert source.counters()["reopened"] == 1
    assert len(collected(source, clock, 1.0)[0]) == pytest.approx(200, abs=4)


def test_a_host_that_comes_late_is_told() -> None:
    clock = SteppedClock()
    source = AdafruitImu(Driver(clock), BoardConfig(), clock)
    collected(source, clock, 0.2)
    clock.advance(500_000_000)
    collected(source, clock, 0.1)
    assert source.counters()["rounds_missed"] >= 98
    assert source.health() & Health.IMU_GAP


@pytest.mark.parametrize("where", ["before", "within"])
def test_one_question_in_vain_after_a_host_was_put_aside_replaces_no_driver(where: str) -> None:
    class Flaky(Driver):
        in_vain = False

        def _read(self, k: int) -> Any:
            if self.in_vain:
                self.in_vain = False
                if where == "within":
                    self._clock.advance(300_000_000)
                raise OSError(121, "Remote I/O error")
            return super()._read(k)

    clock = SteppedClock()
    driver = Flaky(clock)
    source = AdafruitImu(driver, BoardConfig(), clock, lambda: pytest.fail("made anew"))
    for _ in range(3):
        for _ in range(40):
            assert source.read(0.1)
        driver.in_vain = True
        if where == "before":
            clock.advance(300_000_000)
        assert source.read(0.5)
    assert source.counters()["read_failed"] == 3
    assert "reopened" not in source.counters()


def test_what_is_no_inertial_sensor_or_too_fast_is_refused() -> None:
    clock = SteppedClock()
    with pytest.raises(UsageError, match="has no acceleration and no gyro"):
        AdafruitImu(object())
    with pytest.raises(UsageError, match="at most 200"):
        AdafruitImu(Driver(clock), BoardConfig(rate_hz=400.0), clock)
    broken = Driver(clock)
    broken.fails = OSError("no answer")
    with pytest.raises(HardwareError, match="cannot be read: no answer"):
        AdafruitImu(broken, BoardConfig(), clock)


def test_a_magnetometer_that_is_switched_off_is_none() -> None:
    class Off(Driver):
        @property
        def magnetic(self) -> Any:
            raise RuntimeError("No magfield report found, is it enabled?")

    clock = SteppedClock()
    source = AdafruitImu(Off(clock), BoardConfig(), clock)
    collected(source, clock, 0.5)
    assert source.health() == Health(0)
    assert source.counters() == {}


def test_a_driver_is_opened_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Bno] = []

    class Real(Bno):
        def __init__(self, i2c: object) -> None:
            super().__init__(SteppedClock())
            assert i2c == "the bus"
            opened.append(self)

    board, module, inner = (types.ModuleType(name) for name in ("board", "adafruit_bno08x", "adafruit_bno08x.i2c"))
    board.I2C = lambda: "the bus"  # type: ignore[attr-defined]
    inner.BNO08X_I2C = Real  # type: ignore[attr-defined]
    for made in (board, module, inner):
        monkeypatch.setitem(sys.modules, made.__name__, made)
    source = open_inertial("bno085", SensorsConfig(board=BoardConfig(rate_hz=100.0)))
    assert opened[0].features == [(1, 10_000), (2, 10_000), (3, 10_000)]
    source.close()
    with pytest.raises(UsageError, match="has no class Other"):
        open_adafruit("adafruit_bno08x.i2c.Other", BoardConfig())
    with pytest.raises(UsageError, match="names no driver"):
        open_inertial("adafruit", SensorsConfig())


def test_without_the_library_the_extra_is_named() -> None:
    with pytest.raises(HardwareError, match=r"install adafruit-circuitpython-absent_chip and: .*'\.\[boards\]'"):
        open_adafruit("adafruit_absent_chip.X", BoardConfig())
    with pytest.raises(HardwareError, match=r"no module adafruit_absent_chip\); install.*'\.\[boards\]'"):
        check_devices("adafruit:adafruit_absent_chip.X", "none", SensorsConfig())
    with pytest.raises(UsageError, match="names no driver"):
        check_devices("adafruit:X", "none", SensorsConfig())
