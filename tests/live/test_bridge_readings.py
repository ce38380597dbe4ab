"""Encoders and a receiver at the serial bridge: real pyserial and driver over a pseudo-terminal, up to the readings."""

import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest

from vislam.config import BridgeClockConfig, Config, SensorsConfig, SerialConfig
from vislam.core.errors import UsageError
from vislam.core.readings import Reading
from vislam.hw import PortReadings, talks
from vislam.hw.bridge import protocol
from vislam.hw.bridge.bridge import SerialBridge
from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.bridge.passer import BridgeState, Passer, passed_on
from vislam.hw.bridge.protocol import Chips, Counts, FrameDecoder, Hello, Passed, encode
from vislam.hw.emulator.bridge import BridgeEmulator, at_rest
from vislam.hw.health import Health
from vislam.live.sources import open_live
from vislam.sensors.gnss import GnssSettings
from vislam.sensors.ticks import TicksSettings
from vislam.sensors.toml import SensorPort, load_sensor_setup
from waiting import HUNG_S

TICKS = TicksSettings(ticks_per_turn=1000, radius_m=0.05)
M_PER_TICK = 2.0 * np.pi * 0.05 / 1000
PORTS = {
    "wheels": SensorPort("bridge", 115200, "csv", 0.0, GnssSettings(), ("left_m_s", "right_m_s"), TICKS),
    "gnss": SensorPort("bridge", 9600, "nmea", 0.25, GnssSettings()),
}
BURST = b"".join(
    b"$%s*%02X\r\n" % (body, reduce(xor, body))
    for body in (
        b"GNRMC,120000.00,A,4807.038,N,01131.000,E,0.0,0.0,230326,,,A",
        b"GNGGA,120000.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
    )
)


def turned(t_ns: int) -> tuple[float, float]:
    """Counts of a left wheel that goes ahead and of a right one that goes back, at speeds that tell their time."""
    t_s = t_ns % 10**12 * 1e-9
    return 3000.0 * t_s + 200.0 * np.sin(2.0 * t_s), -1500.0 * t_s + 2.0**31 - 100.0


def speeds(t_ns: int) -> np.ndarray:
    return M_PER_TICK * np.array([3000.0 + 400.0 * np.cos(2.0 * (t_ns % 10**12 * 1e-9)), -1500.0])


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SerialConfig:
    monkeypatch.setattr(talks, "_OLD_NS", round(HUNG_S * 1e9))
    clock = BridgeClockConfig(settle_s=0.2, bin_s=0.05)
    return SerialConfig(port=str(tmp_path / "tty"), start_s=HUNG_S, reopen_s=0.05, missing_s=HUNG_S, clock=clock)


class Machine:
    """A driver in one process, and who asks for further sensors in another; here in turns."""

    def __init__(self, config: SerialConfig) -> None:
        passes, hears = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.bridge = SerialBridge(config, must_be_there=False, further=passes)
        self.sensors = PortReadings(PORTS, hears)
        self.samples, self.found, self._passes = 0, list[Reading](), passes

    def until(self, true: Callable[[], bool]) -> None:
        end = time.monotonic() + HUNG_S
        while not true():
            assert time.monotonic() < end, (self.sensors.status(), self.sensors.counters(), self.bridge.counters())
            self.samples += len(self.bridge.read(0.01))
            self.found += self.sensors.read()

    def of(self, name: str) -> list[Reading]:
        return [reading for reading in self.found if reading.sensor == name]

    def close(self) -> None:
        self.bridge.close()
        self.sensors.close()
        self._passes.close()


@pytest.fixture
def machine(config: SerialConfig) -> Iterator[Machine]:
    machine = Machine(config)
    yield machine
    machine.close()


