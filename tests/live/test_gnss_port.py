"""A satellite receiver on a port: real pyserial over a pseudo-terminal that is unplugged and plugged in again."""

import os
import pty
import struct
import time
import tty
from collections.abc import Callable
from functools import reduce
from itertools import accumulate
from operator import xor
from pathlib import Path

import numpy as np
import pytest

from vislam.core.errors import HardwareError
from vislam.core.readings import Reading
from vislam.hw import PortReadings, port_readings, talks
from vislam.hw.port_readings import ReadingPort
from vislam.hw.serial_port import check_port
from vislam.hw.talks import NmeaStream, UbxStream
from vislam.sensors.gnss import GnssSettings
from vislam.sensors.toml import SensorPort
from waiting import HUNG_S, wait_for

METRES_PER_MINUTE = 1852.2  # of latitude, at 48 degrees, to a metre


def sentence(body: str) -> bytes:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n".encode()


def burst(second: int, minutes: float = 7.038) -> bytes:
    """Return what a receiver says of one time: date, place, and satellites that nobody asks for."""
    time_of_day = f"1200{second:02d}.00"
    return (
        sentence(f"GNRMC,{time_of_day},A,4807.038,N,01131.000,E,0.0,0.0,230326,,,A")
        + sentence(f"GNGGA,{time_of_day},48{minutes:09.6f},N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,")
        + sentence("GPGSV,1,1,01,01,40,083,46")
    )


def pvt() -> bytes:
    """Return u-blox's message NAV-PVT with a fix in Munich."""
    payload = struct.pack(
        "<IHBBBBBBIiBBBBiiiiII", 0, 2026, 3, 23, 12, 0, 0, 7, 30, 0, 3, 1, 0, 12, 115167000, 481173000, 592300, 545400,
        1500, 2500,
    ).ljust(92, b"\0")  # fmt: skip
    body = b"\x01\x07" + struct.pack("<H", len(payload)) + payload
    sums = list(accumulate(body))
    return b"\xb5\x62" + body + bytes((sums[-1] & 0xFF, sum(sums) & 0xFF))


