"""A GoPro's telemetry in files written from the description: stamps, axes, units, fixes, and hostile files."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.calibration.inertial.tables import read_inertial
from vislam.core import Problems
from vislam.core.errors import DataError, VislamError
from vislam.core.messages import Frame, ImuSample
from vislam.datasets import open_dataset
from vislam.datasets.inspect import inspect
from vislam.datasets.sensor_files import local_frame, sensor_readings
from vislam.datasets.telemetry import frame_times_ns, open_telemetry
from vislam.datasets.telemetry.klv import read_streams
from vislam.datasets.telemetry.mp4 import read_tracks
from vislam.sensors.toml import load_sensor_setup
from worlds import gopro
from worlds.mini_recording import IMU_YAML, camera_yaml

PAYLOADS, TICKS = 5, 1001
GYRO_S, ACCEL_S = 1 / 399.2, 1 / 201.9
FIRST_US = 998_443_450  # of the camera's clock; its first frame 2273 us later, as a HERO11 has it
SHUTTER_US = FIRST_US + 2273


def rate(t_s: np.ndarray) -> np.ndarray:
    return np.stack([0.4 * np.sin(t_s), 0.3 * np.cos(2 * t_s), 0.2 + 0 * t_s], axis=1)


def force(t_s: np.ndarray) -> np.ndarray:
    return np.stack([0.5 * np.sin(3 * t_s), 0.2 * t_s, 9.81 + 0.3 * np.cos(t_s)], axis=1)


def stored(xyz: np.ndarray, order: str) -> np.ndarray:
    """Put X, Y, Z [N, 3] in the order in which a camera stores them, small letters negated."""
    return np.stack([xyz[:, "XYZ".index(c.upper())] * (1 if c.isupper() else -1) for c in order], axis=1)


def cut(period_s: float, begin_s: float, jitter: tuple[int, ...]) -> list[np.ndarray]:
    """Return the times of samples by payload: cut at its end, and some samples sooner or later."""
    ends = np.array([(k + 1) * TICKS / gopro.SECOND for k in range(PAYLOADS)])
    last = np.ceil((ends - begin_s) / period_s).astype(int) + np.array(jitter)
    return [begin_s + period_s * np.arange(a, b) for a, b in zip([0, *last[:-1]], last, strict=True)]


def payloads(
    order: str = "ZXY",
    stamped: bool = True,
    fixes: str = "",
    told: dict[str, str] | None = None,
    extra: bytes = b"",
    **units: str,
) -> list[bytes]:
    told = {"ORIN": order} if told is None else told
    units = {"gyro": "rad/s", "accel": "m/s\xb2"} | units
    # by the camera's clock the film begins at SHUTTER_US
    begin_s = (FIRST_US - SHUTTER_US) * 1e-6 if stamped else 0.0
    gyro = cut(GYRO_S, begin_s, (0, 3, -2, 1, 0))
    accel = cut(ACCEL_S, begin_s, (0, -2, 2, 0, -1))
    made, totals = [], [0, 0, 0]
    for k in range(PAYLOADS):
        streams = []
        for i, (key, times, of, scale, unit) in enumerate(
            (("ACCL", accel[k], force, 417, units["accel"]), ("GYRO", gyro[k], rate, 939, units["gyro"]))
        ):
            totals[i] += len(times)
            stamp = SHUTTER_US + round(times[0] * 1e6) if stamped else None
            streams.append(
                gopro.inertial(key, stored(of(times), order), scale, totals[i], stamp, extra, **told, SIUN=unit)
            )
        if stamped:
            shutter = [gopro.number("STMP", "J", SHUTTER_US + round(k * 1e6 * TICKS / gopro.SECOND))]
            streams.append(gopro.nest("STRM", *shutter, gopro.klv("SHUT", "f", 4, 1, struct.pack(">f", 0.001))))
        t_s = k * TICKS / gopro.SECOND + np.arange(10) * 0.1001
        place = np.stack([42.4 + 1e-5 * t_s, -8.6 - 2e-5 * t_s, 34.0 + t_s, 1 + 0 * t_s, 1 + 0 * t_s], axis=1)
        if fixes == "GPS5":
            streams.append(gopro.gps5(place, 3 if k else 0, 179 if k else 9999))
        if fixes == "GPS9":
            more = np.stack([8298 + 0 * t_s, 48576 + t_s, 1.79 + 0 * t_s, np.where(t_s > 1.5, 3.0, 2.0)], axis=1)
            streams.append(gopro.gps9(np.hstack([place, more])))
        made.append(gopro.payload("HERO11 Black", *streams))
    return made


@pytest.fixture
def ride(tmp_path) -> Path:
    """A video with all that a run needs beside it."""
    path = gopro.write_video(tmp_path / "GX010001.MP4", 100)
    path.with_suffix(".yaml").write_text(camera_yaml())
    path.with_suffix(".imu.yaml").write_text(IMU_YAML)
    return path


def told(path: Path, severity: str) -> str:
    return "\n".join(f.what for f in inspect(str(path)).findings if f.severity == severity)


@pytest.mark.parametrize("order", ["ZXY", "YxZ", "zxY", "yXZ"])
def test_samples_come_by_the_clock_of_the_frames_in_the_axes_of_the_camera(ride, order):
    gopro.add_telemetry(ride, payloads(order), [TICKS] * PAYLOADS)
    recording = open_dataset(str(ride))
    events = list(recording.events())
    frames = [event.t_ns for event in events if isinstance(event, Frame)]
    assert frames == [50_000_000 * i for i in range(100)]
    samples = [event for event in events if isinstance(event, ImuSample)]
    t_s = np.array([sample.t_ns for sample in samples]) * 1e-9
    # stamps are whole microseconds: spread over a payload of 400 samples they are off by no more than one
    np.testing.assert_allclose(t_s, (FIRST_US - SHUTTER_US) * 1e-6 + GYRO_S * np.arange(len(t_s)), atol=2e-6)
    np.testing.assert_allclose([s.gyro_rad_s for s in samples], rate(t_s), atol=0.6 / 939)
    np.testing.assert_allclose([s.accel_m_s2 for s in samples], force(t_s), atol=1.1 / 417)
    assert len(samples) > 0.99 * PAYLOADS * TICKS / gopro.SECOND / GYRO_S
    assert all("outside the accelerometer's time" in kind for kind in recording.problems)


def test_a_camera_that_writes_both_kinds_of_fixes_has_the_better_ones(ride):
    kinds = zip(payloads(fixes="GPS5"), payloads(fixes="GPS9"), strict=True)
    both = [gopro.nest("DEVC", old[8:], new[8:]) for old, new in kinds]
    gopro.add_telemetry(ride, both, [TICKS] * PAYLOADS)
    telemetry = open_telemetry(ride)
    assert telemetry.fix_count == 50
    assert "50 GNSS samples, 35 with a fix in space" in telemetry.findings()[1].what


def test_without_stamps_a_line_through_the_counts_gives_the_times(ride):
    """HERO5 to 7: payloads are cut some samples sooner or later, which must not shake the stamps."""
    gopro.add_telemetry(ride, payloads(stamped=False), [TICKS] * PAYLOADS)
    rows = list(open_telemetry(ride).imu_rows(Problems()))
    t_s = np.array([t_ns for t_ns, _ in rows]) * 1e-9
    steps = np.diff(t_s)
    assert np.ptp(steps) < 2e-9
    np.testing.assert_allclose(steps.mean(), GYRO_S, rtol=2e-3)
    np.testing.assert_allclose(t_s, GYRO_S * np.arange(len(t_s)), atol=3 * GYRO_S)
    np.testing.assert_allclose(np.array([row for _, row in rows])[:, :3], rate(t_s), atol=0.01)


def test_stamps_of_another_unit_are_not_believed(ride):
    made = payloads()
    wrong = []
    for k, data in enumerate(made):
        at = data.index(b"STMPJ", data.index(b"ACCL"))  # of the gyroscope's stream
        wrong.append(data[: at + 8] + struct.pack(">Q", FIRST_US * 1000 + k * 1_001_000_000) + data[at + 16 :])
    gopro.add_telemetry(ride, wrong, [TICKS] * PAYLOADS)
    telemetry = open_telemetry(ride)
    rows = list(telemetry.imu_rows(Problems()))
    np.testing.assert_allclose(np.diff([t for t, _ in rows]).mean() * 1e-9, GYRO_S, rtol=2e-3)
    assert "stamped by the count of samples" in telemetry.findings()[0].what


def test_a_matrix_serves_where_no_order_is_told(ride):
    """HERO7's: stored as Y, -X, Z; its matrix gives Z, X, Y."""
    matrix = gopro.klv("MTRX", "f", 36, 1, struct.pack(">9f", 0, 0, 1, 0, -1, 0, 1, 0, 0))
    gopro.add_telemetry(ride, payloads("YxZ", told={}, extra=matrix), [TICKS] * PAYLOADS)
    rows = list(open_telemetry(ride).imu_rows(Problems()))
    t_s = np.array([t_ns for t_ns, _ in rows]) * 1e-9
    np.testing.assert_allclose(np.array([row for _, row in rows])[:, :3], rate(t_s), atol=0.6 / 939)


