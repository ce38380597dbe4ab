"""The Raspberry Pi's camera against a stand-in for picamera2: stamps, settings, faults, and where it is named."""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from tests.hw.fake_picamera2 import World
from vislam.config import PicamConfig, RecordConfig, SensorsConfig
from vislam.core.errors import HardwareError
from vislam.hw.cameras.picam import PicamStream
from vislam.hw.doctor import Wanted, examine
from vislam.hw.health import Health
from vislam.hw.library_cameras import is_library_camera, open_image_camera
from vislam.hw.sensors import check_devices, is_video, open_camera
from vislam.runs.record import record
from waiting import HUNG_S, Looks, until_it_holds, wait_for

CONFIG = PicamConfig(rate_hz=100.0, reopen_s=0.01, missing_s=30.0, start_s=30.0)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    world = World()
    monkeypatch.setitem(sys.modules, "picamera2", world.module())
    yield world
    assert world.unreleased == 0
    assert all(camera.closed for camera in world.opened)


def test_images_are_stamped_in_the_middle_of_the_exposure(world: World) -> None:
    with closing(PicamStream(CONFIG)) as stream:
        before = time.monotonic_ns()
        shot = stream.next()
        after = time.monotonic_ns()
        assert shot is not None
        # the sensor's stamp is `age` old, and the first line was exposed for 10 ms before it
        assert before - world.age_ns - 5_000_000 <= shot.t_ns <= after - world.age_ns - 5_000_000
        assert stream.stamped_by == "the sensor's first line, less half the exposure"
        assert shot.image.shape == (480, 640, 3)
        assert shot.image[0, 0].tolist() == [200, 0, 0]
        world.metadata = {}
        assert stream.next() is not None
        assert "exposure is unknown" in stream.stamped_by


def test_a_clock_that_counts_sleep_is_known_by_the_age_of_its_stamps(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept_ns = 3600_000_000_000
    world.offset_ns = slept_ns
    real = time.clock_gettime_ns

    def clock_ns(which: int) -> int:
        return time.monotonic_ns() + slept_ns if which == time.CLOCK_BOOTTIME else real(which)

    monkeypatch.setattr(time, "clock_gettime_ns", clock_ns)
    with closing(PicamStream(CONFIG)) as stream:
        before = time.monotonic_ns()
        shot = stream.next()
        assert shot is not None
        assert before - 25_000_000 <= shot.t_ns <= time.monotonic_ns() - 25_000_000
        assert "since boot" in stream.stamped_by


def test_a_stamp_of_no_known_clock_counts_and_the_last_age_is_used(world: World) -> None:
    with closing(PicamStream(CONFIG)) as stream:
        assert stream.next() is not None
        world.offset_ns = -(10**13)
        shot = stream.next()
        assert shot is not None
        assert shot.t_ns <= time.monotonic_ns() - 25_000_000  # as old as the one before was
        assert (stream.stamped_by, stream.bad_stamps) == ("arrival", 1)


def test_exposure_gain_and_focus_are_fixed_before_the_first_image(world: World) -> None:
    with closing(open_image_camera("picam", SensorsConfig(picam=replace(CONFIG, gain=2.5)))) as camera:
        shots = [shot for _ in range(5) if (shot := camera.read(HUNG_S)) is not None]
        asked = world.opened[0].config
        assert asked["controls"] == {
            "FrameDurationLimits": (10_000, 10_000), "AeEnable": False, "ExposureTime": 10_000, "AnalogueGain": 2.5,
            "AfMode": 0, "LensPosition": 0.0,
        }  # fmt: skip
        assert not any(setting.differs for setting in camera.settings)
        assert all(a.t_ns < b.t_ns and a.index < b.index for a, b in pairwise(shots))
        assert camera.health() == Health(0)
        assert camera.counters()["captured"] >= 5


def test_what_the_camera_lacks_is_told(world: World) -> None:
    world.has_autofocus, world.largest = False, (320, 240)
    with closing(open_image_camera("picam", SensorsConfig(picam=CONFIG))) as camera:
        differing = {setting.name: setting.got for setting in camera.settings if setting.differs}
        assert differing == {"width [px]": 320.0, "height [px]": 240.0, "AfMode": None, "LensPosition": None}
        report = examine(Wanted(camera="picam"), 0.3, Looks())
    said = "\n".join(f.what for f in report.findings)
    assert "LensPosition: asked 0.0, the camera does not offer it" in said
    assert "stamped by the sensor's first line" in said
    assert "has not met a real camera" in said
    (timing,) = [timing for timing in report.timings if timing.name == "picam:0: images"]
    assert timing.jitter_ms is not None


def test_a_first_image_that_is_late_is_waited_for(world: World) -> None:
    world.late = 3
    with closing(open_image_camera("picam", SensorsConfig(picam=CONFIG))) as camera:
        assert camera.read(HUNG_S) is not None
        assert camera.counters()["lost"] == 3


def test_a_cable_that_comes_loose_is_reported_and_the_camera_opened_again(world: World) -> None:
    with closing(open_image_camera("picam", SensorsConfig(picam=replace(CONFIG, missing_s=0.05)))) as camera:
        wait_for(lambda: camera.counters().get("captured", 0) > 3)
        world.unplugged = True
        wait_for(lambda: camera.health() == Health.CAMERA_MISSING)
        wait_for(lambda: camera.counters().get("open_failures", 0) > 0)
        assert world.opened[0].flushed
        world.unplugged = False
        before = camera.counters()["captured"]
        wait_for(lambda: camera.counters()["captured"] > before)
        counts = camera.counters()
        assert counts["lost"] >= 1
        assert counts["opened"] == 2


def test_missing_things_are_named(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(SensorsConfig(), picam=CONFIG)
    with pytest.raises(HardwareError, match=r"no camera picam:3; libcamera finds: imx708\. Check its ribbon cable"):
        open_camera("picam:3", config)
    with pytest.raises(HardwareError, match="no camera picam:3"):
        check_devices("serial", "picam:3", replace(config, serial=replace(config.serial, port="/dev/null")))
    with pytest.raises(HardwareError, match="give its number, as picam:0"):
        open_camera("picam:front", config)
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(HardwareError, match=r"pip install '\.\[pi\]'"):
        open_camera("picam", config)
    assert is_library_camera("picam:1")
    assert not is_video("picam:1")
    assert not is_library_camera("/dev/video0")


def test_it_can_be_recorded(world: World, tmp_path: Path) -> None:
    config = replace(SensorsConfig(), picam=CONFIG)
    recorded = record(
        tmp_path / "r", "none", "picam", config, RecordConfig(min_free_gb=0.0), **until_it_holds(frames=9)
    )
    assert recorded.counts["frames"] > 0
    facts = json.loads((tmp_path / "r" / "recording.json").read_text())
    assert facts["stamped_by"] == "the sensor's first line, less half the exposure"
    assert facts["camera_settings"][0] == {"name": "width [px]", "asked": 640.0, "got": 640.0}
