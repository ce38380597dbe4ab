"""The drivers of single chips against virtual ones: registers, self-tests, clones, overflow, gain, FIFO."""

import numpy as np
import pytest

from vislam.core.errors import HardwareError
from vislam.hw.chips.adxl345 import Adxl345, self_test_limits_lsb
from vislam.hw.chips.bus import I2cBus, SettingsLostError
from vislam.hw.chips.hmc5883l import Hmc5883l
from vislam.hw.chips.itg3205 import Itg3205
from vislam.hw.chips.known import find_magnetometer
from vislam.hw.emulator import (
    EmulatedBus,
    SensorError,
    SteppedClock,
    Truth,
    VirtualAdxl345,
    VirtualHmc5883l,
    VirtualItg3205,
    VirtualQmc5883,
    emulated_bus,
)
from worlds.gy85 import FIELD_UT, driving, still

ACCEL_DENSITY = (0.004, 0.004, 0.006)


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


def pass_time(clock: SteppedClock, seconds: float) -> None:
    clock.advance(round(seconds * 1e9))


# ---- ADXL345


@pytest.mark.parametrize(("rate_hz", "range_g"), [(100, 2), (200, 4), (400, 8), (800, 16)])
def test_adxl345_counts_256_per_g_in_every_range_and_paces_itself(
    clock: SteppedClock, rate_hz: int, range_g: int
) -> None:
    with emulated_bus(EmulatedBus({0x53: VirtualAdxl345(still, clock.now_ns)})) as virtual:
        chip = Adxl345(I2cBus(virtual.path, 0.02), rate_hz, range_g)
        chip.configure()
        pass_time(clock, 20.5 / rate_hz)
        counts, was_full = chip.read_fifo()
        assert len(counts) == 20
        assert not was_full
        np.testing.assert_array_equal(counts, np.tile([0.0, 0.0, 256.0], (20, 1)))
        assert chip.limit_lsb == 256 * range_g - 1


def test_adxl345_fifo_is_drained_oldest_first_in_one_call_per_21(clock: SteppedClock) -> None:
    with emulated_bus(EmulatedBus({0x53: VirtualAdxl345(driving, clock.now_ns)})) as virtual:
        chip = Adxl345(I2cBus(virtual.path, 0.02), 400, 16)
        chip.configure()
        begin_ns = clock.now_ns()
        pass_time(clock, 30.5 / 400)
        before = virtual.transfers
        counts, was_full = chip.read_fifo()
        assert virtual.transfers - before == 3  # how many there are, 21 of them, 9 of them
        assert (len(counts), was_full) == (30, False)
        times = begin_ns + (np.arange(30) + 1) * 2_500_000
        expected = np.array([driving(int(t))[1] for t in times]) / 9.80665 * 256
        np.testing.assert_allclose(counts, expected, atol=0.51)


def test_adxl345_overrun_is_told_and_the_newest_are_kept(clock: SteppedClock) -> None:
    with emulated_bus(EmulatedBus({0x53: VirtualAdxl345(driving, clock.now_ns)})) as virtual:
        chip = Adxl345(I2cBus(virtual.path, 0.02), 400, 16)
        chip.configure()
        begin_ns = clock.now_ns()
        pass_time(clock, 500.5 / 400)
        counts, was_full = chip.read_fifo()
        assert (len(counts), was_full) == (32, True)
        newest = np.array(driving(begin_ns + 500 * 2_500_000)[1]) / 9.80665 * 256
        np.testing.assert_allclose(counts[-1], newest, atol=0.51)


def test_adxl345_limits_follow_the_supply_as_the_data_sheet_says() -> None:
    np.testing.assert_allclose(self_test_limits_lsb(2.5), [[50, 540], [-540, -50], [75, 875]])
    np.testing.assert_allclose(self_test_limits_lsb(3.3), [[88.5, 955.8], [-955.8, -88.5], [110.25, 1286.25]])


