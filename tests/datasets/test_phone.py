"""What apps on phones write, in folders made from their published descriptions."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.calibration.inertial.tables import read_inertial
from vislam.core import Problems
from vislam.core.errors import DataError, VislamError
from vislam.core.messages import Frame, ImuSample
from vislam.datasets import open_dataset, survey
from vislam.datasets.imu_pairs import paired
from vislam.datasets.inspect import inspect
from vislam.datasets.sensor_files import local_frame, sensor_readings
from vislam.sensors.toml import load_sensor_setup
from worlds import gopro
from worlds.mini_recording import IMU_YAML, camera_yaml, picture

BEGIN_NS = 1_718_030_736_000_000_000
FRAMES, FRAME_NS = 40, 50_000_000
GYRO_NS, ACCEL_NS = 10_000_000, 9_700_000
COUNT = 210
METADATA = (
    "version,device name,recording epoch time,recording time,recording timezone,platform,appVersion,device id,sensors,"
    "sampleRateMs,standardisation,platform version\n"
    '3,"A phone, mine",1718030736000,2024-06-10,Europe/Berlin,{platform},1.33.0,abc,Gravity,10,{standard},17\n'
)


def rate(t_s):
    return np.stack([0.1 * np.sin(t_s), 0.2 * np.cos(t_s), 0.3 + 0 * t_s], axis=1)


def force(t_s):
    return np.stack([0.5 * t_s, -0.2 * t_s, 9.81 + 0.1 * t_s], axis=1)  # straight: interpolation is exact


def times(step_ns: int, late_ns: int = 0) -> np.ndarray:
    return BEGIN_NS - 20_000_000 + late_ns + step_ns * np.arange(COUNT)


def since_begin(t_ns) -> np.ndarray:
    return (np.asarray(t_ns) - BEGIN_NS) * 1e-9


def calibrated(folder: Path) -> Path:
    (folder / "camera.yaml").write_text(camera_yaml())
    (folder / "imu.yaml").write_text(IMU_YAML.replace("200", "100"))
    return folder


def axes(path: Path, t_ns: np.ndarray, values: np.ndarray) -> None:
    """A table of Sensor Logger, its axes in their reversed order."""
    lines = [
        f"{t},{(t - BEGIN_NS) * 1e-9},{z!r},{y!r},{x!r}" for t, (x, y, z) in zip(t_ns, values.tolist(), strict=True)
    ]
    path.write_text("time,seconds_elapsed,z,y,x\n" + "\n".join(lines) + "\n")


def sensor_logger(folder: Path, kind: str) -> Path:
    """A recording on Android, on an iPhone, or with its frames standardised."""
    gyro_ns, accel_ns = times(GYRO_NS), times(ACCEL_NS, 1_234_567)
    axes(folder / "Gyroscope.csv", gyro_ns, rate(since_begin(gyro_ns)))
    forces = force(since_begin(accel_ns))
    if kind == "android":
        axes(folder / "TotalAcceleration.csv", accel_ns, forces)
        axes(folder / "Accelerometer.csv", accel_ns, forces - [0, 0, 9.81])
    else:
        sign = -1.0 if kind == "ios" else 1.0
        up = np.tile([0.0, 0.0, 9.80665], (COUNT, 1))
        axes(folder / "Accelerometer.csv", accel_ns, sign * (forces - up))
        axes(folder / "Gravity.csv", accel_ns, sign * up)
    platform, standard = ("android", "false") if kind == "android" else ("ios", str(kind != "ios").lower())
    (folder / "Metadata.csv").write_text(METADATA.format(platform=platform, standard=standard))
    (folder / "Camera").mkdir()
    gopro.write_video(folder / "Camera" / "1718030736000.mp4", FRAMES)
    stamps = "".join(f"{BEGIN_NS + i * FRAME_NS}\n" for i in range(FRAMES))
    (folder / "Camera" / "1718030736000.csv").write_text("time\n" + stamps)
    return calibrated(folder)


def mars(folder: Path, kind: str) -> Path:
    t_ns = times(GYRO_NS)
    values = np.hstack([rate(since_begin(t_ns)), force(since_begin(t_ns))]).tolist()
    names = "gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2]"
    if kind == "android":
        head = f"Timestamp[nanosec],{names},Unix time[nanosec]\n"
        rows = [f"{t},{','.join(map(repr, row))},{t // 10**6}000000" for t, row in zip(t_ns, values, strict=True)]
        stamps = [f"{BEGIN_NS + i * FRAME_NS}" for i in range(FRAMES)]
        (folder / "frame_timestamps.txt").write_text("\n".join(["Frame timestamp[nanosec]", *stamps]) + "\n")
        (folder / "movie_metadata.csv").write_text("Timestamp[nanosec],fx[px]\n1,2\n")
    else:
        head = "#Recording starts at Mon_06_10_2024\nTimestamp[sec], " + names.replace(",", ", ") + "\n"
        rows = [f"{seconds(t)}, {', '.join(map(repr, row))}" for t, row in zip(t_ns, values, strict=True)]
        stamps = [f"{BEGIN_NS + i * FRAME_NS}, 1000.5, 1000.5, 320, 240, 8000000" for i in range(FRAMES)]
        named = "Timestamp[nanosec], fx[px], fy[px], cx[px], cy[px], exposure duration[nanosec]"
        (folder / "movie_metadata.csv").write_text("\n".join([named, *stamps]) + "\n")
    (folder / "gyro_accel.csv").write_text(head + "\n".join(rows) + "\n")
    gopro.write_video(folder / "movie.mp4", FRAMES)
    return calibrated(folder)


def seconds(t_ns: int) -> str:
    return f"{t_ns // 10**9}.{t_ns % 10**9:09d}"


def advio(folder: Path, kind: str) -> Path:
    gyro_ns, accel_ns = times(GYRO_NS), times(ACCEL_NS, 1_234_567)
    scale = 9.80665 if kind == "g" else 1.0
    forces = force(since_begin(accel_ns)) / scale
    for name, t_ns, values in (
        ("gyro.csv" if kind == "g" else "gyroscope.csv", gyro_ns, rate(since_begin(gyro_ns))),
        ("accelerometer.csv", accel_ns, forces),
    ):
        rows = [f"{seconds(t)},{','.join(map(repr, row))}" for t, row in zip(t_ns, values.tolist(), strict=True)]
        (folder / name).write_text("\n".join(rows) + "\n")
    stamps = [f"{seconds(BEGIN_NS + i * FRAME_NS)},{i + 1}" for i in range(FRAMES)]
    (folder / "frames.csv").write_text("\n".join(stamps) + "\n")
    gopro.write_video(folder / "frames.mov", FRAMES)
    return calibrated(folder)


MAKERS = [
    (sensor_logger, "android"), (sensor_logger, "ios"), (sensor_logger, "standardised"),
    (mars, "android"), (mars, "ios"), (advio, "g"), (advio, "m/s^2"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "kind"), MAKERS)
@pytest.mark.parametrize("scheme", ["", "phone:"])
def test_every_logger_gives_the_same_motion(tmp_path, make, kind, scheme):
    recording = open_dataset(f"{scheme}{make(tmp_path, kind)}")
    events = list(recording.events())
    assert [event.t_ns for event in events if isinstance(event, Frame)] == [
        BEGIN_NS + i * FRAME_NS for i in range(FRAMES)
    ]
    samples = [event for event in events if isinstance(event, ImuSample)]
    assert {sample.t_ns for sample in samples} <= {*times(GYRO_NS).tolist()}
    assert len(samples) > 200
    t_s = since_begin([sample.t_ns for sample in samples])
    np.testing.assert_allclose([sample.gyro_rad_s for sample in samples], rate(t_s), atol=1e-9)
    np.testing.assert_allclose([sample.accel_m_s2 for sample in samples], force(t_s), atol=1e-6)


@pytest.mark.parametrize(
    ("make", "kind", "said"),
    [
        (sensor_logger, "android", "Sensor Logger on android: TotalAcceleration.csv is interpolated at the stamps of"),
        (sensor_logger, "ios", "Accelerometer.csv and Gravity.csv are added, negated as it is Apple's"),
        (mars, "ios", "MARS logger: forces were interpolated"),
        (advio, "g", "is taken as g, as its description states"),
        (advio, "m/s^2", "is taken as m/s^2, though its description states g"),
    ],
)
def test_doctor_says_what_was_made_of_the_tables(tmp_path, make, kind, said):
    found = inspect(str(make(tmp_path, kind)))
    assert found.format == "phone"
    assert any(said in finding.what for finding in found.findings if finding.severity == "ok")
    assert found.worst != "error", found.findings
    assert {stream.name for stream in found.streams} == {"cam0", "imu0"}


def test_a_phone_that_records_in_g_is_doubted_in_one_line(tmp_path):
    folder = sensor_logger(tmp_path, "android")
    axes(folder / "TotalAcceleration.csv", times(ACCEL_NS), force(since_begin(times(ACCEL_NS))) / 9.80665)
    errors = [finding for finding in inspect(str(folder)).findings if finding.severity == "error"]
    assert len(errors) == 1 and "the unit seems to be g" in errors[0].what


def test_images_are_stamped_by_their_names(tmp_path):
    folder = sensor_logger(tmp_path, "android")
    for file in (folder / "Camera").iterdir():
        file.unlink()
    for i in range(5):
        cv2.imwrite(str(folder / "Camera" / f"{BEGIN_NS // 10**6 + 200 * i}.jpg"), picture(i, color=True))
    frames = [event.t_ns for event in open_dataset(str(folder)).events() if isinstance(event, Frame)]
    assert frames == [BEGIN_NS + 200_000_000 * i for i in range(5)]


@pytest.mark.parametrize(
    ("make", "kind", "missing", "told"),
    [
        (
            sensor_logger,
            "ios",
            "Gravity.csv",
            "is without gravity, and there is no Gravity.csv to add; record the sensor",
        ),
        (
            sensor_logger,
            "ios",
            "Metadata.csv",
            "does not say the platform, on which the sign of Accelerometer.csv depends",
        ),
        (sensor_logger, "ios", "Accelerometer.csv", "neither TotalAcceleration.csv nor Accelerometer.csv"),
        (sensor_logger, "ios", "Camera/1718030736000.csv", "1718030736000.csv is missing; write one row a frame"),
        (sensor_logger, "ios", "Camera/1718030736000.mp4", "holds no film and no image named by its time"),
        (mars, "android", "movie.mp4", "movie.mp4 is missing; copy it from the phone"),
        (mars, "ios", "movie_metadata.csv", "frame_timestamps.txt is missing; copy it from the phone"),
        (advio, "g", "camera.yaml", "camera.yaml is missing; write the calibration into it: T_BS"),
        (advio, "g", "imu.yaml", "imu.yaml is missing; write the noise of the IMU into it"),
    ],
)
def test_what_is_missing_is_named_with_the_next_step(tmp_path, make, kind, missing, told):
    folder = make(tmp_path, kind)
    (folder / missing).unlink()
    with pytest.raises(DataError) as refused:
        open_dataset(str(folder))
    assert told in str(refused.value) and "\n" not in str(refused.value)
    assert any(told in finding.what for finding in inspect(str(folder)).findings if finding.severity == "error")


def test_a_stamp_without_a_unit_is_refused(tmp_path):
    folder = mars(tmp_path, "android")
    path = folder / "gyro_accel.csv"
    path.write_text(path.read_text().replace("Timestamp[nanosec]", "Timestamp"))
    with pytest.raises(DataError, match=r"unit of the stamps is not stated in 'Timestamp'; \[nanosec\] or \[sec\]"):
        open_dataset(str(folder))


def test_several_films_are_not_guessed_among(tmp_path):
    folder = sensor_logger(tmp_path, "android")
    (folder / "Camera" / "2.mp4").touch()
    with pytest.raises(DataError, match="holds 2 films"):
        open_dataset(str(folder))


def test_a_folder_with_other_columns_is_no_phones(tmp_path):
    (tmp_path / "Gyroscope.csv").write_text("t,a,b,c\n1,2,3,4\n")
    with pytest.raises(DataError, match=r"no recording that vislam knows: .*Gyroscope.csv of Sensor Logger"):
        survey(str(tmp_path))


def rows(t_ns, values):
    return iter([(int(t), [float(v)] * 3) for t, v in zip(t_ns, values, strict=True)])


def test_pairs_are_made_within_the_time_of_both_and_never_across_a_gap():
    problems = Problems()
    ms = 1_000_000
    gyro = np.arange(0, 500, 10) * ms
    accel = np.r_[np.arange(45, 200, 10), np.arange(405, 460, 10)] * ms
    made = list(paired(rows(gyro, gyro), rows(accel, accel), problems, "ride"))
    assert [t // ms for t, _ in made] == [*range(50, 200, 10), *range(410, 460, 10)]
    assert all(row == pytest.approx([t] * 6) for t, row in made)
    assert sorted(problems.values()) == [9, 21]
    assert list(paired(rows([5], [5]), rows([], []), problems, "ride")) == []


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    made = {}
    for make, kind in MAKERS[:1] + MAKERS[4:6]:
        folder = make(tmp_path_factory.mktemp("seed"), kind)
        made[make.__name__] = {
            path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*.*")) if path.is_file()
        }
    return made


@given(
    maker=st.sampled_from(["sensor_logger", "mars", "advio"]),
    which=st.integers(0, 20),
    changes=st.lists(st.tuples(st.integers(0, 10_000), st.binary(min_size=1, max_size=8)), min_size=1, max_size=6),
    cut=st.integers(0, 10_000),
)
def test_damaged_folders_are_read_or_refused_in_one_line(tmp_path_factory, seeds, maker, which, changes, cut):
    folder = tmp_path_factory.mktemp("damaged")
    files = seeds[maker]
    tables = [path for path in files if path.suffix in (".csv", ".txt")]
    hit = tables[which % len(tables)]
    for path, content in files.items():
        data = bytearray(content)
        if path == hit:
            for at, new in changes:
                begin = at % 120 if at % 2 else at % len(data)
                data[begin : begin + len(new)] = new
            if cut % 3 == 0:
                del data[cut % len(data) :]
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_bytes(data)
    try:
        found = survey(str(folder))
        assert all("\n" not in str(error) for error in found.errors)
        read = list(found.imu_rows(Problems()))
        assert all(np.isfinite(row).all() for _, row in read)
    except VislamError as error:
        assert "\n" not in str(error)


def test_the_noise_of_a_phone_can_be_found_before_it_is_told(tmp_path):
    folder = sensor_logger(tmp_path, "android")
    (folder / "imu.yaml").unlink()
    table = read_inertial(folder)
    np.testing.assert_allclose(table.values[:, 3:], force(since_begin(table.t_ns)), atol=1e-6)


def test_the_location_of_a_phone_is_a_receivers(tmp_path):
    header = (
        "time,seconds_elapsed,bearingAccuracy,verticalAccuracy,horizontalAccuracy,bearing,altitude,longitude,latitude"
    )
    rows = [f"{BEGIN_NS + i * 10**9},{i},0,3.0,{4.0 if i != 2 else -1},0,400.0,8.0,{47.0 + i * 1e-5}" for i in range(5)]
    (tmp_path / "Location.csv").write_text("\n".join([header, *rows]) + "\n")
    (tmp_path / "cart.toml").write_text('[sensors.gnss]\nkind = "position"\nfile = "Location.csv"\n')
    setup = load_sensor_setup(tmp_path / "cart.toml")
    file, problems = setup.files["gnss"], Problems()
    readings = list(sensor_readings("gnss", setup.sensors["gnss"], file, problems))
    assert [r.t_ns for r in readings] == [BEGIN_NS + i * 10**9 for i in (0, 1, 3, 4)]
    assert readings[-1].values == pytest.approx([0.0, 4e-5 * 111_174.0, 0.0], abs=0.01)
    sigma = 4.0 / np.sqrt(-2.0 * np.log(0.32))
    assert np.sqrt(np.diag(readings[0].covariance)) == pytest.approx([sigma, sigma, 3.0])
    assert local_frame(file).datum.latitude_deg == 47.0
    (tmp_path / "Location.csv").write_text(header.replace("altitude", "height") + "\n")
    with pytest.raises(DataError, match="no column altitude"):
        list(sensor_readings("gnss", setup.sensors["gnss"], file, problems))
