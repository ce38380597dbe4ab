"""RealSense against a stand-in for pyrealsense2: its rig, its clock, its settings, faults, and where it is named."""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.hw.fake_realsense import ANGLE, BASELINE_M, P_IMU_CAM, R_IMU_CAM, World
from vislam import Config, open_dataset
from vislam.config import RealsenseConfig, RecordConfig, SensorsConfig
from vislam.core.errors import DataError, HardwareError, UsageError
from vislam.core.messages import Frame, ImuSample
from vislam.hw.cameras.factory import factory_camera
from vislam.hw.doctor import Wanted, examine
from vislam.hw.health import Health
from vislam.hw.library_cameras import factory_rig, open_frame_camera, open_with_imu, reads_own_imu
from vislam.hw.sensors import check_devices, is_video, open_inertial
from vislam.live.sources import open_live
from vislam.runs.record import record
from waiting import HUNG_S, Looks, until_it_holds, wait_for

CAMERA = RealsenseConfig(rate_hz=30.0, reopen_s=0.01, missing_s=30.0, start_s=30.0, position_m=(0.1, 0.0, 0.2))
SENSORS = replace(SensorsConfig(), realsense=CAMERA)
UNPLACED = replace(SensorsConfig(), realsense=replace(CAMERA, position_m=None))


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    world = World()
    monkeypatch.setitem(sys.modules, "pyrealsense2", world.module())
    yield world
    assert world.running == 0


def first(camera: Any) -> Frame:
    frame = camera.read(HUNG_S)
    assert frame is not None
    return frame


def test_the_rig_is_that_of_the_factory_where_the_settings_put_it(world: World) -> None:
    rig, _ = factory_rig("realsense", SENSORS)
    assert [camera.distortion for camera in rig.cameras] == ["none", "none"]
    assert (rig.cameras[0].fx, rig.cameras[0].cy, rig.cameras[0].width) == (380.0, 239.5, 640)
    T = rig.T_cam0_cam1
    # a point of cam0 at the second camera's centre is its origin: R c + t = 0
    assert T[:3, 3] == pytest.approx([BASELINE_M * np.cos(ANGLE), 0.0, -BASELINE_M * np.sin(ANGLE)])
    assert T[0, 0] == pytest.approx(np.cos(ANGLE))
    ahead, right = rig.T_body_cams[0][:3, 2], rig.T_body_cams[0][:3, 0]
    assert ahead == pytest.approx([1.0, 0.0, 0.0])
    assert right == pytest.approx([0.0, -1.0, 0.0])
    assert rig.T_body_cams[0][:3, 3] == pytest.approx([0.1, 0.0, 0.2])
    down = factory_rig("realsense", replace(SENSORS, realsense=replace(CAMERA, tilt_deg=30.0)))[0]
    assert down.T_body_cams[0][:3, 2] == pytest.approx([np.cos(np.pi / 6), 0.0, -0.5])
    with_depth = factory_rig("realsense:0123,depth", SENSORS)[0]
    assert with_depth.has_depth
    assert len(with_depth.cameras) == 1
    assert world.serial == "0123"


@pytest.mark.parametrize("model", ["inverse_brown_conrady", "ftheta", "modified_brown_conrady"])
def test_a_distortion_that_vislam_has_not_is_refused_unless_it_is_none(world: World, model: str) -> None:
    world.model = model
    assert factory_rig("realsense,depth", SENSORS)[0].cameras[0].distortion == "none"
    world.coeffs = [-0.05, 0.06, 0.0, 0.0, -0.02]
    with pytest.raises(DataError, match=f"distortion '{model}'.*--calibration.camera"):
        factory_rig("realsense,depth", SENSORS)


def test_brown_conrady_is_taken_over(world: World) -> None:
    world.coeffs = [-0.05, 0.06, 0.001, 0.002, -0.02]
    camera = factory_rig("realsense", SENSORS)[0].cameras[0]
    assert (camera.distortion, camera.coefficients) == ("radtan", tuple(world.coeffs))
    lens = factory_camera((640, 480), (1.0, 1.0, 0.0, 0.0), "radtan", [0.1, 0, 0, 0, 0, 0.2])
    assert (lens.distortion, lens.coefficients) == ("rational", (0.1, 0, 0, 0, 0, 0.2, 0, 0))
    with pytest.raises(DataError, match="has the first 8"):  # thin prisms
        factory_camera((640, 480), (1.0, 1.0, 0.0, 0.0), "radtan", [0.1, 0, 0, 0, 0, 0, 0, 0, 0.2])


