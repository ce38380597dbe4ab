"""The webcam against an imitation of OpenCV's `VideoCapture` with every fault, and against video files."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.config import WebcamConfig
from vislam.core.errors import HardwareError
from vislam.hw.cameras.mailbox import Mailbox
from vislam.hw.cameras.video import VideoCamera
from vislam.hw.cameras.webcam import Webcam, _Stamper
from vislam.hw.health import Health
from vislam.hw.source import CapturedImage
from waiting import HUNG_S, wait_for
from worlds.capture import AGE_NS, FakeCapture


@pytest.fixture
def config(tmp_path: Path) -> WebcamConfig:
    device = tmp_path / "video0"
    device.touch()
    return WebcamConfig(device=str(device), missing_s=0.2, reopen_s=0.02, start_s=HUNG_S)


def test_settings_are_set_and_read_back(config: WebcamConfig) -> None:
    fake = FakeCapture()
    camera = Webcam(replace(config, width_px=1280, height_px=600, exposure_s=0.00512), open_capture=lambda _: fake)
    camera.close()
    assert fake.closed
    assert fake.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1.0
    assert fake.values[cv2.CAP_PROP_EXPOSURE] == 51.0
    assert fake.values[cv2.CAP_PROP_BUFFERSIZE] == 2
    settings = {setting.name: setting for setting in camera.settings}
    assert settings["exposure [s]"].got == pytest.approx(0.0051)
    assert not settings["exposure [s]"].differs
    assert (settings["width [px]"].asked, settings["width [px]"].got) == (1280.0, 800.0)
    assert {name for name, setting in settings.items() if setting.differs} == {"width [px]", "autofocus", "focus"}
    assert settings["focus"].got is None
    assert settings["format"].got == "MJPG"


@pytest.mark.parametrize(
    ("clock", "source"),
    [
        (time.monotonic_ns, "driver"),
        (time.time_ns, "driver, wall clock"),
        (lambda: AGE_NS, "arrival"),  # a driver that stamps with 0
        (lambda: time.monotonic_ns() - 10**12, "arrival"),
    ],
)
def test_stamps_are_those_of_capture(config: WebcamConfig, clock: Callable[[], int], source: str) -> None:
    camera = Webcam(replace(config, delay_s=AGE_NS * 1e-9), open_capture=lambda _: FakeCapture(clock))
    images = [camera.read(HUNG_S) for _ in range(12)]
    now = time.monotonic_ns()
    camera.close()
    stamps = [image.t_ns for image in images if image is not None]
    assert camera.stamped_by == source
    assert len(stamps) == 12
    assert all(b > a for a, b in pairwise(stamps))
    assert stamps[-1] < now - AGE_NS
    assert camera.counters()["bad_stamps"] == 0


def test_one_absurd_stamp_takes_the_usual_age(config: WebcamConfig) -> None:
    absurd = threading.Event()
    fake = FakeCapture(lambda: 12345 if absurd.is_set() else time.monotonic_ns())
    camera = Webcam(config, open_capture=lambda _: fake)
    wait_for(lambda: camera.counters()["captured"] > 8)
    absurd.set()
    wait_for(lambda: camera.counters()["bad_stamps"] > 3)
    image = camera.read(HUNG_S)
    camera.close()
    assert camera.stamped_by == "driver"
    assert image is not None
    assert time.monotonic_ns() - HUNG_S * 1e9 < image.t_ns <= time.monotonic_ns() - AGE_NS


def test_the_newest_image_wins_and_the_others_are_counted(config: WebcamConfig) -> None:
    fake = FakeCapture()
    camera = Webcam(config, open_capture=lambda _: fake)
    wait_for(lambda: camera.counters()["captured"] > 20)
    first, second = camera.read(HUNG_S), camera.read(HUNG_S)
    assert first is not None
    assert second is not None
    assert first.index >= 19
    assert second.index > first.index
    assert first.image[0, 0, 0] == first.index + 1
    assert camera.counters()["replaced"] >= 19
    camera.close()


def test_a_camera_that_goes_away_comes_back(config: WebcamConfig) -> None:
    devices = [FakeCapture()]
    camera = Webcam(config, open_capture=lambda _: devices[-1])
    wait_for(lambda: camera.health() == Health(0))
    Path(config.device).unlink()
    devices[0].unplugged = True
    wait_for(lambda: camera.counters().get("open_failures", 0) > 1)
    wait_for(lambda: camera.health() == Health.CAMERA_MISSING)
    assert "there is no camera" in camera.problem
    assert devices[0].closed
    while camera.read(0.01) is not None:
        pass
    assert camera.read(0.05) is None
    devices.append(FakeCapture())
    Path(config.device).touch()
    image = camera.read(HUNG_S)
    assert image is not None
    assert camera.problem == ""
    counts = camera.counters()
    assert (counts["lost"], counts["opened"]) == (1, 2)
    camera.close()
    camera.close()


def test_a_driver_that_hangs_holds_nobody(config: WebcamConfig) -> None:
    fake = FakeCapture()
    camera = Webcam(config, open_capture=lambda _: fake)
    fake.hang.clear()
    wait_for(lambda: camera.health() == Health.CAMERA_MISSING)
    while camera.read(0.02) is not None:
        pass
    assert camera.read(0.02) is None
    camera.close()  # gives up on the thread
    fake.hang.set()
    wait_for(lambda: fake.closed)


def test_damaged_images_and_another_size_are_counted_and_left_out(config: WebcamConfig) -> None:
    fake = FakeCapture()
    camera = Webcam(config, open_capture=lambda _: fake)
    fake.damaged = True
    wait_for(lambda: camera.counters().get("undecodable", 0) > 2)
    fake.damaged, fake.size = False, (320, 240)
    wait_for(lambda: camera.counters().get("wrong_size", 0) > 2)
    fake.size = None
    while camera.read(0.0) is not None:
        pass
    image = camera.read(HUNG_S)
    assert image is not None
    assert image.image.shape == (480, 640, 3)
    camera.close()


def test_what_keeps_a_camera_from_opening_is_said(config: WebcamConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(HardwareError, match=r"there is no camera /dev/video97; there are: "):
        Webcam(replace(config, device="97"))
    with pytest.raises(HardwareError, match="cannot be opened as a camera"):
        Webcam(config)  # a file that is no device, by the real OpenCV
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(HardwareError, match="usermod -aG video"):
        Webcam(config)


def test_a_camera_without_images_is_an_error_in_time(config: WebcamConfig) -> None:
    fake = FakeCapture()
    fake.damaged = True
    with pytest.raises(HardwareError, match=r"gives no image within 0.3 s"):
        Webcam(replace(config, start_s=0.3), open_capture=lambda _: fake)


def write_video(path: Path, count: int, rate_hz: float) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, (64, 48))
    assert writer.isOpened()
    for i in range(count):
        writer.write(np.full((48, 64, 3), 8 * i, np.uint8))
    writer.release()


def test_a_video_stands_in_by_its_own_stamps(tmp_path: Path) -> None:
    write_video(tmp_path / "ride.avi", 12, 25.0)
    before = time.monotonic_ns()
    camera = VideoCamera(tmp_path / "ride.avi")
    images: list[CapturedImage] = []
    while not camera.is_finished or not images:
        image = camera.read(0.2)
        if image is not None:
            assert time.monotonic_ns() >= image.t_ns  # never before its time
            images.append(image)
    last = camera.read(0.0)
    images += [] if last is None else [last]
    assert camera.health() == Health.CAMERA_MISSING
    assert camera.read(0.01) is None
    camera.close()
    begin_ns = images[0].t_ns - images[0].index * 40_000_000
    assert begin_ns >= before
    for image in images:
        assert image.t_ns - begin_ns == pytest.approx(image.index * 40_000_000, abs=1000)
        assert int(image.image.mean()) == pytest.approx(8 * image.index, abs=3)
    counts = camera.counters()
    assert counts["captured"] == 12
    assert counts["captured"] - counts["replaced"] == len(images)


def test_at_full_speed_every_image_waits_for_its_reader(tmp_path: Path) -> None:
    write_video(tmp_path / "ride.avi", 30, 10.0)
    stamps = [7_000_000_000 + i * 100_000_000 + i % 3 for i in range(28)]
    begin = time.monotonic_ns()
    camera = VideoCamera(tmp_path / "ride.avi", stamps, in_real_time=False)
    images = []
    while len(images) < 28:
        image = camera.read(HUNG_S)
        assert image is not None
        images.append(image)
    wait_for(lambda: camera.is_finished)
    camera.close()
    assert [image.index for image in images] == list(range(28))
    assert [image.t_ns - images[0].t_ns for image in images] == [stamp - stamps[0] for stamp in stamps]
    assert images[0].t_ns >= begin
    assert camera.counters()["replaced"] == 0


def test_a_video_may_be_closed_at_any_time(tmp_path: Path) -> None:
    write_video(tmp_path / "slow.avi", 5, 0.1)
    camera = VideoCamera(tmp_path / "slow.avi")
    assert camera.read(HUNG_S) is not None
    camera.close()
    camera.close()
    assert camera.read(HUNG_S) is None  # nobody waits for a closed one


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="there is no video"):
        VideoCamera(tmp_path / "none.mp4")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(HardwareError, match="cannot be read as a video"):
        VideoCamera(tmp_path / "text.mp4")


def test_a_mailbox_gives_each_image_once() -> None:
    mailbox = Mailbox()
    assert mailbox.take(0.0) is None
    for i in range(3):
        mailbox.put(CapturedImage(i, i, np.zeros((2, 2), np.uint8)))
    assert not mailbox.wait_until_empty(0.0)
    newest = mailbox.take(0.0)
    assert newest is not None
    assert newest.index == 2
    assert mailbox.replaced == 2
    assert mailbox.take(0.0) is None
    assert mailbox.wait_until_empty(0.0)


@pytest.mark.parametrize("drift", [0.02, -0.02])
def test_a_camera_s_own_clock_is_put_on_the_host_s(config: WebcamConfig, drift: float) -> None:
    """Its rate is off by 2 %, and images arrive late by whatever the host is busy with: stamps still keep time."""
    rng, stamper = np.random.default_rng(4), _Stamper(replace(config, delay_s=0.03))
    true_ns = 50_000_000_000_000 + np.arange(900) * 1_000_000_000 // 30
    arrivals = true_ns + 30_000_000 + np.round(rng.exponential(4e6, len(true_ns))).astype(np.int64)
    own_ms = 1e3 + (true_ns - true_ns[0]) * (1.0 + drift) * 1e-6
    stamps = np.array([
        stamper.stamp(own, int(arrival), 10**18) for own, arrival in zip(own_ms, arrivals, strict=True)
    ])  # fmt: skip
    off_ms = (stamps - true_ns)[90:] * 1e-6
    print(f"off by {off_ms.mean():.2f} ms, at most {np.abs(off_ms).max():.2f}; arrivals scatter by 4 ms")
    assert stamper.source == "driver, clock of its own"
    assert np.abs(off_ms).max() < 1.5 and off_ms.std() < 0.4