def test_units_are_converted_or_refused(ride):
    made = payloads(gyro="deg/s", accel="g")
    gopro.add_telemetry(ride, made, [TICKS] * PAYLOADS)
    rows = np.array([row for _, row in open_telemetry(ride).imu_rows(Problems())])
    assert rows[:, 2].mean() == pytest.approx(np.deg2rad(0.2), rel=0.02)
    assert rows[:, 5].mean() == pytest.approx(9.80665 * 9.81, rel=0.05)
    strange = gopro.write_video(ride.with_name("strange.MP4"), 20)
    gopro.add_telemetry(strange, payloads(gyro="furlongs"), [TICKS] * PAYLOADS)
    with pytest.raises(DataError, match=r"GYRO of its telemetry is in 'furlongs', rad/s or"):
        list(open_telemetry(strange).imu_rows(Problems()))


@pytest.mark.parametrize(("key", "good"), [("GPS5", 40), ("GPS9", 35)])
def test_fixes_become_readings_of_a_position_by_the_clock_of_the_film(ride, key, good):
    gopro.add_telemetry(ride, payloads(fixes=key), [TICKS] * PAYLOADS)
    (ride.parent / "cart.toml").write_text(
        f'[sensors.gnss]\nkind = "position"\nfile = "{ride.name}"\ngnss = {{single_m = 3.0}}\noffset_s = -0.5\n'
    )
    setup = load_sensor_setup(ride.parent / "cart.toml")
    file = setup.files["gnss"]
    assert file.format == "gpmf"
    readings = list(sensor_readings("gnss", setup.sensors["gnss"], file, Problems()))
    assert len(readings) == good
    place = local_frame(file).geodetic(readings[-1].values)
    t_s = readings[-1].t_ns * 1e-9 + 0.5
    assert t_s == pytest.approx(4 * TICKS / gopro.SECOND + 0.9, abs=0.11)
    np.testing.assert_allclose(
        [place.latitude_deg, place.longitude_deg], [42.4 + 1e-5 * t_s, -8.6 - 2e-5 * t_s], atol=3e-6
    )
    assert place.height_m == pytest.approx(34.0 + t_s, abs=0.11)
    assert np.sqrt(readings[-1].covariance[0, 0]) == pytest.approx(3.0 * 1.79, rel=1e-6)