def test_a_stereo_pair_is_stamped_by_the_devices_clock(world: World) -> None:
    with closing(open_frame_camera("realsense", SENSORS)) as camera:
        frames = [first(camera) for _ in range(40)]
        assert camera.stamped_by == "the device's clock, in the middle of the exposure"
        assert [image[0, 0] for image in frames[0].images] == [10, 20]
        assert frames[0].images[0].shape == (480, 640)
        assert all(a.t_ns < b.t_ns and a.index < b.index for a, b in pairwise(frames))
        assert frames[-1].t_ns <= time.monotonic_ns() - round(CAMERA.delay_s * 1e9)
        assert camera.health() == Health(0)
        assert camera.counters()["unstamped"] > 0  # until the device's rate was known
    assert world.options["depth"] == {
        "emitter_enabled": 0.0, "global_time_enabled": 0.0, "enable_auto_exposure": 0.0, "exposure": 10_000.0,
    }  # fmt: skip


def test_colour_comes_with_depth_in_metres(world: World) -> None:
    with closing(open_frame_camera("realsense,depth", SENSORS)) as camera:
        frame = first(camera)
    assert frame.color is not None
    assert frame.depth_m is not None
    assert frame.depth_m[0, 0] == pytest.approx(1.5)
    assert frame.depth_m.dtype == np.float32
    assert len(frame.images) == 1
    assert frame.images[0][0, 0] == 100
    assert world.options["depth"]["emitter_enabled"] == 1.0
    assert world.options["color"]["exposure"] == pytest.approx(100.0)  # of 100 us


def test_other_clocks_are_told(world: World) -> None:
    world.metadata = False
    with closing(open_frame_camera("realsense", SENSORS)) as camera:
        first(camera)
        assert camera.stamped_by == "the device's clock, when readout began"
    world.domain = "system_time"
    with closing(open_frame_camera("realsense", SENSORS)) as camera:
        first(camera)
        assert camera.stamped_by == "arrival"
        assert camera.counters()["bad_stamps"] > 0


def test_a_device_that_is_pulled_out_comes_back(world: World) -> None:
    settings = replace(SENSORS, realsense=replace(CAMERA, missing_s=0.05))
    with closing(open_frame_camera("realsense", settings)) as camera:
        before = first(camera).t_ns
        world.unplugged = True
        wait_for(lambda: camera.health() == Health.CAMERA_MISSING)
        wait_for(lambda: camera.counters().get("open_failures", 0) > 0)
        while camera.read(0.0) is not None:
            pass
        world.unplugged = False
        assert first(camera).t_ns > before
        assert camera.counters()["opened"] == 2
        assert camera.counters()["lost"] == 1


