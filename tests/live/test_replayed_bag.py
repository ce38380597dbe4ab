"""Bags played as if their sensors were plugged in: with what a bag lacks told, and without keeping what was played."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from vislam.config import SensorsConfig, load
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import ImuSample
from vislam.datasets import open_dataset
from vislam.live.replay import ReplaySource
from vislam.live.sources import open_live
from vislam.sensors import load_sensor_setup
from worlds.bag_writer import Message, Types, from_asl, types_of, write_bag
from worlds.mini_recording import BEGIN_NS, FRAME_NS, IMU_YAML, write_asl

FRAMES = 6


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_asl(tmp_path / "asl", frames=FRAMES)


@pytest.fixture
def bag(folder: Path, tmp_path: Path) -> Path:
    return write_bag(tmp_path, "mcap", from_asl(folder, types_of("mcap"))) / "drive.mcap"


@pytest.fixture
def noise(tmp_path: Path) -> str:
    path = tmp_path / "noise.yaml"
    path.write_text(IMU_YAML)
    return str(path)


def opened(source: str, **calibration: str) -> ReplaySource:
    told = {f"calibration.{name}": value for name, value in calibration.items()}
    live, _ = open_live(f"replay:{source}", load(None, told), SensorsConfig())
    assert isinstance(live, ReplaySource)
    return live


@pytest.fixture(autouse=True)
def begun_long_ago(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have all of a recording due at once, so that nothing depends on how fast this machine is."""
    monkeypatch.setattr("vislam.live.epoch._LEAD_NS", -3_600_000_000_000)


def test_a_bag_is_played_as_its_folder_is(bag: Path, folder: Path, noise: str) -> None:
    of_bag, of_folder = opened(str(bag), imu_noise=noise), opened(f"euroc:{folder}")
    assert of_bag.rig.cameras == of_folder.rig.cameras
    assert of_bag.imu_noise == of_folder.imu_noise
    assert of_bag.duration_s == of_folder.duration_s > 0.0
    samples = [source.inertial()().read(0.0) for source in (of_bag, of_folder)]
    theirs = [value for value in open_dataset(f"euroc:{folder}").events() if isinstance(value, ImuSample)]
    assert len(samples[0]) == len(samples[1]) == len(theirs)
    for mine, other in zip(samples[0], theirs, strict=True):
        assert mine.gyro_rad_s.tolist() == other.gyro_rad_s.tolist()
        assert mine.accel_m_s2.tolist() == other.accel_m_s2.tolist()
    frames = [source.cameras()() for source in (of_bag, of_folder)]
    newest = [played.read(0.0) for played in frames]
    assert newest[0].t_ns - samples[0][0].t_ns == newest[1].t_ns - samples[1][0].t_ns
    assert all(np.array_equal(a, b) for a, b in zip(newest[0].images, newest[1].images, strict=True))
    assert frames[0].counters() == {"captured": FRAMES, "dropped": FRAMES - 1}


def test_the_noise_beside_a_bag_is_enough(bag: Path) -> None:
    with pytest.raises(
        DataError, match=r"a bag does not state the noise of its IMU \(/imu0\); give --calibration.imu-noise"
    ):
        opened(str(bag))
    bag.with_name("drive.imu.yaml").write_text(IMU_YAML)
    assert opened(str(bag)).imu_noise == opened(f"bag:{bag}").imu_noise is not None


def test_topics_are_told_behind_a_bag(bag: Path, noise: str) -> None:
    assert len(opened(f"bag:{bag},cam0=/cam1/image_raw,cam1=none", imu_noise=noise).rig.cameras) == 1
    with pytest.raises(DataError, match="has no inertial data to play"):
        opened(f"bag:{bag},imu=none", imu_noise=noise)
    with pytest.raises(UsageError, match="leave the calibration files away"):
        opened("points:still", imu_noise=noise)


def test_the_clock_of_a_camera_s_file_holds_for_a_replay(bag: Path, noise: str, tmp_path: Path) -> None:
    chain = tmp_path / "chain.yaml"
    chain.write_text(
        "".join(
            f"cam{k}:\n  camera_model: pinhole\n  intrinsics: [50.0, 51.0, 31.5, 23.5]\n  distortion_model: none\n"
            "  resolution: [64, 48]\n  timeshift_cam_imu: 0.0125\n"
            for k in range(2)
        )
    )
    config = load(None, {"calibration.camera": str(chain), "calibration.imu_noise": noise})
    source, settings = open_live(f"replay:{bag}", config, SensorsConfig())
    assert settings.init.time_offset_s == 0.0125
    assert source.rig.cameras[0].distortion == "none"
    assert config.init.time_offset_s == 0.0


def test_readings_of_a_bag_are_played_beside_it(tmp_path: Path, noise: str, folder: Path) -> None:
    types = types_of("mcap")
    messages = list(from_asl(folder, types))
    for i in range(4):
        t_ns = BEGIN_NS + i * FRAME_NS
        messages.append(Message(t_ns, "/baro", pressure(types, t_ns, 101_325.0 - 12.0 * i)))
    bag = write_bag(tmp_path, "mcap", messages, name="baro") / "baro.mcap"
    file = tmp_path / "sensors.toml"
    file.write_text(f'[sensors.baro]\nkind = "height"\nfile = "{bag}"\ntopic = "/baro"\n')
    source = opened(str(bag), imu_noise=noise)
    played, readings = source.readings(load_sensor_setup(file))(), []
    while len(readings) < 4:
        readings += played.read()
    assert np.diff([reading.t_ns for reading in readings]).tolist() == [FRAME_NS] * 3
    assert readings[1].values[0] == pytest.approx(1.0, abs=0.01)


def pressure(types: Types, t_ns: int, pascal: float) -> object:
    header = types.header(t_ns, "imu")
    return types.make("sensor_msgs/msg/FluidPressure", header=header, fluid_pressure=pascal, variance=0.0)


def test_what_was_played_is_not_kept(tmp_path: Path) -> None:
    types = types_of("mcap")
    count, size = 100, (320, 240)
    K = np.array([[200.0, 0.0, 159.5], [0.0, 200.0, 119.5], [0.0, 0.0, 1.0]])
    pixels = np.arange(size[0] * size[1], dtype=np.uint32).astype(np.uint8).reshape(size[1], size[0])
    messages = [Message(BEGIN_NS, "/cam0/camera_info", types.info(BEGIN_NS, size, K, "plumb_bob", [0.0] * 5, "imu"))]
    for i in range(count):
        t_ns = BEGIN_NS + i * FRAME_NS
        messages.append(Message(t_ns, "/imu0", types.imu(t_ns, [0.0, 0.0, 0.0, 0.0, 0.0, 9.81])))
        messages.append(Message(t_ns, "/cam0/image_raw", types.image(t_ns, pixels, "mono8", "imu")))
    path = write_bag(tmp_path, "mcap", messages)
    path.with_name(f"{path.name}.imu.yaml").write_text(IMU_YAML)
    del messages
    tracemalloc.start()
    try:
        source = opened(str(path))
        frames = source.cameras()()
        assert frames.read(0.0) is not None
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert frames.counters()["captured"] == count
    assert peak < 40 * pixels.nbytes  # a few frames ahead and what modules take, never all
