"""An OAK against a stand-in for depthai 3: its rig, pairs, clock, faults, and where it is named."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from tests.hw.fake_depthai import World
from vislam import Config, open_dataset
from vislam.config import OakConfig, RecordConfig, SensorsConfig
from vislam.core.errors import DataError, HardwareError, UsageError
from vislam.core.messages import Frame
from vislam.hw.cameras.oak import OakStream
from vislam.hw.doctor import Wanted, examine
from vislam.hw.health import Health
from vislam.hw.library_cameras import factory_rig, open_frame_camera
from vislam.hw.sensors import check_devices
from vislam.live.sources import open_live
from vislam.run.record import record

LONG_S = 30.0
CAMERA = OakConfig(rate_hz=100.0, reopen_s=0.01, missing_s=30.0, start_s=30.0, position_m=(0.1, 0.0, 0.2))
SENSORS = replace(SensorsConfig(), oak=CAMERA)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    world = World()
    monkeypatch.setitem(sys.modules, "depthai", world.module())
    yield world
    assert all(device.closed for device in world.opened)


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_the_rig_is_that_of_the_factory(world: World) -> None:
    rig = factory_rig("oak", SENSORS)
    assert [camera.fx for camera in rig.cameras] == [400.0, 401.0]
    assert (rig.cameras[0].width, rig.cameras[0].height, rig.cameras[0].cy) == (640, 400, 200.0)
    assert (rig.cameras[0].distortion, rig.cameras[0].coefficients) == ("radtan", tuple(world.coeffs[:5]))
    assert rig.T_cam0_cam1[:3, 3] == pytest.approx([0.075, 0.0, 0.0])
    world.model, world.coeffs = "Fisheye", [0.1, 0.01, 0.0, 0.0]
    assert factory_rig("oak", SENSORS).cameras[1].distortion == "equidistant"


def test_a_rational_model_is_refused(world: World) -> None:
    world.coeffs[5] = 0.3
    with pytest.raises(DataError, match=r"of which vislam has the first 5; calibrate it.*--calibration\.camera"):
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
        left, right = stream._queues
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
        assert camera.read(LONG_S) is not None
        world.unplugged = True
        wait_for(lambda: camera.health() == Health.CAMERA_MISSING)
        wait_for(lambda: camera.counters().get("open_failures", 0) > 0)
        while camera.read(0.0) is not None:
            pass
        world.unplugged = False
        assert camera.read(LONG_S) is not None
        assert (camera.counters()["opened"], camera.counters()["lost"]) == (2, 1)


def test_missing_things_are_named(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vislam.hw.adafruit.check_driver", lambda name: None)
    with pytest.raises(UsageError, match="an OAK gives its stereo pair: write oak"):
        open_frame_camera("oak,depth", SENSORS)
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
    with pytest.raises(HardwareError, match=r"pip install 'vislam\[oak\]'"):
        open_frame_camera("oak", SENSORS, must_be_there=False)


def test_it_is_recorded_and_examined(world: World, tmp_path: Path) -> None:
    world.period_ns = 30_000_000
    settings = replace(SENSORS, oak=replace(CAMERA, rate_hz=33.0))
    record(tmp_path / "r", "none", "oak:1844", settings, RecordConfig(min_free_gb=0.0), seconds=0.5)
    assert world.opened[-1].info == "1844"
    recording = open_dataset(str(tmp_path / "r"))
    assert recording.rig.is_stereo
    assert any(isinstance(event, Frame) and len(event.images) == 2 for event in recording.events())
    said = [finding.what for finding in examine(Wanted(camera="oak"), 0.3).findings if finding.where == "oak"]
    assert any("by depthai's match of its clock" in what for what in said)
    assert any("has not met a real camera" in what for what in said)
