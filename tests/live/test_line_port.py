"""Devices that say lines of numbers on a serial port: counts of encoders, and readings of any kind."""

import os
import pickle
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.live.test_gnss_port import Receiver
from vislam.core.readings import Reading
from vislam.hw import PortReadings, port_readings, talks
from vislam.hw.talks import LineTalk
from vislam.sensors.gnss import GnssSettings
from vislam.sensors.ticks import TicksSettings
from vislam.sensors.toml import SensorPort, load_sensor_setup
from waiting import HUNG_S

TICKS = TicksSettings(ticks_per_turn=1000, radius_m=0.05, bits=16)
M_PER_TICK = 2.0 * np.pi * 0.05 / 1000
MS = 1_000_000


def port(path: str = "/dev/null", ticks: TicksSettings | None = TICKS, delay_s: float = 0.0) -> SensorPort:
    columns = ("left_m_s", "right_m_s") if ticks else ("vx_m_s", "wz_rad_s")
    return SensorPort(path, 115200, "csv", delay_s, GnssSettings(), columns, ticks)


def begun(config: SensorPort) -> LineTalk:
    """A talk that has heard the end of a line."""
    talk = LineTalk("wheels", config)
    assert talk.feed(b"the rest of one 1 2\n", 0) == []
    return talk


@pytest.mark.parametrize("line", [b"ticks %d %d\r\n", b"%d,%d\n", b"%d;  %d\n", b"t\t%d\t%d\n"])
def test_counts_become_speeds(line: bytes) -> None:
    talk, found = begun(port()), []
    for k in range(4):  # 100 and -50 counts in 20 ms, over the end of 16 bits
        found += talk.feed(line % ((65400 + 100 * k) % 2**16, 20 - 50 * k), 1000 * MS + 20 * MS * k)
    assert [reading.t_ns for reading in found] == [1010 * MS, 1030 * MS, 1050 * MS]
    for reading in found:
        assert reading.values == pytest.approx([5000 * M_PER_TICK, -2500 * M_PER_TICK])
    assert talk.status() == "well"
    assert talk.counters() == {"readings": 3, "refused": 0, "damaged": 0, "unstamped": 0}


def test_a_line_has_the_time_of_its_first_byte_less_the_delay() -> None:
    talk = begun(port(ticks=None, delay_s=0.005))
    assert talk.feed(b"0.5", 100 * MS) == []
    found = talk.feed(b" -0.1\n0.6 -0.2\n", 103 * MS)
    assert [reading.t_ns for reading in found] == [95 * MS, 98 * MS]
    assert [reading.values.tolist() for reading in found] == [[0.5, -0.1], [0.6, -0.2]]


def test_a_clock_of_its_own_takes_the_jitter_of_the_host_off() -> None:
    rng = np.random.default_rng(5)
    with_clock, without = begun(port()), begun(port())
    errors: dict[str, list[float]] = {"with": [], "without": []}
    for k in range(500):
        arrival_ns = 1000 * MS + round(20 * MS * k + rng.exponential(2 * MS))
        device_us = (2**32 - 3_000_000 + round(20_000 * 1.003 * k)) % 2**32  # 0.3 % fast, and wraps
        said = b"%d %d" % (100 * k % 2**16, 100 * k % 2**16)
        for talk, name, line in ((with_clock, "with", said + b" %d\n" % device_us), (without, "without", said + b"\n")):
            errors[name] += [reading.values[0] - 5000 * M_PER_TICK for reading in talk.feed(line, arrival_ns)]
    assert len(errors["with"]) > 400
    assert np.std(errors["with"][-300:]) < 0.1 * np.std(errors["without"][-300:])
    assert abs(np.mean(errors["with"][-300:])) < 0.002 * 5000 * M_PER_TICK