def test_one_cable_carries_inertial_data_wheels_and_fixes(config: SerialConfig, machine: Machine) -> None:
    assert "has not said anything" in machine.sensors.status()["wheels"]
    with BridgeEmulator(Path(config.port), at_rest, drift=0.01, turned=turned, has_receiver=True) as board:
        machine.until(lambda: len(machine.of("wheels")) > 20)
        said_ns = time.monotonic_ns()
        board.say(BURST)
        machine.until(lambda: bool(machine.of("gnss")))
        fix = machine.of("gnss")[0]
        # a second of patience: the board's thread is late where the machine is busy
        assert said_ns - 1_000_000_000 <= fix.t_ns + 250_000_000 <= time.monotonic_ns()
        assert machine.sensors.status() == {"wheels": "well", "gnss": "well"}
        assert machine.sensors.datums()["gnss"].latitude_deg == pytest.approx(48.1173)
        before = len(machine.of("wheels"))
        board.unplug()
        machine.until(lambda: machine.sensors.status()["wheels"] != "well")
        assert set(machine.sensors.status().values()) == {machine.bridge.problem}
        board.plug()  # its counters begin anew
        machine.until(lambda: len(machine.of("wheels")) > before + 20)
        board.restart()
        machine.until(lambda: machine.bridge.counters().get("device_restarts", 0) == 1)
        restarted = len(machine.of("wheels"))
        machine.until(lambda: len(machine.of("wheels")) > restarted + 20)
        assert machine.sensors.status()["wheels"] == "well"
        assert list(machine.sensors.datums()) == ["gnss"]  # the datum outlives a plug
    off = [np.abs(reading.values - speeds(reading.t_ns)) for reading in machine.of("wheels")]
    # a count of 20 ms is 0.016 m/s; no speed of a restart or a roll-over at 2^31 is among them
    assert np.max(off) < 0.1
    assert np.median(off) < 0.016
    assert machine.samples > 100
    assert machine.sensors.counters()["wheels"]["refused"] == 0


def test_an_old_sketch_says_what_it_lacks_and_goes_on(config: SerialConfig, machine: Machine) -> None:
    with BridgeEmulator(Path(config.port), at_rest) as board:
        board.say(BURST)
        machine.until(lambda: machine.samples > 100)
        machine.until(lambda: "has not said" not in machine.sensors.status()["wheels"])
    status = machine.sensors.status()
    assert "counts no encoders; set LEFT_A" in status["wheels"]
    assert "passes no receiver on; set GNSS_PORT" in status["gnss"]
    assert machine.found == []


