"""An OAK against a stand-in for depthai 3: its rig, pairs, clock, faults, and where it is named."""

import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.hw.fake_depthai import P_IMU_CAM_CM, R_IMU_CAM, World
from vislam import Config, open_dataset
from vislam.config import OakConfig, RecordConfig, SensorsConfig
from vislam.core.errors import DataError, HardwareError, UsageError
from vislam.core.messages import Frame, ImuSample
from vislam.hw.cameras.oak import OakStream
from vislam.hw.doctor import Wanted, examine
from vislam.hw.health import Health
from vislam.hw.library_cameras import factory_rig, open_frame_camera, open_with_imu
from vislam.hw.sensors import check_devices
from vislam.live.sources import open_live
from vislam.runs.record import record
from waiting import HUNG_S, Looks, until_it_holds, wait_for

CAMERA = OakConfig(rate_hz=100.0, reopen_s=0.01, missing_s=30.0, start_s=30.0, position_m=(0.1, 0.0, 0.2))
SENSORS = replace(SensorsConfig(), oak=CAMERA)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    world = World()
    monkeypatch.setitem(sys.modules, "depthai", world.module())
    yield world
    assert all(device.closed for device in world.opened)


def test_the_rig_is_that_of_the_factory(world: World) -> None:
    rig, _ = factory_rig("oak", SENSORS)
    assert [camera.fx for camera in rig.cameras] == [400.0, 401.0]
    assert (rig.cameras[0].width, rig.cameras[0].height, rig.cameras[0].cy) == (640, 400, 200.0)
    assert (rig.cameras[0].distortion, rig.cameras[0].coefficients) == ("radtan", tuple(world.coeffs[:5]))
    assert rig.T_cam0_cam1[:3, 3] == pytest.approx([0.075, 0.0, 0.0])
    world.model, world.coeffs = "Fisheye", [0.1, 0.01, 0.0, 0.0]
    assert factory_rig("oak", SENSORS)[0].cameras[1].distortion == "equidistant"


def test_a_rational_model_is_taken_and_a_tilted_sensor_refused(world: World) -> None:
    world.coeffs[5] = 0.3
    lens = factory_rig("oak", SENSORS)[0].cameras[0]
    assert (lens.distortion, lens.coefficients) == ("rational", tuple(world.coeffs[:8]))
    world.coeffs[12] = 0.01
    with pytest.raises(DataError, match=r"of which vislam has the first 8; calibrate it.*--calibration\.camera"):
        factory_rig("oak", SENSORS)


def test_a_size_of_another_shape_is_refused(world: World) -> None:
    with pytest.raises(DataError, match="for 1280x800, which is not the shape of 640x480; ask for 640x400"):
        factory_rig("oak", replace(SENSORS, oak=replace(CAMERA, height_px=480)))


def test_pairs_are_stamped_by_depthais_clock_put_on_the_hosts(world: World) -> None:
    with closing(OakStream(CAMERA)) as stream:
        pairs = [pair for _ in range(5) if (pair := stream.next()) is not None]
        assert all(pair.t_ns <= time.monotonic_ns() - world.age_ns for pair in pairs)
        assert all(a.t_ns < b.t_ns for a, b in pairwise(pairs))
        assert "in the middle of the exposure" in stream.stamped_by
        assert [image[0, 0] for image in pairs[0].images] == [10, 20]
        assert pairs[0].images[0].shape == (400, 640)
        world.age_ns = 10**13  # from another clock
        assert stream.next() is not None
        assert (stream.stamped_by, stream.bad_stamps) == ("arrival", 1)
    assert world.asked == {"CAM_B": (10_000, 400), "CAM_C": (10_000, 400)}


def test_an_image_without_a_partner_is_left_out(world: World) -> None:
    with closing(OakStream(CAMERA)) as stream:
        left, right = (world.queues[name] for name in ("CAM_B", "CAM_C"))
        world.lost.append(("CAM_C", left.number + 2))
        right.number = left.number
        gone = left.number + 2
        seen = []
        for _ in range(4):
            assert stream.next() is not None
            assert left.number == right.number  # in step, whatever was lost
            seen.append(left.number)
        assert seen == [gone - 1, gone + 1, gone + 2, gone + 3]


def test_a_device_that_is_pulled_out_comes_back(world: World) -> None:
    settings = replace(SENSORS, oak=replace(CAMERA, missing_s=0.05))
    with closing(open_frame_camera("oak", settings)) as camera:
        assert camera.read(HUNG_S) is not None
        world.unplugged = True
        wait_for(lambda: camera.health() == Health.CAMERA_MISSING)
        wait_for(lambda: camera.counters().get("open_failures", 0) > 0)
        while camera.read(0.0) is not None:
            pass
        world.unplugged = False
        assert camera.read(HUNG_S) is not None
        assert (camera.counters()["opened"], camera.counters()["lost"]) == (2, 1)


