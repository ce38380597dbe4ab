"""Files of sensors: tables, counts of encoders, and what satellite receivers write."""

import contextlib
import pickle
import struct
import tempfile
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core import Problems
from vislam.core.errors import DataError, VislamError
from vislam.core.readings import Reading
from vislam.datasets.sensor_files import local_frame, sensor_readings
from vislam.sensors.geodetic import Geodetic, LocalFrame
from vislam.sensors.gnss import GnssSettings, NmeaFixes, UbxFixes
from vislam.sensors.gnss.ubx import _checksum
from vislam.sensors.kinds import AnchorRange, AnchorRangeSettings, Height, Pose, Position, Wheels
from vislam.sensors.sensor import Configured
from vislam.sensors.ticks import TickSpeeds, TicksSettings, counted
from vislam.sensors.toml import FileFormat, SensorFile

MUNICH = Geodetic(48.1173, 11.5166667, 592.4)
NOON_NS = 1_700_049_600 * 10**9  # 15 November 2023, 12:00 UTC


def read(
    tmp_path: Path,
    sensor: Configured,
    content: str | bytes,
    format_: FileFormat = "csv",
    ticks: TicksSettings | None = None,
    gnss: GnssSettings | None = None,
    offset_s: float = 0.0,
) -> tuple[list[Reading], Problems]:
    path = tmp_path / f"it.{format_}"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    problems = Problems()
    file = SensorFile(path, format_, offset_s, ticks, gnss or GnssSettings())
    return list(sensor_readings("it", sensor, file, problems)), problems


def test_a_table_is_read_by_the_names_of_its_columns(tmp_path: Path) -> None:
    text = "# recorded in the yard\n#up_m, t_s, east_m,north_m,remark\n3,10.000000001,1,2,x\n6,11.5,4,5,y\n"
    readings, problems = read(tmp_path, Position(), text, offset_s=0.25)
    assert [r.t_ns for r in readings] == [10_250_000_001, 11_750_000_000]
    np.testing.assert_array_equal([r.values for r in readings], [[1, 2, 3], [4, 5, 6]])
    assert all(r.covariance is None and r.sensor == "it" for r in readings) and not problems


def test_a_table_without_names_has_its_columns_in_order(tmp_path: Path) -> None:
    readings, _ = read(tmp_path, Height(), "100,1.5\n200,1.6\n")
    assert [(r.t_ns, r.values.tolist()) for r in readings] == [(100, [1.5]), (200, [1.6])]


def test_sigmas_in_a_table_are_the_covariance_of_the_residual(tmp_path: Path) -> None:
    text = "t_ns,x_m,y_m,z_m,qx,qy,qz,qw,sigma_m,sigma_rad\n1,0,0,0,0,0,0,1,0.1,0.2\n2,0,0,0,0,0,0,1,0.0,0.2\n"
    readings, problems = read(tmp_path, Pose(), text)
    assert len(readings) == 1 and "sigma that is not positive" in next(iter(problems))
    np.testing.assert_allclose(np.diag(readings[0].covariance), [0.04] * 3 + [0.01] * 3)


def test_ranges_to_several_anchors_may_have_one_stamp(tmp_path: Path) -> None:
    sensor = AnchorRange(AnchorRangeSettings({"1": (0.0, 0.0, 0.0), "2": (1.0, 0.0, 0.0)}))
    readings, problems = read(tmp_path, sensor, "t_ns,anchor,range_m\n5,1,2.0\n5,2,3.0\n4,1,2.0\n6,1,2.5\n")
    assert [r.t_ns for r in readings] == [5, 5, 6]
    assert "backward stamp" in next(iter(problems))


def test_rows_that_cannot_be_used_are_counted(tmp_path: Path) -> None:
    text = "t_ns,height_m\n1,1.0\nx,2.0\n3,nan\n4,1.0\n5\n6,1.0\n7,1.0\n8,1."
    readings, problems = read(tmp_path, Height(), text)
    assert [r.t_ns for r in readings] == [1, 4, 6, 7]
    assert sum(problems.values()) == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [("t_ns,hight_m\n1,2\n", "no column height_m; there are t_ns, hight_m"), ("a,b\nc,d\n", "cannot be used")],
)
def test_a_file_that_is_no_such_table_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(tmp_path, Height(), text)
    with pytest.raises(DataError, match="cannot be read"):
        list(sensor_readings("it", Height(), SensorFile(tmp_path, "csv", 0.0, None, GnssSettings()), Problems()))