def test_doctor_shows_imu_and_satellites(ride):
    gopro.add_telemetry(ride, payloads(fixes="GPS9"), [TICKS] * PAYLOADS)
    said = told(ride, "ok")
    assert "telemetry of HERO11 Black: gyroscope 399 Hz, accelerometer 202 Hz, stamped by the camera (STMP)" in said
    assert "telemetry: 50 GNSS samples, 35 with a fix in space" in said
    assert "specific force" in said and "every frame lies within the time of the IMU" in said
    ride.with_suffix(".imu.yaml").unlink()
    assert "IMU of the telemetry is not used: write its noise into GX010001.imu.yaml" in told(ride, "warning")
    assert open_dataset(str(ride)).imu_noise is None
    ride.with_suffix(".yaml").unlink()
    assert "GX010001.yaml is missing; write the calibration into it" in told(ride, "error")


def test_an_order_of_axes_that_nobody_tells_is_doubted(ride):
    gopro.add_telemetry(ride, payloads(told={}), [TICKS] * PAYLOADS)
    assert "gyroscope: the order of its axes is not stated (ORIN), HERO5's ZXY taken" in told(ride, "warning")
    named = gopro.write_video(ride.with_name("named.MP4"), 20)
    gopro.add_telemetry(named, payloads(told={"STNM": "Gyroscope (z,x,y)"}), [TICKS] * PAYLOADS)
    assert "ORIN" not in told(named, "warning")