@pytest.mark.parametrize(
    "line", [b"1", b"1 2 3 4", b"1.5 2", b"1 nan", b"\xff\xfe 2", b"ticks", b"1 x", b"1e400 2", b"1 2 inf"]
)
def test_lines_that_are_none_are_counted(line: bytes) -> None:
    talk = begun(port())
    assert talk.feed(line + b"\n", MS) == []
    assert talk.counters()["damaged"] == 1
    assert talk.status() == "no reading yet"
    talk.feed(b"# 1 2 3 4 5\n\n", 2 * MS)
    assert talk.counters()["damaged"] == 1


@given(st.lists(st.binary(max_size=3000), max_size=8))
def test_noise_raises_nothing_and_is_not_kept(chunks: list[bytes]) -> None:
    talk = LineTalk("wheels", port())
    for k, chunk in enumerate(chunks):
        assert all(np.isfinite(reading.values).all() for reading in talk.feed(chunk, k * MS))
    assert len(pickle.dumps(talk)) < 6000


def test_counters_that_jump_or_pause_give_no_speed_and_say_why() -> None:
    talk = begun(port())
    talk.feed(b"0 0\n", 0)
    assert talk.feed(b"0 30000\n", 20 * MS) == []
    assert "a counter that was reset" in talk.status()
    assert talk.feed(b"0 30000\n", 5000 * MS) == []
    assert "s after the last ones" in talk.status()
    assert len(talk.feed(b"0 30000\n", 5020 * MS)) == 1
    assert talk.counters()["refused"] == 2


@pytest.fixture
def device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Receiver]:
    monkeypatch.setattr(port_readings, "_REOPEN_S", 0.02)
    monkeypatch.setattr(talks, "_OLD_NS", round(HUNG_S * 1e9))
    device = Receiver(tmp_path / "tty")
    yield device
    device.unplug()


def test_encoders_are_unplugged_and_begin_anew(device: Receiver) -> None:
    sensors = PortReadings({"wheels": port(str(device.link))})
    found: list[Reading] = []

    def until(true: Callable[[], bool], say: bytes = b"") -> None:
        end = time.monotonic() + HUNG_S
        while not true():
            assert time.monotonic() < end, (sensors.status(), sensors.counters())
            if say:
                os.write(device.master, say)
            time.sleep(0.01)
            found.extend(sensors.read())

    try:
        until(lambda: sensors.counters()["wheels"]["opened"] == 1)
        until(lambda: len(found) > 3, b"ticks 30000 30000\n")
        assert sensors.status() == {"wheels": "well"}
        device.unplug()
        until(lambda: "no port" in sensors.status()["wheels"])
        device.plug_in()
        until(lambda: sensors.counters()["wheels"]["opened"] == 2)
        count = len(found)
        until(lambda: len(found) > count + 3, b"ticks 0 0\n")
        assert sensors.status() == {"wheels": "well"}
    finally:
        sensors.close()
    assert sensors.counters()["wheels"]["port_lost"] == 1
    assert all(reading.values.tolist() == [0.0, 0.0] for reading in found)  # none across the plug


def test_any_kind_may_have_a_port(tmp_path: Path) -> None:
    file = tmp_path / "cart.toml"
    ticks = "ticks = {ticks_per_turn = 1, radius_m = 1}"
    file.write_text(
        f'[sensors.wheels]\nkind = "wheels"\nport = "/dev/a"\n{ticks}\n'
        '[sensors.baro]\nkind = "height"\nport = "/dev/b"\nbaud = 57600\ndelay_s = 0.02\n'
        '[sensors.gnss]\nkind = "position"\nport = "/dev/c"\n'
        '[sensors.tag]\nkind = "position"\nport = "/dev/d"\nformat = "csv"\n'
    )
    ports = load_sensor_setup(file).ports
    assert {name: (p.format, p.baud, p.delay_s) for name, p in ports.items()} == {
        "wheels": ("csv", 115200, 0.0),
        "baro": ("csv", 57600, 0.02),
        "gnss": ("nmea", 9600, 0.05),
        "tag": ("csv", 115200, 0.0),
    }
    assert ports["wheels"].ticks is not None
    assert ports["tag"].columns == ("east_m", "north_m", "up_m")
