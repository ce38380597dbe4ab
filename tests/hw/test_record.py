"""Recording of the emulated cart: what comes out is a recording, whatever ends it."""

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import BridgeClockConfig, Gy85Config, RecordConfig, SensorCalibration, SensorsConfig, SerialConfig
from vislam.core.errors import HardwareError, StorageError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.datasets import open_dataset
from vislam.datasets.recorder import Recorder
from vislam.hw.emulator import emulated_bus, emulated_gy85
from vislam.hw.emulator.bridge import BridgeEmulator, at_rest
from vislam.runs.record import Recorded, record
from waiting import HUNG_S, wait_for

WIDTH, HEIGHT = 320, 240
CONFIG = RecordConfig(min_free_gb=0.0)


@pytest.fixture
def tty(tmp_path: Path) -> Iterator[Path]:
    with BridgeEmulator(tmp_path / "tty", at_rest, drift=0.005) as board:
        yield board.path


@pytest.fixture
def sensors() -> SensorsConfig:
    clock = BridgeClockConfig(settle_s=0.2, bin_s=0.05)
    return SensorsConfig(serial=SerialConfig(start_s=HUNG_S, reopen_s=0.05, clock=clock))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wall that stands still, with the noise of a sensor."""
    path = tmp_path_factory.mktemp("video") / "wall.avi"
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8), (7, 7), 2.0)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (WIDTH, HEIGHT))
    for _ in range(40):
        noisy = wall.astype(np.int16) + rng.normal(0.0, 1.5, wall.shape).astype(np.int16)
        writer.write(np.clip(noisy, 0, 255).astype(np.uint8))
    writer.release()
    return path


def events_of(folder: Path) -> tuple[list[ImuSample], list[MagSample], list[Frame]]:
    recording = open_dataset(str(folder))
    events = list(recording.events())
    assert not any("gap" not in problem for problem in recording.problems), recording.problems
    kinds = (ImuSample, MagSample, Frame)
    imu, mag, frames = ([event for event in events if isinstance(event, kind)] for kind in kinds)
    return imu, mag, frames


def recorded_until(rows: dict[str, int], out: Path, *arguments: object) -> None:
    """Record until the tables of these sensors have so many rows, however long that takes."""
    stop = threading.Event()
    thread = threading.Thread(target=record, args=(out, *arguments, CONFIG), kwargs={"stop": stop})
    thread.start()
    try:
        wait_for(lambda: all(rows_in(out / "mav0" / name / "data.csv") >= count for name, count in rows.items()))
    finally:
        stop.set()
        thread.join(HUNG_S)


@pytest.mark.slow  # a whole run
def test_bridge_and_video_become_a_recording_that_runs(
    tty: Path, video: Path, sensors: SensorsConfig, tmp_path: Path
) -> None:
    recorded = record(tmp_path / "ride", f"serial:{tty}", str(video), sensors, CONFIG)
    assert recorded.ended == "the video is at its end"
    imu, mag, frames = events_of(tmp_path / "ride")
    assert len(frames) + recorded.dropped["images"] + recorded.dropped["images before the queue"] == 40
    assert len(imu) > 20  # of 800; on a busy machine the kernel's buffer runs over
    assert len(mag) > 2
    assert np.mean([sample.accel_m_s2 for sample in imu], axis=0) == pytest.approx([0.0, 0.0, 9.807], abs=0.05)
    begin, end = frames[0].t_ns, frames[-1].t_ns
    assert imu[0].t_ns < begin + 1e9  # one clock
    assert imu[-1].t_ns > end - 1e9
    assert frames[0].color is not None
    facts = json.loads((tmp_path / "ride" / "recording.json").read_text())
    assert facts["ended"] == recorded.ended
    assert facts["counts"]["imu samples"] == len(imu)
    assert facts["stamped_by"] == "the file"
    assert any("not calibrated" in note for note in facts["notes"])
    assert facts["bytes_written"] == pytest.approx(
        sum(p.stat().st_size for p in (tmp_path / "ride").rglob("*") if p.suffix in (".csv", ".jpg")), abs=1000
    )
    arguments = ["run", str(tmp_path / "ride"), "--out", str(tmp_path / "run"), "--view.no-enabled", "--map.no-enabled"]
    assert run_verb([*arguments, "--json"]) == 0
    assert (tmp_path / "run" / "trajectory_ekf.tum").stat().st_size > 0


def test_samples_are_raw_on_disk_and_calibrated_when_read(tty: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    known = SensorCalibration(
        gyro_axes=("y", "-x", "z"), gyro_bias_rad_s=(0.0, 0.0, 0.5), mag_bias_ut=(5.0, 0.0, 0.0),
        accel_matrix=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 2.0)),
    )  # fmt: skip
    sensors = replace(sensors, serial=replace(sensors.serial, calibration=known))
    (tmp_path / "imu.yaml").write_text(
        "update_rate: 400\ngyroscope_noise_density: 0.001\ngyroscope_random_walk: 0.00001\n"
        "accelerometer_noise_density: 0.01\naccelerometer_random_walk: 0.0001\n"
    )
    sensors = replace(sensors, calibration=replace(sensors.calibration, imu_noise=str(tmp_path / "imu.yaml")))
    recorded_until({"imu0": 150, "mag0": 5}, tmp_path / "r", f"serial:{tty}", "none", sensors)
    rows = np.loadtxt(tmp_path / "r" / "mav0" / "imu0" / "data.csv", delimiter=",")
    assert rows[:, 1:].mean(axis=0) == pytest.approx([0, 0, 0, 0, 0, 9.807], abs=0.05)
    # a recording without images is for calibration; with one, it can be read
    wall = tmp_path / "r" / "mav0" / "cam0"
    (wall / "data").mkdir(parents=True)
    t_ns = int(rows[10, 0])
    cv2.imwrite(str(wall / "data" / f"{t_ns}.png"), np.zeros((48, 64), np.uint8))
    (wall / "data.csv").write_text(f"#t,file\n{t_ns},{t_ns}.png\n")
    (wall / "sensor.yaml").write_text("resolution: [64, 48]\nintrinsics: [50, 50, 32, 24]\ncamera_model: pinhole\n")
    imu, mag, _ = events_of(tmp_path / "r")
    assert np.mean([s.gyro_rad_s for s in imu], axis=0) == pytest.approx([0.0, 0.0, -0.5], abs=0.01)
    assert np.mean([s.accel_m_s2 for s in imu], axis=0) == pytest.approx([0.0, 0.0, 19.61], abs=0.1)
    assert np.mean([s.field_ut for s in mag], axis=0) == pytest.approx([15.0, 0.0, -43.0], abs=0.5)
    assert open_dataset(str(tmp_path / "r")).imu_noise.accelerometer_noise_density == 0.01
    assert open_dataset(str(tmp_path / "r")).imu_noise.rate_hz == 400.0


def test_the_gy85_on_i2c_is_recorded_as_well(long_video: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    bus = emulated_gy85(at_rest, time.monotonic_ns, seed=1)
    sensors = replace(sensors, gy85=Gy85Config(self_test=False))
    with emulated_bus(bus):
        recorded_until({"imu0": 40, "cam0": 4}, tmp_path / "r", f"gy85:{bus.path}", str(long_video), sensors)
    imu, _, frames = events_of(tmp_path / "r")
    assert len(imu) > 20
    assert len(frames) > 2


def start_verb(tty: Path, video: Path, out: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "vislam", "record", "--out", str(out), "--imu", f"serial:{tty}"]
    command += ["--camera", str(video), "--min-free-gb", "0", "--serial.start-s", str(HUNG_S)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def rows_in(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


@pytest.fixture(scope="module")
def long_video(video: Path) -> Path:
    """Two minutes at 2 Hz: it does not end within a test."""
    path = video.with_name("long.avi")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 2.0, (64, 48))
    for i in range(240):
        writer.write(np.full((48, 64, 3), i, np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_whatever_ends_it_leaves_a_recording(tty: Path, long_video: Path, tmp_path: Path, number: int) -> None:
    out = tmp_path / "r"
    process = start_verb(tty, long_video, out)
    try:
        table = out / "mav0" / "cam0" / "data.csv"
        wait_for(lambda: rows_in(table) >= 3 or process.poll() is not None)
        wait_for(lambda: rows_in(out / "mav0" / "imu0" / "data.csv") >= 100 or process.poll() is not None)
        process.send_signal(number)
        stdout, stderr = process.communicate(timeout=HUNG_S)
    finally:
        process.kill()
    imu, _, frames = events_of(out)
    assert len(imu) >= 90
    assert len(frames) >= 2
    ended = json.loads((out / "recording.json").read_text())["ended"]
    if number == signal.SIGKILL:
        assert ended == ""
    else:
        assert process.returncode == 0, stderr
        assert ended == "stopped"
        assert "vislam doctor" in stdout


def test_a_slow_disk_drops_images_but_no_samples(
    tty: Path, video: Path, sensors: SensorsConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Recorder.write

    def slow(self: Recorder, value: ImuSample | MagSample | Frame) -> None:
        if isinstance(value, Frame):
            time.sleep(0.2)
        write(self, value)

    monkeypatch.setattr(Recorder, "write", slow)
    recorded = record(tmp_path / "r", f"serial:{tty}", str(video), sensors, replace(CONFIG, image_queue=2))
    assert sum(recorded.dropped.values()) > 5
    assert recorded.dropped["inertial samples"] == 0
    imu, _, frames = events_of(tmp_path / "r")
    assert len(frames) < 35
    assert len(imu) > 200


def test_at_full_speed_no_image_is_dropped(video: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    told: list[Recorded] = []
    recorded = record(
        tmp_path / "r", "none", str(video), sensors, replace(CONFIG, image_queue=1), in_real_time=False,
        progress=told.append,
    )  # fmt: skip
    _, _, frames = events_of(tmp_path / "r")
    assert len(frames) == 40
    assert np.diff([frame.t_ns for frame in frames]) == pytest.approx(50_000_000, abs=1000)
    assert told[-1] is recorded
    assert "40 frames" in recorded.line()


def test_stamps_beside_a_video_are_taken(video: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    copy = tmp_path / "ride.avi"
    copy.write_bytes(video.read_bytes())
    rows = [f"{5_000 + i * 33_000_000 + i % 2}" for i in range(12)]
    copy.with_suffix(".csv").write_text("\n".join(["#t", *rows]) + "\n")
    record(tmp_path / "r", "none", str(copy), sensors, CONFIG, in_real_time=False)
    _, _, frames = events_of(tmp_path / "r")
    assert [frame.t_ns - frames[0].t_ns for frame in frames] == [int(row) - 5_000 for row in rows]


def test_what_happens_in_the_streams_is_written_beside_them_and_told(sensors: SensorsConfig, tmp_path: Path) -> None:
    path, rng = tmp_path / "wall.avi", np.random.default_rng(3)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (WIDTH, HEIGHT))
    wall = cv2.resize(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8), (WIDTH, HEIGHT))
    for k in range(60):
        image = np.clip(wall + rng.normal(0.0, 3.0, wall.shape), 0, 255).astype(np.uint8)
        writer.write(np.zeros_like(wall) if 20 <= k < 30 else wall if 40 <= k < 45 else image)
    writer.release()
    path.with_suffix(".csv").write_text("#t\n" + "".join(f"{k * 50_000_000 + 10**10}\n" for k in range(60)))
    recorded = record(tmp_path / "r", "none", str(path), sensors, CONFIG, in_real_time=False)
    events = json.loads((tmp_path / "r" / "recording.json").read_text())["events"]
    found = [(e["stream"], e["happening"], e["from_s"], e["to_s"], e["done"]) for e in events]
    assert ("cam0", "dark", 1.0, 1.45, "written as it came") in found
    assert ("cam0", "repeated", 2.05, 2.2, "written as it came") in found
    assert any(
        "cam0: dark or blank images from 1.00 to 1.45 s (10); written as it came" in note for note in recorded.notes
    )


def test_a_budget_ends_it_in_time(video: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    recorded = record(
        tmp_path / "r", "none", str(video), sensors,
        replace(CONFIG, max_gb=2e-4, image_format="png", image_queue=4), in_real_time=False,
    )  # fmt: skip
    assert "--max-gb" in recorded.ended
    assert 2e5 <= recorded.bytes_written < 15e5  # what is queued is still written; the whole video would be 40e5
    assert len(events_of(tmp_path / "r")[2]) >= 1


def test_a_full_disk_is_told_and_leaves_what_was_written(video: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    table = tmp_path / "r" / "mav0" / "cam0" / "data.csv"
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))  # rows fit, images do not
        with pytest.raises(StorageError, match="cannot be written"):
            record(tmp_path / "r", "none", str(video), sensors, CONFIG, in_real_time=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert rows_in(table) == 1  # its header: the first image did not fit


def test_an_unplugged_imu_is_missed_and_comes_back(video: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    stop = threading.Event()
    with BridgeEmulator(tmp_path / "tty", at_rest) as board:
        result: list[Recorded] = []

        def work() -> None:
            result.append(record(tmp_path / "r", f"serial:{board.path}", "none", sensors, CONFIG, stop=stop))

        thread = threading.Thread(target=work)
        thread.start()
        table = tmp_path / "r" / "mav0" / "imu0" / "data.csv"
        wait_for(lambda: rows_in(table) > 50)
        board.unplug()
        time.sleep(0.3)
        before = rows_in(table)
        board.plug()
        wait_for(lambda: rows_in(table) > before + 50)
        stop.set()
        thread.join(HUNG_S)
    assert result[0].ended == "stopped"
    assert result[0].faults["imu"]["port_lost"] == 1
    facts = json.loads((tmp_path / "r" / "recording.json").read_text())
    assert "IMU_MISSING" in facts["health"]
    assert (np.diff(np.loadtxt(table, delimiter=",")[:, 0]) > 0).all()


def test_what_cannot_be_recorded_is_refused(video: Path, sensors: SensorsConfig, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to record"):
        record(tmp_path / "r", "none", "none", sensors, CONFIG)
    with pytest.raises(UsageError, match="no IMU called 'bmi160'"):
        record(tmp_path / "r", "bmi160", "none", sensors, CONFIG)
    with pytest.raises(HardwareError, match="there is no port"):
        record(tmp_path / "r", f"serial:{tmp_path / 'no'}", "none", sensors, CONFIG)
    with pytest.raises(StorageError, match="min-free-gb"):
        record(tmp_path / "r", "none", str(video), sensors, replace(CONFIG, min_free_gb=1e9))
    assert not (tmp_path / "r").exists()
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "old").touch()
    with pytest.raises(UsageError, match="already holds something"):
        record(tmp_path / "r", "none", str(video), sensors, CONFIG)
    camera = tmp_path / "camera.yaml"
    camera.write_text("resolution: [640, 480]\nintrinsics: [500, 500, 320, 240]\n")
    files = replace(sensors.calibration, camera=str(camera))
    with pytest.raises(UsageError, match="640x480, the camera gives 320x240"):
        record(tmp_path / "s", "none", str(video), replace(sensors, calibration=files), CONFIG)


def test_the_verb_reads_the_cart_from_a_file_and_exits_with_5_without_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cart = tmp_path / "cart.toml"
    cart.write_text('[serial]\nport = "/dev/serial/by-id/none"\nbaud = 1000000\n')
    assert run_verb(["record", "--config", str(cart), "--out", str(tmp_path / "r"), "--imu", "serial"]) == 5
    assert "/dev/serial/by-id/none" in capsys.readouterr().err
    cart.write_text("[serial]\nspeed = 3\n")
    assert run_verb(["record", "--config", str(cart), "--out", str(tmp_path / "r")]) == 2
    assert "no setting 'serial.speed'" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["cart.toml"]