class Receiver:
    """A plug that a test pulls and puts back."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.plug_in()

    def plug_in(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.link.symlink_to(os.ttyname(slave))
        self.slave = slave

    def say(self, data: bytes) -> None:
        os.write(self.master, data)

    def unplug(self) -> None:
        self.link.unlink()
        os.close(self.slave)
        os.close(self.master)


@pytest.fixture
def config(tmp_path: Path) -> SensorPort:
    return SensorPort(str(tmp_path / "tty"), 9600, "nmea", 0.25, GnssSettings())


def test_a_receiver_that_is_unplugged_goes_on_in_the_frame_it_had(
    config: SensorPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port_readings, "_REOPEN_S", 0.02)
    monkeypatch.setattr(talks, "_OLD_NS", round(HUNG_S * 1e9))
    receiver = Receiver(Path(config.port))
    sensors = PortReadings({"gnss": config})
    found: list[Reading] = []

    def comes(count: int) -> Callable[[], bool]:
        def look() -> bool:
            found.extend(sensors.read())
            return len(found) >= count

        return look

    def state() -> tuple[object, object]:
        return sensors.status(), sensors.counters()

    try:
        wait_for(lambda: sensors.counters()["gnss"]["opened"] == 1, state)
        assert sensors.datums() == {}
        said_ns = time.monotonic_ns()
        receiver.say(burst(0))
        wait_for(comes(1), state)
        assert sensors.status() == {"gnss": "well"}
        datum = sensors.datums()["gnss"]
        assert found[0].sensor == "gnss"
        assert said_ns <= found[0].t_ns + 250_000_000 <= time.monotonic_ns()
        receiver.unplug()
        wait_for(lambda: "no port" in sensors.status()["gnss"], state)
        assert sensors.counters()["gnss"]["port_lost"] == 1
        receiver.plug_in()
        wait_for(lambda: sensors.counters()["gnss"]["opened"] == 2, state)
        receiver.say(b"\xff\xffnoise\r\n" + burst(30, minutes=7.138))
        wait_for(comes(2), state)
        assert sensors.status() == {"gnss": "well"}
    finally:
        sensors.close()
        sensors.close()
    assert sensors.datums()["gnss"] == datum
    counts = sensors.counters()["gnss"]
    assert counts["fixes"] == 2
    assert counts["damaged"] == 1
    assert found[0].values == pytest.approx(np.zeros(3), abs=1e-6)
    assert found[1].values[1] == pytest.approx(0.1 * METRES_PER_MINUTE, rel=2e-3)  # not a datum of its own
    assert found[1].t_ns > found[0].t_ns


def test_a_fix_that_is_not_good_enough_is_told(config: SensorPort) -> None:
    receiver = Receiver(Path(config.port))
    settings = SensorPort(config.port, config.baud, "nmea", 0.0, GnssSettings(least_fix="rtk"))
    port = ReadingPort("gnss", settings)
    try:
        wait_for(lambda: port.counters()["opened"] == 1, port.status)
        receiver.say(burst(0))
        wait_for(lambda: "rtk is asked" in port.status(), port.status)
        assert port.take() == []
    finally:
        port.close()
        receiver.unplug()


def test_a_mute_port_is_told_and_opened_anew(config: SensorPort, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_readings, "_SILENT_NS", 0)
    receiver = Receiver(Path(config.port))
    port = ReadingPort("gnss", config)
    try:
        wait_for(lambda: port.counters()["opened"] > 1, port.status)
        assert "is silent" in port.status()
    finally:
        port.close()
        receiver.unplug()


def test_a_port_that_is_not_there_is_refused_before_a_run(config: SensorPort) -> None:
    with pytest.raises(HardwareError, match="there is no port"):
        check_port(config.port, config.baud)


def test_a_fix_is_stamped_when_the_first_byte_of_its_burst_came() -> None:
    stream, data = NmeaStream(), burst(0)
    assert stream.feed(data[:10], 1000) == []
    assert stream.feed(data[10:], 2000) == []
    assert [fix.t_ns for fix in stream.end_burst()] == [1000]
    assert stream.feed(burst(1), 3000) == []
    assert [fix.t_ns for fix in stream.end_burst()] == [3000]


def test_without_gaps_the_first_sentence_of_another_time_begins_a_fix() -> None:
    stream, data = NmeaStream(), b"".join(burst(second) for second in range(4))
    fixes = [fix for at in range(0, len(data), 7) for fix in stream.feed(data[at : at + 7], 1000 + at)]
    begins = [1000 + 7 * (data.index(f"$GNRMC,1200{second:02d}".encode()) // 7) for second in range(3)]
    assert [fix.t_ns for fix in fixes] == begins


def test_a_damaged_sentence_takes_nobody_s_stamp() -> None:
    stream = NmeaStream()
    wrong = burst(7).replace(b"A*", b"V*", 1).splitlines(keepends=True)[0]
    assert stream.feed(wrong, 500) == []
    assert stream.feed(burst(8), 900) == []
    assert [fix.t_ns for fix in stream.end_burst()] == [500]  # the burst's first byte it was all the same
    assert stream.damaged == 1


def test_binary_fixes_are_stamped_when_their_burst_came() -> None:
    stream, message = UbxStream(), pvt()
    assert stream.feed(message[:3], 1000) == []
    assert [fix.t_ns for fix in stream.feed(message[3:], 2000)] == [1000]
    assert [fix.t_ns for fix in stream.feed(message + message, 3000)] == [3000, 3000]
    stream.feed(message[:1], 4000)
    stream.end_burst()
    assert [fix.t_ns for fix in stream.feed(message[1:], 5000)] == [5000]
    stream.feed(message[:-1] + b"\x00", 6000)
    assert stream.damaged == 1
