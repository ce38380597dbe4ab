"""Chapters of a GoPro as one film: frames, IMU and fixes go on across the files, and what is missing is told."""

import random
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from vislam.core import Problems
from vislam.core.errors import UsageError, VislamError
from vislam.core.messages import Frame, ImuSample
from vislam.datasets import open_dataset, survey
from vislam.datasets.inspect import inspect
from vislam.datasets.loaders import VideoLoader
from vislam.datasets.sensor_files import sensor_readings
from vislam.datasets.telemetry import later_chapters, open_joined
from vislam.sensors.toml import load_sensor_setup
from worlds import gopro
from worlds.mini_recording import IMU_YAML, camera_yaml

FRAMES, RATE_HZ = 40, 20.0
LENGTH_S = FRAMES / RATE_HZ
BASE_US = 500_000_000
GYRO_S, ACCEL_S = 1 / 400.0, 1 / 200.0
NEW, OLD = ("GX010001.MP4", "GX020001.MP4", "GX030001.MP4"), ("GOPR0001.MP4", "GP010001.MP4", "GP020001.MP4")


def rate(t_s: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(t_s), 0.3 * t_s, np.cos(t_s)], axis=1)


def force(t_s: np.ndarray) -> np.ndarray:
    return np.stack([0.2 * t_s, np.sin(0.5 * t_s), 9.8 + 0.1 * t_s], axis=1)


def write_chapter(path: Path, number: int) -> Path:
    """Chapter `number` of a film: its frames of one grey that tells them apart, its samples by the film's time."""
    gopro.write_video(path, FRAMES, RATE_HZ)
    made = []
    for second in range(int(LENGTH_S)):
        begin_s = number * LENGTH_S + second
        streams = []
        for key, period_s, of, scale, unit in (
            ("ACCL", ACCEL_S, force, 417, "m/s\xb2"), ("GYRO", GYRO_S, rate, 939, "rad/s"),
        ):  # fmt: skip
            t_s = begin_s + period_s * np.arange(round(1.0 / period_s))
            total = round((second + 1) / period_s)
            stamp = BASE_US + round(begin_s * 1e6)
            streams.append(gopro.inertial(key, of(t_s), scale, total, stamp, ORIN="XYZ", SIUN=unit))
        shutter = gopro.klv("SHUT", "f", 4, 1, struct.pack(">f", 0.001))
        streams.append(gopro.nest("STRM", gopro.number("STMP", "J", BASE_US + round(begin_s * 1e6)), shutter))
        place = np.tile([47.0, 8.0, 400.0 + begin_s, 0.0, 0.0], (10, 1))
        streams.append(gopro.gps5(place, 3, 150))
        made.append(gopro.payload("HERO11 Black", *streams))
    return gopro.add_telemetry(path, made, [gopro.SECOND] * len(made))


@pytest.fixture(params=[NEW, OLD], ids=["new names", "old names"])
def film(request, tmp_path: Path) -> Path:
    for number, name in enumerate(request.param):
        write_chapter(tmp_path / name, number)
    first = tmp_path / request.param[0]
    first.with_suffix(".yaml").write_text(camera_yaml())
    first.with_suffix(".imu.yaml").write_text(IMU_YAML)
    return first


def told(source: str) -> str:
    return "\n".join(finding.what for finding in inspect(source).findings)


def test_chapters_are_one_recording(film: Path) -> None:
    recording = open_dataset(str(film))
    events = list(recording.events())
    frames = [event for event in events if isinstance(event, Frame)]
    assert [frame.t_ns for frame in frames] == [50_000_000 * i for i in range(3 * FRAMES)]
    greys = [float(frame.images[0].mean()) for frame in frames]
    alone = [float(f.images[0].mean()) for f in open_dataset(f"{film},chapters=one").events() if isinstance(f, Frame)]
    assert greys == 3 * alone
    samples = [event for event in events if isinstance(event, ImuSample)]
    t_s = np.array([sample.t_ns for sample in samples]) * 1e-9
    assert np.all(np.diff(t_s) == pytest.approx(GYRO_S, abs=3e-6))  # across the files as within them
    assert t_s[-1] > 3 * LENGTH_S - 0.01
    np.testing.assert_allclose([s.gyro_rad_s for s in samples], rate(t_s), atol=0.6 / 939 + 2e-5)
    np.testing.assert_allclose([s.accel_m_s2 for s in samples], force(t_s), atol=1.1 / 417 + 2e-5)
    assert all("outside the accelerometer's time" in kind for kind in recording.problems)
    later = [event for event in recording.events(from_ns=5_000_000_000) if isinstance(event, Frame)]
    assert [float(frame.images[0].mean()) for frame in later] == greys[100:]