def test_missing_things_are_named(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vislam.hw.adafruit.check_driver", lambda name: None)
    with pytest.raises(UsageError, match="realsense,depth for colour and depth"):
        open_frame_camera("realsense,colour", SENSORS)
    with pytest.raises(HardwareError, match=r"1920x1080 at 30 Hz.*ask for another size"):
        factory_rig("realsense", replace(SENSORS, realsense=replace(CAMERA, width_px=1920, height_px=1080)))
    world.unplugged = True
    with pytest.raises(HardwareError, match=r"No device connected.*USB 3"):
        check_devices("bno085", "realsense", SENSORS)
    with pytest.raises(HardwareError, match="No device connected"):
        open_frame_camera("realsense", SENSORS)
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(HardwareError, match=r"pip install '\.\[realsense\]'"):
        open_frame_camera("realsense", SENSORS)
    assert not is_video("realsense:1.2,depth")


def test_live_needs_to_know_where_it_sits(world: World, tmp_path: Path) -> None:
    source, _ = open_live("gy85+realsense", Config(), SENSORS)
    assert source.rig.is_stereo
    with closing(source.cameras()()) as frames:
        assert len(first(frames).images) == 2
    with pytest.raises(UsageError, match=r"realsense\.position_m is not set"):
        open_live("gy85+realsense", Config(), SensorsConfig())
    chain = tmp_path / "chain.yaml"
    entry = (
        "  camera_model: pinhole\n  intrinsics: [400, 400, 320, 240]\n  distortion_model: radtan\n"
        "  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [640, 480]\n"
        "  T_cam_imu: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]\n"
    )
    chain.write_text(f"cam0:\n{entry}")
    config = replace(Config(), calibration=replace(Config().calibration, camera=str(chain)))
    with pytest.raises(UsageError, match="has 1 cameras, realsense has 2"):
        open_live("gy85+realsense", config, SENSORS)
    assert open_live("gy85+realsense,depth", config, SENSORS)[0].rig.cameras[0].fx == 400.0
    chain.write_text(f"cam0:\n{entry}cam1:\n{entry}")
    assert open_live("gy85+realsense", config, SENSORS)[0].rig.is_stereo
    wide = replace(SENSORS, realsense=replace(CAMERA, width_px=848))
    with pytest.raises(UsageError, match="is for 640x480, realsense is asked for 848x480"):
        open_live("gy85+realsense", config, wide)


@pytest.mark.parametrize("name", ["realsense", "realsense,depth"])
def test_a_recording_holds_all_of_it(world: World, tmp_path: Path, name: str) -> None:
    world.period_s = 0.03
    recorded = record(tmp_path / "r", "none", name, UNPLACED, RecordConfig(min_free_gb=0.0), **until_it_holds(frames=9))
    assert any("position_m is not set" in note for note in recorded.notes)
    facts = json.loads((tmp_path / "r" / "recording.json").read_text())
    assert facts["stamped_by"] == "the device's clock, in the middle of the exposure"
    recording = open_dataset(str(tmp_path / "r"))
    frame = next(event for event in recording.events() if isinstance(event, Frame))
    assert len(frame.images) == (1 if "depth" in name else 2)
    assert (frame.depth_m is not None) == ("depth" in name)
    assert recording.rig.cameras[0].fx == 380.0


def test_doctor_says_where_stamps_come_from_and_their_jitter(world: World) -> None:
    report = examine(Wanted(camera="realsense"), 0.3, Looks())
    said = [finding.what for finding in report.findings if finding.where == "realsense"]
    assert "stamped by the device's clock, in the middle of the exposure" in said
    assert any("has not met a real camera" in what for what in said)
    (timing,) = [timing for timing in report.timings if timing.name == "realsense: images"]
    assert timing.jitter_ms is not None


# ---- its IMU --------------------------------------------------------------------------------------------------------

SLOW = replace(SENSORS, realsense=replace(CAMERA, rate_hz=30.0, imu_silent_s=30.0))


def told_ns(seconds: float, near_ns: int) -> int:
    """The true time that a value of the stand-in's ramp tells."""
    return near_ns - near_ns % 10**12 + round(seconds * 1e9)


def test_images_and_its_imu_are_stamped_by_one_clock(world: World) -> None:
    world.period_s = 1.0 / 30.0
    camera, imu = open_with_imu("realsense", SLOW)
    samples, frames = [], []
    with closing(camera):
        end = time.monotonic() + HUNG_S
        while len(frames) < 30 or len(samples) < 300:
            assert time.monotonic() < end
            samples += imu.read(0.02)
            if (frame := camera.read(0.0)) is not None:
                # which of the stand-in's images that is: the newest that can have come
                frames.append(frame)
        assert camera.stamped_by == "the device's clock, in the middle of the exposure, on one line with its IMU's"
        assert imu.stamped_by == "the device's clock, on a line under the arrivals of the gyro"
    t_ns = np.array([sample.t_ns for sample in samples])
    assert np.all(np.diff(t_ns) > 0)
    # the camera's x is to the right: the body's -y, whatever the IMU's axes are
    true_s = -np.array([sample.gyro_rad_s[1] for sample in samples])
    off_ns = t_ns - np.array([told_ns(s, t) for s, t in zip(true_s, t_ns, strict=True)])
    captured = np.array(sorted(world.captured_ns.values()))
    for frame in frames:
        nearest = captured[np.argmin(np.abs(captured - frame.t_ns))]
        own_off = frame.t_ns - nearest
        near = int(np.argmin(np.abs(t_ns - frame.t_ns)))
        if abs(int(t_ns[near]) - frame.t_ns) < 10_000_000:
            assert abs(own_off - int(off_ns[near])) < 50_000  # of one clock, however late this machine was
    # the accelerometer, at another rate, is taken to the gyro's stamps
    forces = -np.array([sample.accel_m_s2[1] for sample in samples])
    assert np.median(np.abs(forces - true_s)) < 1e-4
    assert samples[0].accel_m_s2[2] == pytest.approx(9.81)
    assert world.options["imu"] == {"enable_motion_correction": 1.0, "global_time_enabled": 0.0}
    assert imu.rate_hz == 200.0
    assert imu.counters()["samples"] >= 300


def test_the_body_is_its_imu_by_the_factorys_extrinsics(world: World) -> None:
    rig, guesses = factory_rig("realsense", SensorsConfig(), with_imu=True)
    assert guesses == ()  # it says where it is
    T = rig.T_body_cams[0]
    assert T[:3, 2] == pytest.approx([1.0, 0.0, 0.0])
    # of the camera in the IMU, turned with it until the camera looks ahead
    p_cam = R_IMU_CAM.T @ np.array(P_IMU_CAM)
    assert T[:3, 3] == pytest.approx([p_cam[2], -p_cam[0], -p_cam[1]])
    down, _ = factory_rig("realsense,depth", replace(SENSORS, realsense=replace(CAMERA, tilt_deg=30.0)), with_imu=True)
    assert down.T_body_cams[0][:3, 2] == pytest.approx([np.cos(np.pi / 6), 0.0, -0.5])
    assert np.linalg.norm(down.T_body_cams[0][:3, 3]) == pytest.approx(np.linalg.norm(P_IMU_CAM))


def test_what_its_imu_cannot_do_is_told(world: World) -> None:
    with pytest.raises(UsageError, match=r"inside a camera.*ask for the camera realsense"):
        open_inertial("realsense", SENSORS)
    with pytest.raises(UsageError, match="inside a camera"):
        reads_own_imu("realsense:1", "realsense:2")
    with pytest.raises(UsageError, match="write realsense for it"):
        reads_own_imu("realsense,depth", "realsense,depth")
    assert reads_own_imu("realsense", "realsense:2,depth")
    assert not reads_own_imu("gy85", "realsense")
    world.has_imu = False
    with pytest.raises(HardwareError, match="has no IMU"):
        open_with_imu("realsense", SLOW)
    with pytest.raises(HardwareError, match="has no IMU"):
        factory_rig("realsense", SENSORS, with_imu=True)


def test_an_imu_without_a_clock_is_stamped_by_arrival_and_says_so(world: World) -> None:
    world.imu_domain = "system_time"
    camera, imu = open_with_imu("realsense", SLOW)
    with closing(camera):
        assert imu.stamped_by == "arrival"
        assert imu.counters()["bad_stamps"] > 0
        assert len(imu.read(HUNG_S)) > 0


def test_images_by_another_clock_than_the_imus_are_told(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vislam.hw.cameras.realsense._SETTLE_NS", 0)
    world.imu_late_us = 500_000_000
    camera, _ = open_with_imu("realsense", SLOW)
    with closing(camera):
        assert first(camera).t_ns < time.monotonic_ns()
        assert camera.stamped_by == "the device's clock, in the middle of the exposure"
        assert camera.counters()["bad_stamps"] > 0


def test_a_set_that_lost_an_image_is_left_out(world: World) -> None:
    world.lost = set(range(0, 10**6, 2))
    world.period_s = 0.02
    camera, _ = open_with_imu("realsense", SLOW)
    with closing(camera):
        assert all(len(first(camera).images) == 2 for _ in range(5))
        assert camera.counters()["unstamped"] > 2


def test_a_device_with_its_imu_comes_back(world: World) -> None:
    settings = replace(SENSORS, realsense=replace(CAMERA, missing_s=0.2, imu_silent_s=0.2))
    camera, imu = open_with_imu("realsense", settings)
    with closing(camera):
        wait_for(lambda: imu.health() == Health(0))
        before = imu.read(HUNG_S)[-1].t_ns
        world.unplugged = True
        wait_for(lambda: Health.IMU_MISSING in imu.health() and camera.health() == Health.CAMERA_MISSING)
        wait_for(lambda: camera.counters().get("open_failures", 0) > 0)
        imu.read(0.0)
        world.unplugged = False
        after = imu.read(HUNG_S)
        assert after[0].t_ns > before
        wait_for(lambda: camera.health() == Health(0))
        assert imu.counters()["opened"] == 2
        assert Health.IMU_GAP in imu.health()


@pytest.mark.parametrize("name", ["realsense", "realsense,depth"])
def test_a_recording_holds_images_and_its_imu(world: World, tmp_path: Path, name: str) -> None:
    world.period_s = 0.03
    recorded = record(
        tmp_path / "r", "realsense", name, UNPLACED, RecordConfig(min_free_gb=0.0), **until_it_holds(frames=9, imu=40)
    )
    assert any("stamped by the device's clock" in note for note in recorded.notes)
    assert not any("position_m" in note for note in recorded.notes)
    recording = open_dataset(str(tmp_path / "r"))
    events = list(recording.events())
    samples = [event for event in events if isinstance(event, ImuSample)]
    assert len(samples) > 20
    assert any(isinstance(event, Frame) for event in events)
    assert recording.rig.T_body_cams[0][:3, 2] == pytest.approx([1.0, 0.0, 0.0])
    assert samples[0].accel_m_s2[2] == pytest.approx(9.81)
    assert {"imu", "camera"} <= set(recorded.faults)


def test_doctor_measures_both(world: World) -> None:
    report = examine(Wanted(imu="realsense", camera="realsense,depth"), 0.5, Looks(), sensors=SENSORS)
    said = [finding.what for finding in report.findings]
    assert "stamped by the device's clock, on a line under the arrivals of the gyro" in said
    assert any(what.endswith("on one line with its IMU's") for what in said)
    assert sum("has not met a real" in what for what in said) == 2
    jitters = {timing.name: timing.jitter_ms for timing in report.timings}
    assert jitters.keys() == {"realsense: inertial", "realsense,depth: images"}
    assert None not in jitters.values()