@pytest.mark.parametrize(
    ("push_g", "passed"),
    [((0.9, -0.9, 1.2), True), ((0.9, 0.9, 1.2), False), ((0.0, -0.9, 1.2), False), ((0.9, -0.9, 6.0), False)],
)
def test_adxl345_self_test(clock: SteppedClock, push_g: tuple[float, float, float], passed: bool) -> None:
    error = SensorError(density=ACCEL_DENSITY, bias=(1.0, -1.0, 2.0))
    virtual = VirtualAdxl345(still, clock.now_ns, error, seed=3, self_test_g=push_g)
    with emulated_bus(EmulatedBus({0x53: virtual})) as bus:
        chip = Adxl345(I2cBus(bus.path, 0.02), 400, 16)
        chip.configure()
        result = chip.self_test(clock, 3.3)
        assert result.passed is passed
        np.testing.assert_allclose(result.measured, np.array(push_g) * 256, atol=2.0)
        assert not virtual.registers[0x31] & 0x80, "the push is taken off again"
        pass_time(clock, 0.05)
        assert len(chip.read_fifo()[0]) > 0


def test_adxl345_self_test_says_when_it_is_moved_or_gets_no_samples(clock: SteppedClock) -> None:
    def shaken(t_ns: int):  # type: ignore[no-untyped-def]
        return (0, 0, 0), (2.0 * np.sin(t_ns * 6e-8), 0, 9.8), (0, 0, 0), 20.0

    virtual = VirtualAdxl345(shaken, clock.now_ns)
    with emulated_bus(EmulatedBus({0x53: virtual})) as bus:
        chip = Adxl345(I2cBus(bus.path, 0.02), 400, 16)
        chip.configure()
        moved = chip.self_test(clock, 3.3)
        assert moved.passed is None
        assert "stand still" in moved.what
        virtual.is_frozen = True
        begin_ns = clock.now_ns()
        silent = chip.self_test(clock, 3.3)
        assert silent.passed is False
        assert clock.now_ns() - begin_ns < 2_000_000_000


# ---- ITG3205


@pytest.mark.parametrize("bandwidth_hz", [256, 188, 98, 42, 20, 10, 5])
def test_itg3205_gives_rate_and_temperature_at_its_own_delay(clock: SteppedClock, bandwidth_hz: int) -> None:
    virtual = VirtualItg3205(driving, clock.now_ns)
    with emulated_bus(EmulatedBus({0x68: virtual})) as bus:
        chip = Itg3205(I2cBus(bus.path, 0.02), bandwidth_hz)
        chip.configure(clock)
        pass_time(clock, 1.2345)
        temperature, *counts = chip.read()
        assert temperature == pytest.approx(30.0, abs=0.01)
        expected = np.rad2deg(driving(clock.now_ns() - round(chip.delay_s * 1e9))[0]) * 14.375
        np.testing.assert_allclose(counts, expected, atol=1.5)


def test_itg3205_that_lost_its_power_is_seen_at_the_next_read(clock: SteppedClock) -> None:
    virtual = VirtualItg3205(driving, clock.now_ns)
    with emulated_bus(EmulatedBus({0x68: virtual})) as bus:
        chip = Itg3205(I2cBus(bus.path, 0.02), 98)
        chip.configure(clock)
        chip.read()
        virtual.power_cycle()
        with pytest.raises(SettingsLostError):
            chip.read()


def test_wrong_chips_are_refused(clock: SteppedClock) -> None:
    adxl, itg = VirtualAdxl345(still, clock.now_ns), VirtualItg3205(still, clock.now_ns)
    adxl.registers[0], itg.registers[0] = 0xE6, 0x71
    with emulated_bus(EmulatedBus({0x53: adxl, 0x68: itg})) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        with pytest.raises(HardwareError, match="0xe6"):
            Adxl345(bus, 400, 16).configure()
        with pytest.raises(HardwareError, match="0x71"):
            Itg3205(bus, 98).configure(clock)


# ---- magnetometers


def magnetometers(clock: SteppedClock, error: SensorError, truth: Truth = still) -> dict[str, tuple[int, object]]:
    now = clock.now_ns
    return {
        "HMC5883L": (0x1E, VirtualHmc5883l(truth, now, error)),
        "DA5883": (0x1E, VirtualHmc5883l(truth, now, error, status_works=False)),
        "QMC5883L": (0x0D, VirtualQmc5883(truth, now, error, variant="L")),
        "QMC5883P": (0x2C, VirtualQmc5883(truth, now, error, variant="P")),
    }