def test_doctor_names_them_and_one_can_be_taken_alone(film: Path) -> None:
    assert f"3 chapters are one film: {film.name}, " in told(str(film))
    one = open_dataset(f"video:{film},chapters=one")
    assert one.frame_count == FRAMES
    assert "chapters" not in told(f"{film},chapters=one")
    with pytest.raises(UsageError, match="chapters"):
        survey(f"{film},chapters=two")
    with pytest.raises(UsageError, match="no option 'chapter'"):
        survey(f"{film},chapter=1")


def test_a_missing_chapter_ends_the_film_and_is_told(film: Path) -> None:
    second, third = later_chapters(film)[0]
    second.rename(second.with_suffix(".away"))
    assert f"{second.name} is missing, so {third.name} cannot be joined" in told(str(film))
    assert open_dataset(str(film)).frame_count == FRAMES


def test_a_later_chapter_alone_says_which_file_opens_all(film: Path) -> None:
    second = later_chapters(film)[0][0]
    second.with_suffix(".yaml").write_text(camera_yaml())
    assert f"it is chapter 2 of a recording; {film.name} opens all of it" in told(str(second))
    assert open_dataset(str(second)).frame_count == FRAMES


def test_a_chapter_that_is_cut_off_ends_the_film(film: Path) -> None:
    second = later_chapters(film)[0][0]
    second.write_bytes(second.read_bytes()[:2000])
    assert f"the film ends before {second.name}" in told(str(film))
    recording = open_dataset(str(film))
    assert recording.frame_count == FRAMES
    assert all(event.t_ns < LENGTH_S * 1e9 for event in recording.events())


def test_stamps_of_ones_own_are_those_of_one_file(film: Path) -> None:
    film.with_suffix(".csv").write_text("t_ns\n" + "".join(f"{i * 10_000_000}\n" for i in range(FRAMES)))
    film.with_suffix(".imu.yaml").unlink()
    assert open_dataset(str(film)).frame_count == FRAMES


def test_fixes_go_on_by_the_clock_of_the_film(film: Path, tmp_path: Path) -> None:
    file = tmp_path / "sensors.toml"
    datum = "gnss = {datum = [47.0, 8.0, 400.0]}"
    file.write_text(f'[sensors.gnss]\nkind = "position"\nfile = "{film}"\nformat = "gpmf"\n{datum}\n')
    setup = load_sensor_setup(file)
    readings = list(sensor_readings("gnss", setup.sensors["gnss"], setup.files["gnss"], Problems()))
    assert len(readings) == 60
    t_s = np.array([reading.t_ns for reading in readings]) * 1e-9
    assert np.all(np.diff(t_s) > 0.0)
    up_m = np.array([reading.values[2] for reading in readings])
    np.testing.assert_allclose(up_m, np.floor(t_s + 1e-6), atol=1e-2)


def test_a_chapter_with_fewer_frames_than_its_table_says_costs_its_own_only(film: Path) -> None:
    later = tuple((path, FRAMES + 5 + k * FRAMES) for k, path in enumerate(later_chapters(film)[0]))
    numbers = tuple(map(str, range(3 * FRAMES + 5)))
    with closing(VideoLoader(film, numbers, open_dataset(str(film)).rig.cameras[0], later)) as loader:
        loaded = [loader.load(i) for i in range(len(numbers))]
    assert [i for i, one in enumerate(loaded) if not one.images] == list(range(FRAMES, FRAMES + 5))


def test_damaged_later_chapters_are_read_or_left_out(film: Path) -> None:
    second, rng = later_chapters(film)[0][0], random.Random(20260101)
    whole = second.read_bytes()
    for _ in range(40):
        data = bytearray(whole)
        for _ in range(rng.randint(1, 12)):
            data[rng.randrange(len(data) - 6000, len(data))] = rng.randrange(256)
        second.write_bytes(data[: rng.choice([len(data), len(data) - rng.randrange(6000)])])
        try:
            found = survey(str(film))
            telemetry = open_joined(film)
            assert telemetry is not None
            for _ in telemetry.imu_rows(Problems()):
                pass
            assert len(found.cameras[0].t_ns) >= FRAMES
        except VislamError as error:
            assert "\n" not in str(error)
