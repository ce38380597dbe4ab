"""Power-up as `vislam live` does it: the real driver on emulated chips, refused while it moves, biases remembered."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vislam.config import Config, Gy85Config, SensorsConfig, load
from vislam.core.errors import DataError
from vislam.hw.emulator import EmulatedBus, SteppedClock, Truth
from vislam.hw.gy85 import Gy85
from vislam.hw.health import Health
from vislam.imu import BiasMemory
from vislam.live.fast import FastPath
from vislam.live.processes.fast import power_up
from vislam.live.run_live import LiveRun
from vislam.live.sources import open_live
from vislam.live.wire.published_pose import PublishedPose, pack, unpack
from vislam.runs.folder import prepare
from worlds.corrections import CART_IMU, VisionWorld
from worlds.gy85 import board

RATE_HZ = 200.0
CONFIG = Config()
NOISE = replace(CART_IMU, rate_hz=RATE_HZ)
FIELD_UT = (18.0, -10.0, -43.0)
SLOPE = (0.17, -0.34, 9.8025)  # a floor that is tilted by 2.2 deg
T0_NS = SteppedClock().now_ns()
BEFORE_VISION = Health.LEVELLED | Health.DEAD_RECKONING | Health.INVALID


def standing(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
    return (0.0, 0.0, 0.0), SLOPE, FIELD_UT, 30.0


class Cart:
    """A board on a bus, and the fast path that reads it, on a clock of their own."""

    def __init__(
        self, driver: Gy85, clock: SteppedClock, memory: BiasMemory | None = None, is_mag_calibrated: bool = True
    ) -> None:
        self.poses: list[PublishedPose] = []
        self.refusals: list[str] = []
        self.fast = FastPath(CONFIG, NOISE, np.eye(4), self.poses.append, memory, is_mag_calibrated)
        self._driver, self._clock = driver, clock

    def run(self, duration_s: float) -> PublishedPose:
        """Read for so long, look for a zero twice a second, and return the newest pose."""
        for _ in range(round(duration_s / 0.5)):
            end_ns = self._clock.now_ns() + 500_000_000
            while self._clock.now_ns() < end_ns:
                for value in self._driver.read(0.1):
                    self.fast.add(value)
                self.fast.publish(self._clock.now_ns(), self._driver.health)
            power_up(self.fast, self._driver)
            self.refusals.append(self.fast.alone.report().get("refused", ""))
        return self.poses[-1]


def cart(truth: Truth):
    return board(truth, Gy85Config(self_test=False, rate_hz=RATE_HZ))


def bias_of(bus: EmulatedBus, temperature_c: float) -> np.ndarray:
    error = bus.chips[0x68]._sense._error  # type: ignore[attr-defined]
    return np.array(error.bias) + (temperature_c - 25.0) * np.array(error.bias_per_c)


def test_a_cart_that_stands_has_an_attitude_before_vision_and_says_what_it_lacks() -> None:
    with cart(standing) as (driver, bus, clock):
        it = Cart(driver, clock)
        assert it.run(1.0).health & ~Health.MAG_OK == Health.INVALID
        assert "2 s of samples asked" in it.refusals[-1]
        pose = it.run(2.5)
        assert pose.health == BEFORE_VISION | Health.MAG_OK
        np.testing.assert_allclose(pose.T_odom_base[2, :3], np.array(SLOPE) / np.linalg.norm(SLOPE), atol=0.01)
        np.testing.assert_allclose(pose.rate_rad_s, 0.0, atol=0.03)
        told = it.fast.alone.report()
        np.testing.assert_allclose(told["gyro_bias_rad_s"], bias_of(bus, 30.0), atol=2e-3)
        assert told["temperature_c"] == pytest.approx(30.0, abs=0.2)
        known = np.isfinite(np.diag(unpack(pack(pose)).pose_covariance))
        assert known.tolist() == [False, False, False, True, True, False], "x, y, z and the heading are not known"


def test_a_magnetometer_that_nobody_calibrated_says_nothing() -> None:
    with cart(standing) as (driver, _, clock):
        it = Cart(driver, clock, is_mag_calibrated=False)
        assert it.run(3.5).health == BEFORE_VISION


def test_a_cart_that_moves_is_refused_with_the_reason_until_it_stands() -> None:
    def moves_first(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
        since_s = (t_ns - T0_NS) * 1e-9
        swing = 0.4 * np.sin(6.0 * since_s) if since_s < 4.0 else 0.0
        return (0.0, 0.0, swing), SLOPE, FIELD_UT, 30.0

    with cart(moves_first) as (driver, _, clock):
        it = Cart(driver, clock)
        assert Health.LEVELLED not in it.run(4.0).health
        assert "rate varies by" in it.refusals[-1]
        assert "stand still" in it.refusals[-1]
        assert it.run(3.0).health == BEFORE_VISION | Health.MAG_OK
        assert it.refusals[-1] == ""


def test_an_even_turn_is_told_from_a_bias_by_what_is_remembered() -> None:
    def turning(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
        return (0.0, 0.0, 0.3), SLOPE, FIELD_UT, 30.0

    with cart(turning) as (driver, bus, clock):
        memory = BiasMemory(8)
        memory.add(30.5, bias_of(bus, 30.5))
        it = Cart(driver, clock, memory)
        assert Health.LEVELLED not in it.run(3.0).health
        assert "remembered" in it.refusals[-1]


def test_the_remembered_drift_is_taken_off_as_the_board_warms_up() -> None:
    def warming(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
        return (0.0, 0.0, 0.0), SLOPE, FIELD_UT, 30.0 + max((t_ns - T0_NS) * 1e-9 - 3.0, 0.0)

    rates = []
    for remembers in (True, False):
        with cart(warming) as (driver, bus, clock):
            memory = BiasMemory(8)
            for temperature_c in (20.0, 24.0, 28.0) if remembers else ():
                memory.add(temperature_c, bias_of(bus, temperature_c))
            it = Cart(driver, clock, memory)
            it.run(3.0)
            assert it.refusals[-1] == ""
            pose = it.run(12.0)
            assert Health.TEMPERATURE_DRIFT in pose.health, "biases are 12 deg C old"
            rates.append(np.mean([p.rate_rad_s for p in it.poses[-100:]], axis=0))
    true_change = abs(bias_of(bus, 42.0) - bias_of(bus, 30.0)).max()
    print(f"the gyro changed by {true_change:.4f} rad/s; left over with and without memory: {rates}")
    assert abs(rates[0]).max() < 0.4 * true_change
    assert abs(rates[0]).max() < 0.5 * abs(rates[1]).max(), "the attitude filter learns it at rest, later"


def test_a_magnet_near_by_takes_the_bit_away_and_the_earth_gives_it_back() -> None:
    def magnet_passes(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
        is_near = 4.0 < (t_ns - T0_NS) * 1e-9 < 6.0
        return (0.0, 0.0, 0.0), SLOPE, (40.0, -10.0, -43.0) if is_near else FIELD_UT, 30.0

    with cart(magnet_passes) as (driver, _, clock):
        it = Cart(driver, clock)
        assert Health.MAG_OK in it.run(3.5).health
        assert Health.MAG_OK not in it.run(2.0).health
        assert Health.MAG_OK in it.run(2.0).health


def test_a_field_that_is_not_the_earths_is_no_reference() -> None:
    def in_a_vault(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
        return (0.0, 0.0, 0.0), SLOPE, (3.0, 2.0, -8.0), 30.0

    with cart(in_a_vault) as (driver, _, clock):
        pose = Cart(driver, clock).run(4.0)
        assert Health.LEVELLED in pose.health
        assert Health.MAG_OK not in pose.health


def test_vision_takes_over_and_the_change_is_counted() -> None:
    """The first state of vision is another frame than that of the attitude: a controller has to be told."""
    world = VisionWorld.make(seed=4, duration_s=3.0)
    poses: list[PublishedPose] = []
    fast = FastPath(CONFIG, CART_IMU, np.eye(4), poses.append)
    still = [replace(s, t_ns=s.t_ns - 4_000_000_000, gyro_rad_s=np.zeros(3), accel_m_s2=np.array([0, 0, 9.81]))
             for s in world.samples]  # fmt: skip
    for sample in [s for s in still if s.t_ns < world.samples[0].t_ns] + world.samples:
        fast.add(sample)
        fast.power_up(None)
        if sample.t_ns <= world.start.state.t_ns < sample.t_ns + 10_000_000:
            fast.correct(world.start)
        fast.publish(sample.t_ns, lambda: Health(0))
    first = next(k for k, pose in enumerate(poses) if Health.VISION_OK in pose.health)
    assert poses[first - 1].health == BEFORE_VISION
    assert [poses[first - 1].reset_counter, poses[first].reset_counter] == [0, 1]
    assert Health.INVALID not in poses[first].health
    assert np.isfinite(poses[first].pose_covariance).all()


def live(tmp_path: Path, memory: Path) -> LiveRun:
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    base = load(None, {
        "view.enabled": False, "map.enabled": False, "live.name": f"vislam-test-power-{os.getpid()}",
        "live.send_to": (), "power_up.memory": str(memory), "power_up.window_s": 0.5,
    })  # fmt: skip
    asked = "virtual-cart,camera_hz=2,image_width_px=64,laps=0"
    source, config = open_live(asked, base, SensorsConfig())
    return LiveRun(source, config, out, asked, ["vislam", "live"])


def test_a_damaged_memory_is_refused_before_anything_starts(tmp_path: Path) -> None:
    memory = tmp_path / "biases.json"
    memory.write_text('{"gyro_biases": [{"temperature_c": 1e9, "gyro_bias_rad_s": [0, 0, 0]}]}')
    with pytest.raises(DataError, match="delete it to begin again"):
        live(tmp_path, memory)
