"""RealSense against a stand-in for pyrealsense2: its rig, its clock, its settings, faults, and where it is named."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.hw.fake_realsense import ANGLE, BASELINE_M, World
from vislam import Config, open_dataset
from vislam.config import RealsenseConfig, RecordConfig, SensorsConfig
from vislam.core.errors import DataError, HardwareError, UsageError
from vislam.core.messages import Frame
from vislam.hw.cameras.factory import factory_camera
from vislam.hw.doctor import Wanted, examine
from vislam.hw.health import Health
from vislam.hw.library_cameras import factory_rig, open_frame_camera
from vislam.hw.sensors import check_devices, is_video
from vislam.live.sources import open_live
from vislam.run.record import record

LONG_S = 30.0
CAMERA = RealsenseConfig(rate_hz=30.0, reopen_s=0.01, missing_s=30.0, start_s=30.0, position_m=(0.1, 0.0, 0.2))
SENSORS = replace(SensorsConfig(), realsense=CAMERA)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    world = World()
    monkeypatch.setitem(sys.modules, "pyrealsense2", world.module())
    yield world
    assert world.running == 0


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def first(camera: Any) -> Frame:
    frame = camera.read(LONG_S)
    assert frame is not None
    return frame


def test_the_rig_is_that_of_the_factory_where_the_settings_put_it(world: World) -> None:
    rig = factory_rig("realsense", SENSORS)
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
    down = factory_rig("realsense", replace(SENSORS, realsense=replace(CAMERA, tilt_deg=30.0)))
    assert down.T_body_cams[0][:3, 2] == pytest.approx([np.cos(np.pi / 6), 0.0, -0.5])
    with_depth = factory_rig("realsense:0123,depth", SENSORS)
    assert with_depth.has_depth
    assert len(with_depth.cameras) == 1
    assert world.serial == "0123"


@pytest.mark.parametrize("model", ["inverse_brown_conrady", "ftheta", "modified_brown_conrady"])
def test_a_distortion_that_vislam_has_not_is_refused_unless_it_is_none(world: World, model: str) -> None:
    world.model = model
    assert factory_rig("realsense,depth", SENSORS).cameras[0].distortion == "none"
    world.coeffs = [-0.05, 0.06, 0.0, 0.0, -0.02]
    with pytest.raises(DataError, match=f"distortion '{model}'.*--calibration.camera"):
        factory_rig("realsense,depth", SENSORS)


def test_brown_conrady_is_taken_over(world: World) -> None:
    world.coeffs = [-0.05, 0.06, 0.001, 0.002, -0.02]
    camera = factory_rig("realsense", SENSORS).cameras[0]
    assert (camera.distortion, camera.coefficients) == ("radtan", tuple(world.coeffs))
    with pytest.raises(DataError, match="radtan"):  # a rational model: k4 and more
        factory_camera((640, 480), (1.0, 1.0, 0.0, 0.0), "radtan", [0.1, 0, 0, 0, 0, 0.2])


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
    with pytest.raises(HardwareError, match=r"pip install 'vislam\[realsense\]'"):
        open_frame_camera("realsense", SENSORS, must_be_there=False)
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
    recorded = record(tmp_path / "r", "none", name, SensorsConfig(), RecordConfig(min_free_gb=0.0), seconds=1.0)
    assert any("position_m is not set" in note for note in recorded.notes)
    facts = json.loads((tmp_path / "r" / "recording.json").read_text())
    assert facts["stamped_by"] == "the device's clock, in the middle of the exposure"
    recording = open_dataset(str(tmp_path / "r"))
    frame = next(event for event in recording.events() if isinstance(event, Frame))
    assert len(frame.images) == (1 if "depth" in name else 2)
    assert (frame.depth_m is not None) == ("depth" in name)
    assert recording.rig.cameras[0].fx == 380.0


def test_doctor_says_where_stamps_come_from_and_their_jitter(world: World) -> None:
    report = examine(Wanted(camera="realsense"), 0.3)
    said = [finding.what for finding in report.findings if finding.where == "realsense"]
    assert "stamped by the device's clock, in the middle of the exposure" in said
    assert any("has not met a real camera" in what for what in said)
    (timing,) = [timing for timing in report.timings if timing.name == "realsense: images"]
    assert timing.jitter_ms is not None