def test_stamps_of_ones_own_put_the_telemetry_aside(ride):
    gopro.add_telemetry(ride, payloads(), [TICKS] * PAYLOADS)
    ride.with_suffix(".csv").write_text("timestamp\n" + "".join(f"{i * 50_000_000 + 7}\n" for i in range(100)))
    recording = open_dataset(str(ride))
    assert next(iter(recording.events())).t_ns == 7
    assert "and GX010001.csv stamps the frames by another" in told(ride, "warning")


def test_a_video_without_telemetry_is_stamped_by_its_own_table(ride):
    recording = open_dataset(str(ride))
    assert [event.t_ns for event in recording.events()] == [50_000_000 * i for i in range(100)]
    assert recording.imu_noise is None


def test_the_noise_of_a_camera_can_be_found_before_it_is_told(ride):
    gopro.add_telemetry(ride, payloads(), [TICKS] * PAYLOADS)
    ride.with_suffix(".imu.yaml").unlink()
    table = read_inertial(ride)
    np.testing.assert_allclose(table.values[:, :3], rate(table.t_ns * 1e-9), atol=0.6 / 939)
    assert table.period_s == pytest.approx(GYRO_S, rel=1e-4)


def edit(*entries: tuple[int, int]) -> bytes:
    rows = [struct.pack(">IiI", duration, begins, 1 << 16) for duration, begins in entries]
    return gopro.box("edts", gopro.full("elst", struct.pack(">I", len(rows)), *rows))


def test_an_edit_list_shifts_the_telemetry(ride):
    gopro.add_telemetry(ride, payloads(stamped=False), [TICKS] * PAYLOADS, edit((500, -1), (4000, 100)))
    track = next(track for track in read_tracks(ride) if track.format == "gpmd")
    assert track.shift_s == pytest.approx(0.5 - 0.1)  # a film of 1000 ticks a second
    first = next(iter(open_telemetry(ride).imu_rows(Problems())))[0]
    assert first * 1e-9 == pytest.approx(0.4, abs=3 * GYRO_S)


def test_frames_that_the_edit_list_cuts_off_are_left_out_and_composition_orders_them(tmp_path):
    stts, ctts = gopro.table("stts", [(6, 100)]), gopro.table("ctts", [(1, 200), (1, 400), (1, 100), (1, 0), (2, 200)])
    stbl = gopro.box(
        "stbl", gopro.full("stsd", struct.pack(">I", 1), gopro.box("avc1", bytes(8))), stts, ctts,
        gopro.table("stsc", [(1, 6, 1)]), gopro.full("stsz", struct.pack(">II", 1, 6)), gopro.table("stco", [(8,)]),
    )  # fmt: skip
    header = gopro.full("mdhd", struct.pack(">IIIIHH", 0, 0, 1000, 600, 0, 0))
    media = gopro.box("mdia", header, gopro.full("hdlr", b"mhlrvide", bytes(13)), gopro.box("minf", stbl))
    film = gopro.full("mvhd", struct.pack(">IIII", 0, 0, 1000, 600), bytes(80))
    path = tmp_path / "a.mp4"
    path.write_bytes(gopro.box("ftyp", b"mp42") + gopro.box("moov", film, gopro.box("trak", edit((600, 300)), media)))
    # shown at 200, 500, 300, 300, 600, 700 ticks, less 300
    assert frame_times_ns(path).tolist() == [0, 0, 200_000_000, 300_000_000, 400_000_000]


def hostile(path: Path, change) -> Path:
    path.write_bytes(change(path.read_bytes()))
    return path