def test_a_host_from_before_takes_the_samples_of_a_new_sketch(
    config: SerialConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in (protocol.COUNTS_TYPE, protocol.PASSED_TYPE):  # as it reads them: no frames
        monkeypatch.delitem(protocol._READERS, kind)
    with BridgeEmulator(Path(config.port), at_rest, turned=turned) as board:
        bridge = SerialBridge(config)
        samples, end = 0, time.monotonic() + HUNG_S
        while samples < 400:
            assert time.monotonic() < end
            samples += len(bridge.read(0.05))
        counts = bridge.counters()
        bridge.close()
        assert board.path.exists()
    assert counts["bad_frames"] > 5
    assert counts.get("frames_lost", 0) == 0
    assert Health.IMU_GAP not in bridge.health()


def test_a_sketch_with_encoders_and_nobody_who_asks_for_them(config: SerialConfig) -> None:
    with BridgeEmulator(Path(config.port), at_rest, turned=turned):
        bridge = SerialBridge(config)
        end = time.monotonic() + HUNG_S
        while bridge.counters().get("counts_frames", 0) < 20:
            assert time.monotonic() < end
            bridge.read(0.05)
        bridge.close()
    assert "passed_on_lost" not in bridge.counters()


def test_a_front_process_that_takes_nothing_stops_nobody() -> None:
    passes, hears = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    clock = DeviceClock(BridgeClockConfig(settle_s=0.0))
    passer = Passer(clock, passes)
    hello = FrameDecoder().feed(b"\0" + encode(Hello(0, 0, Chips(15), 0, 0, b"   ", 400, 1, 1, 1, 1, 0, 1, 1, 1)))[0]
    assert isinstance(hello, Hello)
    passer.greet(hello)
    for k in range(20_000):
        clock.stamp(20_000 * k, 20_000_000 * k)
        passer.take(Counts(k % 2**16, 20_000 * k, k, k))
    lost = passer.counts["passed_on_lost"]
    assert lost > 0
    assert sum(1 for _ in passed_on(hears)) + lost + passer.counts["counts_unstamped"] == 20_001
    passer.lose("unplugged")  # there is room again
    assert list(passed_on(hears)) == [BridgeState(Chips(0), "unplugged")]
    hears.close()
    passer.take(Passed(0, 20_000 * 19_999, b"x"))
    assert passer.counts["passed_on_lost"] == lost + 1
    passes.close()


def test_what_a_full_socket_did_not_take_of_the_state_is_told_with_the_next_hello() -> None:
    passes, hears = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    passer = Passer(DeviceClock(BridgeClockConfig()), passes)
    for k in range(5000):  # more than it takes
        passer.lose(f"problem {k}")
    lost = passer.counts["passed_on_lost"]
    assert 0 < lost < 5000
    assert len(list(passed_on(hears))) == 5000 - lost
    passer.greet(Hello(0, 0, Chips(0x0F), 0, 0, b"   ", 400, 1, 1, 1, 1, 0, 1, 1, 1))
    assert list(passed_on(hears)) == [BridgeState(Chips.ENCODERS, "")]
    passer.greet(Hello(1, 0, Chips(0x0F), 0, 0, b"   ", 400, 1, 1, 1, 1, 0, 1, 1, 1))
    assert list(passed_on(hears)) == []
    hears.close()
    passes.close()


def test_edges_too_fast_for_the_board_are_named_until_they_are_not() -> None:
    passes, hears = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    passer, sensors = Passer(DeviceClock(BridgeClockConfig()), passes), PortReadings(PORTS, hears)
    said = []
    for n, chips in enumerate((Chips(0x1F), Chips(0x3F), Chips(0x3F), Chips(0x1F))):
        passer.greet(Hello(n, 0, chips, 0, 0, b"   ", 400, 1, 1, 1, 1, 0, 1, 1, 1))
        sensors.read()
        said.append(["too fast for the board" in sensors.status()[name] for name in ("wheels", "gnss")])
    assert said == [[False, False], [True, False], [True, False], [False, False]]
    assert passer.counts["counts_doubted"] == 2
    sensors.close()
    passes.close()


def test_stamps_besides_change_no_line() -> None:
    config = BridgeClockConfig()
    ours, theirs = DeviceClock(config), DeviceClock(config)
    assert ours.host_ns(0) is None
    rng = np.random.default_rng(3)
    begin_us = 2**32 - 500_000
    for k in range(2000):
        device_us = (begin_us + 2500 * k) % 2**32
        arrival_ns = 10**12 + round(2.52e6 * k) + int(rng.exponential(2e5))
        assert ours.stamp(device_us, arrival_ns) == theirs.stamp(device_us, arrival_ns)
        besides = ours.host_ns((device_us + int(rng.integers(-5000, 5000))) % 2**32)
        if k > 1000:
            assert besides is not None
            assert abs(besides - (10**12 + 2.52e6 * k)) < 6e6
    assert ours.host_ns((begin_us + 2500 * 3000) % 2**32) is None


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ('kind = "height"\nport = "bridge"', "kind height wants a port of its own"),
        ('kind = "wheels"\nport = "bridge"', "kind wheels with ticks"),
        ('kind = "position"\nport = "bridge"\nbaud = 9600', "GNSS_BAUD"),
        ('kind = "twist"\nport = "bridge"\nticks = {ticks_per_turn = 1, radius_m = 1}', "counts are those of kind"),
    ],
)
def test_what_a_bridge_cannot_give_is_refused(tmp_path: Path, table: str, why: str) -> None:
    (tmp_path / "cart.toml").write_text(f"[sensors.it]\n{table}\n")
    with pytest.raises(UsageError, match=why):
        load_sensor_setup(tmp_path / "cart.toml")


def test_a_cart_opens_both_ends_of_its_bridge(tmp_path: Path, config: SerialConfig) -> None:
    file = tmp_path / "cart.toml"
    ticks = "ticks = {ticks_per_turn = 1000, radius_m = 0.05}"
    file.write_text(
        f'[sensors.wheels]\nkind = "wheels"\nport = "bridge"\n{ticks}\n'
        '[sensors.gnss]\nkind = "position"\nport = "bridge"\n'
    )
    setup = load_sensor_setup(file)
    without, _ = open_live("gy85+none", Config(), SensorsConfig())
    with pytest.raises(UsageError, match=r"\[sensors.wheels\]: port = \"bridge\" is the serial bridge"):
        without.readings(setup)
    cart, _ = open_live("serial+none", Config(), replace(SensorsConfig(), serial=config))
    with BridgeEmulator(Path(config.port), at_rest, turned=turned, has_receiver=True):
        readings, bridge = cart.readings(setup)(), cart.inertial()()
        found, end = list[Reading](), time.monotonic() + HUNG_S
        while not found:
            assert time.monotonic() < end, readings.status()
            bridge.read(0.02)
            found += readings.read()
        assert readings.status() == {"wheels": "well", "gnss": "no fix yet"}
        bridge.close()
        readings.close()
        cart.close()
        cart.close()