def test_missing_things_are_named(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vislam.hw.adafruit.check_driver", lambda name: None)
    with pytest.raises(UsageError, match="write oak for the stereo pair, oak,depth for colour and depth"):
        open_frame_camera("oak,colour", SENSORS)
    with pytest.raises(UsageError, match=r"oak\.position_m is not set"):
        open_live("gy85+oak", Config(), SensorsConfig())
    assert open_live("gy85+oak", Config(), SENSORS)[0].rig.is_stereo
    check_devices("bno085", "oak", SENSORS)
    world.unplugged = True
    with pytest.raises(HardwareError, match="there is no OAK"):
        check_devices("bno085", "oak", SENSORS)
    with pytest.raises(HardwareError, match=r"no OAK can be opened \(No available devices\)"):
        factory_rig("oak", SENSORS)
    old = world.module()
    del old.node.Camera  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "depthai", old)
    with pytest.raises(HardwareError, match="needs depthai 3"):
        open_frame_camera("oak", SENSORS)
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(HardwareError, match=r"pip install '\.\[oak\]'"):
        open_frame_camera("oak", SENSORS)


def test_it_is_recorded_and_examined(world: World, tmp_path: Path) -> None:
    world.period_ns = 30_000_000
    settings = replace(SENSORS, oak=replace(CAMERA, rate_hz=33.0))
    record(tmp_path / "r", "none", "oak:1844", settings, RecordConfig(min_free_gb=0.0), **until_it_holds(frames=9))
    assert world.opened[-1].info == "1844"
    recording = open_dataset(str(tmp_path / "r"))
    assert recording.rig.is_stereo
    assert any(isinstance(event, Frame) and len(event.images) == 2 for event in recording.events())
    said = [finding.what for finding in examine(Wanted(camera="oak"), 0.3, Looks()).findings if finding.where == "oak"]
    assert any("by depthai's match of its clock" in what for what in said)
    assert any("has not met a real camera" in what for what in said)


# ---- depth, and its IMU ---------------------------------------------------------------------------------------------

SLOW = replace(SENSORS, oak=replace(CAMERA, rate_hz=33.0, imu_silent_s=30.0))


@pytest.mark.parametrize("platform", ["RVC2", "RVC4"])
def test_colour_comes_with_depth_aligned_on_the_device(world: World, platform: str) -> None:
    world.platform = platform
    with closing(open_frame_camera("oak,depth", SENSORS)) as camera:
        frame = camera.read(HUNG_S)
    assert frame is not None
    assert frame.color is not None
    assert frame.depth_m is not None
    assert (frame.images[0][0, 0], frame.color.shape, len(frame.images)) == (90, (400, 640, 3), 1)
    assert frame.depth_m[0, 0] == pytest.approx(1.5)
    assert {("CAM_B", "stereo left"), ("CAM_C", "stereo right"), ("CAM_A", "sync color")} <= set(world.links)
    aligned = {
        "RVC2": {("CAM_A", "stereo align"), ("depth", "sync depth")},
        "RVC4": {("depth", "align in"), ("CAM_A", "align to"), ("aligned", "sync depth")},
    }
    assert aligned[platform] <= set(world.links)
    rig, _ = factory_rig("oak,depth", SENSORS)
    # images are freed of their distortion on the device, so that a rational model does not matter
    assert (rig.has_depth, rig.cameras[0].fx, rig.cameras[0].distortion) == (True, 450.0, "none")


def test_images_and_its_imu_are_put_on_the_host_by_one_offset(world: World) -> None:
    world.period_ns = 30_000_000
    camera, imu = open_with_imu("oak", SLOW)
    with closing(camera):
        samples = []
        while len(samples) < 100:
            new = imu.read(HUNG_S)
            assert new
            samples += new
        assert "which its images have too" in imu.stamped_by
        frame = camera.read(HUNG_S)
    assert frame is not None
    off_ns = []
    for sample in samples:
        true_ns = sample.t_ns - sample.t_ns % 10**12 + round(-sample.gyro_rad_s[1] * 1e9)
        off_ns.append(sample.t_ns - true_ns)
        assert sample.accel_m_s2[1] == pytest.approx(sample.gyro_rad_s[1])
        assert sample.accel_m_s2[2] == pytest.approx(9.81)
    assert np.ptp(off_ns) < 3_000  # depthai's microseconds
    taken_ns = (frame.t_ns - off_ns[0] - world.began_ns + world.age_ns) % world.period_ns
    assert min(taken_ns, world.period_ns - taken_ns) < 5_000
    assert world.asked["imu"] == ["accel", "gyro"]