@pytest.mark.parametrize("name", ["HMC5883L", "DA5883", "QMC5883L", "QMC5883P"])
@pytest.mark.parametrize("range_ga", [1.9, 8.0])
def test_each_clone_is_found_told_apart_and_measures_the_field(clock: SteppedClock, name: str, range_ga: float) -> None:
    address, virtual = magnetometers(clock, SensorError(density=(0.02, 0.02, 0.02)))[name]
    with emulated_bus(EmulatedBus({address: virtual})) as bus:  # type: ignore[dict-item]
        chip = find_magnetometer(I2cBus(bus.path, 0.02), range_ga)
        assert chip is not None
        chip.configure(clock)
        readings = []
        for _ in range(50):
            pass_time(clock, 0.02)
            reading = chip.read()
            if reading is not None:
                readings.append(reading)
        assert chip.name == name
        assert len(readings) >= 40
        lsb_ut = 100.0 / 230.0 if range_ga > 2.0 else 100.0 / 820.0
        np.testing.assert_allclose(np.mean([r.field_ut for r in readings], axis=0), FIELD_UT, atol=lsb_ut)
        assert not any(r.overflow for r in readings)


def test_no_magnetometer_or_a_stranger_at_its_address_is_none(clock: SteppedClock) -> None:
    stranger = VirtualItg3205(still, clock.now_ns)
    with emulated_bus(EmulatedBus({0x1E: stranger, 0x0D: stranger, 0x2C: stranger})) as virtual:
        bus = I2cBus(virtual.path, 0.02)
        assert find_magnetometer(bus, 1.9) is None
        virtual.chips.clear()
        assert find_magnetometer(bus, 1.9) is None
        assert bus.counters.total() == 0


def test_hmc5883l_drops_the_measurement_that_still_has_the_old_gain(clock: SteppedClock) -> None:
    virtual = VirtualHmc5883l(still, clock.now_ns)
    with emulated_bus(EmulatedBus({0x1E: virtual})) as bus:
        raw_bus = I2cBus(bus.path, 0.02)
        narrow, wide = Hmc5883l(raw_bus, 0.88), Hmc5883l(raw_bus, 8.1)
        for chip in (narrow, wide, narrow):
            chip.configure(clock)
            seen = []
            for _ in range(4):
                pass_time(clock, 0.0138)
                seen.append(chip.read())
            assert seen[0] is None
            for reading in seen[1:]:
                assert reading is not None
                np.testing.assert_allclose(reading.field_ut, FIELD_UT, atol=0.5)


@pytest.mark.parametrize(
    ("coil_ga", "passed"), [((1.16, 1.16, 1.08), True), ((0.9, 1.3, 1.1), True), ((0.5, 1.16, 1.08), False)]
)
def test_hmc5883l_self_test_and_the_scale_it_gives(
    clock: SteppedClock, coil_ga: tuple[float, float, float], passed: bool
) -> None:
    virtual = VirtualHmc5883l(still, clock.now_ns, coil_ga=coil_ga)
    with emulated_bus(EmulatedBus({0x1E: virtual})) as bus:
        chip = Hmc5883l(I2cBus(bus.path, 0.02), 1.9)
        chip.configure(clock)
        result = chip.self_test(clock)
        assert result.passed is passed
        np.testing.assert_allclose(result.measured, np.array(coil_ga) * 390.0, atol=1.0)
        expected = np.array([1.16, 1.16, 1.08]) / coil_ga if passed else np.ones(3)
        np.testing.assert_allclose(chip.scale, expected, rtol=5e-3)
        assert virtual.registers[0x00] & 3 == 0, "the coil is off again"


def test_hmc5883l_is_freed_after_a_lock(clock: SteppedClock) -> None:
    virtual = VirtualHmc5883l(driving, clock.now_ns, SensorError(density=(0.02, 0.02, 0.02)))
    with emulated_bus(EmulatedBus({0x1E: virtual})) as bus:
        chip = Hmc5883l(I2cBus(bus.path, 0.02), 1.9)
        chip.configure(clock)
        readings = []
        for k in range(20):
            pass_time(clock, 0.02)
            if k == 10:
                virtual.lock()
            readings.append(chip.read())
        assert [k for k, r in enumerate(readings) if r is None] == [0, 10]