@pytest.mark.parametrize("bits", [8, 16, 32, 64])
def test_counters_roll_over_both_ways(bits: int) -> None:
    full = 1 << bits
    for true in (0, 1, -1, 100, -100, full // 2 - 1, -full // 2):
        for begin in (0, 5, full - 5, full // 2):
            assert counted((begin + true) % full - begin, bits) == true
            signed = (begin + true + full // 2) % full - full // 2
            assert counted(signed - begin, bits) == true, "whether the counter is signed or not"


def test_counts_become_speeds_in_the_middle_between_them(tmp_path: Path) -> None:
    ticks = TicksSettings(ticks_per_turn=1000, radius_m=0.5 / np.pi, bits=16, right_sign=-1)
    rows = [f"{k * 10**8},{(65500 + 30 * k) % 65536},{(40 - 20 * k) % 65536}" for k in range(8)]
    text = "\n".join(["t_ns,left_ticks,right_ticks", *rows, "5000000000,0,0", "5100000000,30000,0", ""])
    readings, problems = read(tmp_path, Wheels(), text, ticks=ticks)
    assert [r.t_ns for r in readings] == [k * 10**8 - 5 * 10**7 for k in range(1, 8)]
    np.testing.assert_allclose([r.values for r in readings], [[0.3, 0.2]] * 7, rtol=1e-12)
    assert sum(problems.values()) == 2, "a gap and a counter that was reset"


def test_counts_after_a_reset_go_on() -> None:
    speeds = TickSpeeds(TicksSettings(1000, 0.1, max_m_s=2.0))
    assert speeds.speeds(0, 10**6, 10**6) is None
    with pytest.raises(ValueError, match="reset"):
        speeds.speeds(10**8, 0, 0)
    assert speeds.speeds(2 * 10**8, 100, 100) is not None


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n"


def degrees(value: float, digits: int, sides: str) -> str:
    minutes = abs(value) * 60.0
    return f"{int(minutes // 60):0{digits}d}{minutes % 60:011.8f},{sides[value < 0]}"


def gga(clock: str, place: Geodetic, quality: int = 1, hdop: float = 0.9) -> str:
    where = f"{degrees(place.latitude_deg, 2, 'NS')},{degrees(place.longitude_deg, 3, 'EW')}"
    return sentence(f"GNGGA,{clock},{where},{quality},12,{hdop},{place.height_m - 47.0:.4f},M,47.0,M,,")


def rmc(clock: str, day: str, status: str = "A") -> str:
    return sentence(f"GNRMC,{clock},{status},4807.038,N,01131.000,E,0.4,84.4,{day},,,A")


def gst(clock: str, sigmas: str = "0.3,0.4,0.7") -> str:
    return sentence(f"GNGST,{clock},1.0,,,,{sigmas}")


def test_nmea_becomes_east_north_up(tmp_path: Path) -> None:
    frame = LocalFrame(MUNICH)
    path = [frame.geodetic(np.array([3.0 * k, -2.0 * k, 0.5 * k])) for k in range(5)]
    text = "".join(
        rmc(f"1200{k:02d}.50", "151123") + gga(f"1200{k:02d}.50", place) + gst(f"1200{k:02d}.50")
        for k, place in enumerate(path)
    )
    readings, problems = read(tmp_path, Position(), text, "nmea")
    assert [r.t_ns for r in readings] == [NOON_NS + k * 10**9 + 500_000_000 for k in range(5)]
    np.testing.assert_allclose([r.values for r in readings], [[3 * k, -2 * k, 0.5 * k] for k in range(5)], atol=1e-3)
    np.testing.assert_allclose(np.diag(readings[0].covariance), [0.125, 0.125, 0.49])
    assert not problems
    file = SensorFile(tmp_path / "it.nmea", "nmea", 0.0, None, GnssSettings())
    back = local_frame(file).geodetic(readings[4].values)
    assert back.latitude_deg == pytest.approx(path[4].latitude_deg, abs=1e-8)
    told = SensorFile(tmp_path / "it.nmea", "nmea", 0.0, None, GnssSettings(datum=(48.0, 11.0, 0.0)))
    assert local_frame(told).datum == Geodetic(48.0, 11.0, 0.0)


def test_south_and_west_are_negative() -> None:
    fixes = NmeaFixes()
    place = Geodetic(-33.9, -70.7, 500.0)
    fixes.feed(rmc("120000", "151123"))
    fixes.feed(gga("120000", place))
    fix = fixes.end()
    assert fix is not None
    assert fix.place.latitude_deg == pytest.approx(-33.9) and fix.place.longitude_deg == pytest.approx(-70.7)


def test_midnight_comes_before_the_sentence_that_dates_it() -> None:
    fixes, stamps = NmeaFixes(), []
    lines = [rmc("235959", "151123"), gga("235959", MUNICH), gga("000000", MUNICH), gga("000001", MUNICH),
             rmc("000001", "161123")]  # fmt: skip
    for line in lines:
        stamps += [fix.t_ns for fix in [fixes.feed(line)] if fix]
    stamps += [fix.t_ns for fix in [fixes.end()] if fix]
    assert stamps == [NOON_NS + 43199 * 10**9, NOON_NS + 43200 * 10**9, NOON_NS + 43201 * 10**9]


def test_a_stamp_before_a_sentence_is_the_fixes_own(tmp_path: Path) -> None:
    text = f"1234567890123456789 {gga('120000', MUNICH)}1234567891.5,{gga('120001', MUNICH)}{gga('120002', MUNICH)}"
    readings, problems = read(tmp_path, Position(), text, "nmea")
    assert [r.t_ns for r in readings] == [1234567890123456789, 1234567891500000000]
    assert list(problems.values()) == [1] and "fixes before any date" in next(iter(problems))


QUALITIES = {0: None, 1: 2.0, 2: 1.0, 4: 0.02, 5: 0.4, 6: None}


@pytest.mark.parametrize("quality", QUALITIES)
def test_a_fix_is_as_sure_as_its_kind(tmp_path: Path, quality: int) -> None:
    text = "".join(rmc(f"12000{k}", "151123") + gga(f"12000{k}", MUNICH, quality, 1.5) for k in range(3))
    readings, _ = read(tmp_path, Position(), text, "nmea")
    sigma = QUALITIES[quality]
    assert len(readings) == (0 if sigma is None else 3)
    for reading in readings:
        assert np.sqrt(reading.covariance[0, 0]) == pytest.approx(1.5 * sigma)
        assert np.sqrt(reading.covariance[2, 2]) == pytest.approx(3.0 * sigma)


def test_fixes_worse_than_asked_are_counted_and_do_not_make_the_datum(tmp_path: Path) -> None:
    far = Geodetic(48.2, 11.6, 500.0)
    text = rmc("120000", "151123") + gga("120000", far) + gga("120001", MUNICH, 4) + gga("120002", MUNICH, 4)
    readings, problems = read(tmp_path, Position(), text, "nmea", gnss=GnssSettings(least_fix="rtk"))
    np.testing.assert_allclose([r.values for r in readings], np.zeros((2, 3)), atol=1e-6)
    assert "fix of kind single, rtk is asked" in next(iter(problems))


def test_damaged_sentences_are_counted(tmp_path: Path) -> None:
    good = rmc("120000", "151123") + "".join(gga(f"12000{k}", MUNICH) for k in range(6))
    readings, problems = read(tmp_path, Position(), good + gga("120007", MUNICH).replace("48", "49", 1), "nmea")
    assert len(readings) == 6 and sum(problems.values()) == 1


def pvt(second: int, place: Geodetic, flags: int = 1, fix_type: int = 3, valid: int = 7, nano: int = -20) -> bytes:
    payload = struct.pack(
        "<IHBBBBBBIiBBBBiiiiII", 0, 2023, 11, 15, 12, 0, second, valid, 30, nano, fix_type, flags, 0, 12,
        round(place.longitude_deg * 1e7), round(place.latitude_deg * 1e7), round(place.height_m * 1e3), 0, 15, 25,
    ).ljust(92, b"\0")  # fmt: skip
    return framed(b"\x01\x07", payload)


def framed(kind: bytes, payload: bytes) -> bytes:
    body = kind + struct.pack("<H", len(payload)) + payload
    return b"\xb5\x62" + body + _checksum(body)


def test_ubx_becomes_east_north_up(tmp_path: Path) -> None:
    frame = LocalFrame(MUNICH)
    path = [frame.geodetic(np.array([3.0 * k, -2.0 * k, 0.0])) for k in range(4)]
    kinds = [0b1, 0b11, 0b01000011, 0b10000011]
    stream = b"".join(
        b"$GNGGA,garbage\r\n" + framed(b"\x01\x35", b"\xb5\x62" * 20) + pvt(k, place, flags)
        for k, (place, flags) in enumerate(zip(path, kinds, strict=True))
    )
    readings, problems = read(tmp_path, Position(), stream, "ubx")
    assert [r.t_ns for r in readings] == [NOON_NS + k * 10**9 - 20 for k in range(4)]
    np.testing.assert_allclose([r.values for r in readings], [[3 * k, -2 * k, 0] for k in range(4)], atol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(readings[0].covariance)), [0.015, 0.015, 0.025])
    assert not problems
    exact, _ = read(tmp_path, Position(), stream, "ubx", gnss=GnssSettings(least_fix="rtk"))
    assert len(exact) == 1


def test_ubx_without_a_place_or_a_time_gives_no_fix() -> None:
    fixes = UbxFixes()
    refused = [pvt(0, MUNICH, flags=0), pvt(0, MUNICH, fix_type=2), pvt(0, MUNICH, fix_type=5)]
    assert not list(fixes.feed(b"".join(refused))) and fixes.undated == 0
    assert not list(fixes.feed(pvt(0, MUNICH, valid=3))) and fixes.undated == 1


def test_ubx_comes_in_any_pieces_and_damage_costs_one_message() -> None:
    messages = [pvt(k, MUNICH) for k in range(10)]
    messages[4] = messages[4][:50] + b"\xff" + messages[4][51:]
    messages[7] = messages[7][:4] + b"\x40\x00" + messages[7][6:]  # its length
    stream = b"".join(messages)
    for size in (1, 7, 100, len(stream)):
        fixes = UbxFixes()
        found = [fix for k in range(0, len(stream), size) for fix in fixes.feed(stream[k : k + size])]
        assert [fix.t_ns for fix in found] == [NOON_NS + k * 10**9 - 20 for k in range(10) if k not in (4, 7)]
        assert fixes.damaged >= 2


def test_bytes_that_are_no_ubx_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no message NAV-PVT"):
        read(tmp_path, Position(), b"\xb5\x62" * 5000, "ubx")


LINES = st.lists(
    st.one_of(
        st.sampled_from([gga("120000", MUNICH), rmc("120000", "151123"), gst("120000"), rmc("999999", "999999")]),
        st.text(max_size=40).map(
            lambda text: sentence(f"GPGGA,{text}".replace("\n", " ")) if text.isprintable() else ""
        ),
        st.lists(st.text("0123456789.-NSEW", max_size=8), min_size=12, max_size=13).map(
            lambda fields: sentence("GPGGA," + ",".join(fields))
        ),
        st.binary(max_size=60).map(lambda data: data.decode("latin-1")),
    ),
    max_size=20,
)


@given(LINES)
def test_no_nmea_raises_anything_but_an_expected_error(lines: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(VislamError):
        for reading in read(Path(folder), Position(), "".join(lines).encode("utf-8", "replace"), "nmea")[0]:
            assert np.isfinite(reading.values).all() and np.isfinite(reading.covariance).all()


PIECES = st.one_of(
    st.binary(max_size=100),
    st.just(b"\xb5\x62"),
    st.binary(min_size=92, max_size=100).map(lambda payload: framed(b"\x01\x07", payload)),
    st.tuples(st.integers(0, 99), st.integers(0, 255)).map(
        lambda change: pvt(1, MUNICH)[: change[0]] + bytes([change[1]]) + pvt(1, MUNICH)[change[0] + 1 :]
    ),
)


@given(st.lists(PIECES, max_size=10))
def test_no_ubx_raises_anything_but_an_expected_error(pieces: list[bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(VislamError):
        for reading in read(Path(folder), Position(), b"".join(pieces), "ubx")[0]:
            assert np.isfinite(reading.values).all() and np.isfinite(reading.covariance).all()


@given(st.binary(max_size=300), st.sampled_from([b"", b"t_ns,height_m\n", b"t_s,height_m,sigma_height_m\n"]))
def test_no_table_of_readings_raises_anything_but_an_expected_error(data: bytes, header: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(VislamError):
        for reading in read(Path(folder), Height(), header + data)[0]:
            assert np.isfinite(reading.values).all()


def test_ubx_keeps_little_in_memory() -> None:
    fixes = UbxFixes()
    for _ in range(40):
        list(fixes.feed(b"\xb5\x62\x01\x07\xff\x1f" * 1000))
    assert len(pickle.dumps(fixes)) < 3 * 8300