@pytest.mark.parametrize(
    ("find", "put"),
    [
        (b"stsz" + bytes(8), b"stsz" + struct.pack(">II", 0, 1) + b"\x7f\xff\xff\xff"),
        (b"stts" + bytes(4), b"stts" + bytes(4) + b"\xff\xff\xff\xff"),
        (b"stco" + bytes(4), b"stco" + bytes(4) + b"\xff\xff\xff\xff"),
        (b"mdhd", b"mdhe"),
        (b"moov", b"moox"),
    ],
)
def test_counts_beyond_the_file_cost_no_memory(ride, find, put):
    gopro.add_telemetry(ride, payloads(), [TICKS] * PAYLOADS)

    def change(data: bytes) -> bytes:
        at = data.rindex(find)
        return data[:at] + put + data[at + len(put) :]

    hostile(ride, change)
    tracemalloc.start()
    with pytest.raises(DataError) as refused:
        open_dataset(str(ride)) if b"moox" in put else _all(ride)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 32 * 2**20
    assert "\n" not in str(refused.value)


def _all(path: Path) -> None:
    telemetry = open_telemetry(path)
    if telemetry is None:
        raise DataError("no telemetry")
    list(telemetry.imu_rows(Problems()))


def test_a_box_of_two_to_the_sixty_bytes_is_no_header(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(gopro.box("ftyp", b"mp41") + struct.pack(">I4sQ", 1, b"mdat", 2**60) + bytes(100))
    with pytest.raises(DataError, match="no MP4 header"):
        frame_times_ns(path)


def test_nests_without_end_are_left(tmp_path):
    data = b""
    for _ in range(3000):
        data = gopro.nest("DEVC", data) if len(data) < 200_000 else data
    streams, whole = read_streams(data)
    assert streams == [] and not whole


def test_a_cut_payload_keeps_what_came_before():
    data = payloads()[0]
    streams, whole = read_streams(data[: len(data) - 100])
    assert not whole and [list(stream.values)[-1] for stream in streams] == ["ACCL", "SCAL"]


SEED = payloads(fixes="GPS9")


@given(
    which=st.integers(0, PAYLOADS - 1),
    changes=st.lists(st.tuples(st.integers(0, 10_000), st.binary(min_size=1, max_size=8)), min_size=1, max_size=6),
    cut_at=st.integers(0, 10_000),
)
def test_damaged_payloads_are_read_or_left_out(tmp_path_factory, which, changes, cut_at):
    data = bytearray(SEED[which])
    for at, new in changes:
        begin = at % 400 if at % 3 else at % len(data)  # heads are at the beginning of streams
        data[begin : begin + len(new)] = new
    if cut_at % 4 == 0:
        del data[cut_at % len(data) :]
    path = tmp_path_factory.mktemp("damaged") / "GX.MP4"
    path.write_bytes(gopro.box("ftyp", b"mp41") + gopro.box("moov", gopro.full("mvhd", bytes(100))))
    gopro.add_telemetry(path, [*SEED[:which], bytes(data), *SEED[which + 1 :]], [TICKS] * PAYLOADS)
    try:
        telemetry = open_telemetry(path)
        assert telemetry is not None
        telemetry.findings()
        for problems in (Problems(), Problems()):
            rows = list(telemetry.imu_rows(problems)) if telemetry.has_imu else []
            assert all(np.isfinite(row).all() and len(row) == 6 for _, row in rows)
            list(telemetry.fixes(problems)) if telemetry.fix_count else None
    except VislamError as error:
        assert "\n" not in str(error)


@given(changes=st.lists(st.tuples(st.integers(0, 10_000), st.binary(min_size=1, max_size=8)), min_size=1, max_size=6))
def test_damaged_headers_are_read_or_refused(tmp_path_factory, changes):
    path = tmp_path_factory.mktemp("damaged") / "GX.MP4"
    path.write_bytes(gopro.box("ftyp", b"mp41") + gopro.box("moov", gopro.full("mvhd", bytes(100))))
    gopro.add_telemetry(path, SEED, [TICKS] * PAYLOADS)
    data = bytearray(path.read_bytes())
    header = data.rindex(b"moov")
    for at, new in changes:
        begin = header + at % (len(data) - header)
        data[begin : begin + len(new)] = new
    path.write_bytes(data)
    try:
        read_tracks(path)
        telemetry = open_telemetry(path)
        if telemetry is not None:
            telemetry.findings()
            list(telemetry.imu_rows(Problems())) if telemetry.has_imu else None
    except VislamError as error:
        assert "\n" not in str(error)


@given(data=st.binary(max_size=300))
def test_any_bytes_are_no_tree_without_end(data):
    read_streams(data)
    read_streams(b"DEVC\0\x01" + struct.pack(">H", len(data)) + data)