def test_an_older_depthai_gives_what_its_imu_measured_as_it_is(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    world.is_calibrated = False
    monkeypatch.setitem(sys.modules, "depthai", world.module())
    camera, _ = open_with_imu("oak", SLOW)
    camera.close()
    assert world.asked["imu"] == ["accel raw", "gyro raw"]


def test_the_place_of_its_imu_is_the_factorys_or_has_to_be_told(world: World) -> None:
    rig, guesses = factory_rig("oak", SensorsConfig(), with_imu=True)
    assert guesses == ()
    p_cam = R_IMU_CAM.T @ np.array(P_IMU_CAM_CM) * 0.01
    assert rig.T_body_cams[0][:3, 3] == pytest.approx([p_cam[2], -p_cam[0], -p_cam[1]])
    world.imu_memory_is_empty = True
    assert "no extrinsics in its memory" in factory_rig("oak,depth", SensorsConfig(), with_imu=True)[1][0]
    world.knows_imu = False  # as most are
    _, guesses = factory_rig("oak", SensorsConfig(), with_imu=True)
    assert "no extrinsics in its memory" in guesses[0]
    axes = replace(CAMERA.calibration, gyro_axes=("z", "y", "-x"), accel_axes=("z", "y", "-x"))
    told = replace(SLOW, oak=replace(SLOW.oak, calibration=axes))
    with pytest.raises(UsageError, match=r"oak\.position_m is not set, and oak\.calibration"):
        open_live("oak+oak", Config(), SensorsConfig())
    assert factory_rig("oak", told, with_imu=True)[1] == ()
    source, _ = open_live("oak", Config(), told)
    assert source.rig.T_body_cams[0][:3, 3] == pytest.approx([0.1, 0.0, 0.2])
    source.close()
    camera, imu = open_with_imu("oak", told)
    with closing(camera):
        sample = imu.read(HUNG_S)[0]
    assert isinstance(sample, ImuSample)
    assert sample.accel_m_s2[2] == pytest.approx(9.81)
    assert sample.gyro_rad_s[1] == pytest.approx(sample.accel_m_s2[1])


def test_an_oak_without_an_imu_or_with_a_foreign_clock_says_so(world: World) -> None:
    settings = replace(SENSORS, oak=replace(SLOW.oak, start_s=0.5))
    world.imu = "NONE"
    with pytest.raises(HardwareError, match="this OAK has no IMU"):
        open_with_imu("oak", settings)
    world.imu, world.epoch_ns = "BMI270", 5_000_000_000
    camera, imu = open_with_imu("oak", SLOW)
    with closing(camera):
        world.epoch_ns = -(10**13)  # reports are of another clock from now on
        wait_for(lambda: imu.counters().get("bad_stamps", 0) > 0)


def test_a_device_with_its_imu_comes_back(world: World) -> None:
    settings = replace(SENSORS, oak=replace(SLOW.oak, missing_s=0.2, imu_silent_s=0.2))
    camera, imu = open_with_imu("oak", settings)
    with closing(camera):
        world.unplugged = True
        wait_for(lambda: Health.IMU_MISSING in imu.health() and camera.health() == Health.CAMERA_MISSING)
        wait_for(lambda: camera.counters().get("open_failures", 0) > 0)
        imu.read(0.0)
        world.unplugged = False
        assert imu.read(HUNG_S)
        assert imu.counters()["opened"] == 2


@pytest.mark.parametrize("name", ["oak", "oak,depth"])
def test_a_recording_holds_images_and_its_imu(world: World, tmp_path: Path, name: str) -> None:
    world.period_ns = 30_000_000
    record(tmp_path / "r", "oak", name, SLOW, RecordConfig(min_free_gb=0.0), **until_it_holds(frames=9, imu=40))
    recording = open_dataset(str(tmp_path / "r"))
    events = list(recording.events())
    frame = next(event for event in events if isinstance(event, Frame))
    assert (frame.depth_m is not None, recording.rig.has_depth) == ("depth" in name, "depth" in name)
    assert sum(isinstance(event, ImuSample) for event in events) > 20
    report = examine(Wanted(imu="oak", camera=name), 0.4, Looks())
    assert {timing.name for timing in report.timings} == {"oak: inertial", f"{name}: images"}
    assert any("which its images have too" in finding.what for finding in report.findings)
