"""A live run on a camera with the IMU inside it: a stand-in for the library that moves, is unplugged and comes back."""

import json
import os
import socket
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_runs import left_behind

from vislam.config import Config, RealsenseConfig, SensorsConfig, load
from vislam.core.errors import HardwareError, UsageError
from vislam.core.messages import Frame, ImuSample
from vislam.hw.health import Health
from vislam.live.handed_frames import FrameHander, HandedFrames
from vislam.live.handed_imu import HandedImu, ImuHander
from vislam.live.run_live import LiveRun
from vislam.live.sources import open_live
from vislam.runs.folder import prepare
from waiting import HUNG_S

AMPLITUDE_M, PERIOD_S = 0.25, 3.0
CAMERA = RealsenseConfig(rate_hz=15.0, reopen_s=0.1, start_s=60.0)
SENSORS = replace(SensorsConfig(), realsense=CAMERA)

# the module that processes of the run import: the camera goes to and fro in front of a wall, once it is told to
STAND_IN = """
import sys
from pathlib import Path
from tests.live.moving_realsense import MovingWorld
module = MovingWorld(Path(__file__).parent).module()
sys.modules[__name__] = module
"""


def settings(name: str) -> Config:
    off = {"view.enabled": False, "map.enabled": False, "live.send_to": ()}
    return load(None, {**off, "live.name": f"vislam-test-{name}-{os.getpid()}"})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "library"
    folder.mkdir()
    (folder / "pyrealsense2.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    yield folder
    sys.modules.pop("pyrealsense2", None)


class Drive:
    """What is done to the device, as the run goes on; says when all was seen."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.steps, self.end = folder, ["go", "unplug", "missing", "back"], time.monotonic() + HUNG_S
        self.samples = self.revision = 0

    def __call__(self, run: LiveRun) -> None:
        status = run.notes.get("fast", {}).get("status") or {}
        word = Health(status.get("health", 0))
        samples, revision = status.get("samples", 0), status.get("map_revision", 0)
        missing = Health.IMU_MISSING | Health.CAMERA_MISSING
        step = self.steps[0] if self.steps else ""
        if step == "go" and samples > 700:  # it stood still until then
            (self.folder / "go").write_text(str(time.monotonic_ns() + 1_000_000_000))
        elif step == "unplug" and samples > self.samples + 2400 and revision > 5:
            (self.folder / "unplugged").touch()
        elif step == "missing" and word & missing == missing and (self.folder / "stopped").exists():
            (self.folder / "unplugged").unlink()
        elif not (
            step == "back" and samples > self.samples + 400 and revision > self.revision + 5 and not word & missing
        ):
            if not self.steps or time.monotonic() > self.end:
                run.stop()
            return
        self.steps.pop(0)
        self.samples, self.revision = samples, revision


def test_one_process_owns_the_device_and_the_run_has_both(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    source, config = open_live("realsense", settings("device"), SENSORS)
    live = LiveRun(source, config, out, "realsense", ["vislam", "live"])
    drive = Drive(folder)
    metrics = live.execute(drive)
    assert drive.steps == []
    camera, imu = metrics["counters"]["camera"], metrics["live"]["counters"]
    assert camera["opened"] == imu["sensor_opened"] == camera["lost"] + 1 >= 2  # a stalled machine loses it, too
    assert metrics["frames"] <= camera["taken"] <= camera["captured"]
    assert metrics["counters"]["imu"]["samples"] == metrics["live"]["latency_ms"]["count"] > 3000
    assert imu["sensor_not_handed_on"] == 0
    # to and fro by twice the amplitude, to the right: the body's -y. The map's axes are those of the start
    poses = np.loadtxt(out / "trajectory_graph.tum")
    began = int((folder / "go").read_text()) * 1e-9
    x_right = np.where(
        poses[:, 0] > began, AMPLITUDE_M * (1.0 - np.cos((poses[:, 0] - began) * 2 * np.pi / PERIOD_S)), 0
    )
    off = poses[:, 2] + x_right
    assert np.ptp(x_right) > 0.3
    assert np.median(np.abs(off - np.median(off))) < 0.03  # of most: what a stall hides takes keyframes to come right
    assert not list(Path("/dev/shm").glob(f"vislam-device-{os.getpid()}-*"))
    assert left_behind("device") == []


def test_a_device_that_is_not_there_is_named_before_anything_starts(folder: Path, tmp_path: Path) -> None:
    (folder / "unplugged").touch()
    with pytest.raises(HardwareError, match="No device connected"):
        open_live("realsense,depth", settings("absent"), SENSORS)
    with pytest.raises(UsageError, match="inside a camera"):
        open_live("realsense+0", settings("absent"), SENSORS)
    (folder / "unplugged").unlink()
    source, config = open_live("realsense+realsense,depth", settings("absent"), SENSORS)
    (folder / "unplugged").touch()
    with pytest.raises(HardwareError, match="No device connected"):
        LiveRun(source, config, tmp_path / "run", "realsense", ["vislam", "live"])
    source.close()


def sample(k: int) -> ImuSample:
    return ImuSample(1000 * k, np.full(3, float(k)), np.full(3, -float(k)))


def test_samples_cross_the_wire_whole_and_in_order() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    hander, imu = ImuHander(ours), HandedImu(theirs, 200.0, HUNG_S)
    with closing(imu):
        hander.send([sample(k) for k in range(100)])
        hander.report(Health.IMU_GAP | Health.IMU_MISSING, {"gaps": 1}, "")
        read = imu.read(HUNG_S)
        assert [value.t_ns for value in read] == [1000 * k for k in range(100)]
        assert isinstance(read[7], ImuSample)
        assert read[7].accel_m_s2.tolist() == [-7.0] * 3
        assert (imu.health(), imu.health()) == (Health.IMU_GAP, Health(0))
        assert imu.counters() == {"gaps": 1, "not_handed_on": 0}
        hander.close()
        assert imu.read(0.01) == []  # at once, and for ever


def test_a_reader_that_is_stuck_costs_the_oldest_and_is_counted() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    hander, imu = ImuHander(ours), HandedImu(theirs, 200.0, 0.0)
    with closing(imu):
        for k in range(5000):
            hander.send([sample(k)])
        assert hander.lost > 0
        newest = 0
        while newest != 5000 * 1000:  # what is waiting goes on, up to a sample sent now
            read = imu.read(0.0)
            newest = read[-1].t_ns if read else newest
            hander.send([sample(5000)] if newest >= 4999 * 1000 else [])
        assert Health.IMU_MISSING in imu.health()


@pytest.mark.parametrize("with_depth", [False, True])
def test_frames_cross_shared_memory_as_they_are(with_depth: bool) -> None:
    name = f"vislam-test-frames-{os.getpid()}"
    rng = np.random.default_rng(3)
    grey = rng.integers(0, 255, (12, 16), dtype=np.uint8)
    color = np.repeat(grey[..., None], 3, axis=2)
    depth = rng.random((12, 16)).astype(np.float32)
    frame = Frame(5, 7, (grey,), color, depth) if with_depth else Frame(5, 7, (grey, grey[::-1].copy()))
    with closing(FrameHander(name, 16, 12, with_depth)) as hander, closing(HandedFrames(name, 0.0)) as frames:
        assert frames.read(0.0) is None
        hander.hand(frame, {"captured": 8, "lost": 2})
        read = frames.read(HUNG_S)
        assert read is not None
        assert (read.t_ns, read.index, len(read.images)) == (5, 7, len(frame.images))
        assert all(np.array_equal(a, b) for a, b in zip(read.images, frame.images, strict=True))
        assert (read.color is not None) == (read.depth_m is not None) == with_depth
        assert not with_depth or np.array_equal(read.depth_m, depth)
        hander.hand(replace(frame, index=10), {"captured": 11})
        assert frames.read(HUNG_S) is not None
        assert frames.counters() == {"captured": 11, "replaced": 2, "taken": 2, "wrong_size": 0}
        hander.hand(Frame(6, 11, tuple(np.zeros((99, 99), np.uint8) for _ in range(2))), {"captured": 12})
        assert frames.read(0.0) is None
        assert frames.counters()["wrong_size"] == 1
        assert frames.health() == Health.CAMERA_MISSING


def test_a_run_says_what_its_sensors_are(folder: Path) -> None:
    source, _ = open_live("realsense,depth", settings("name"), SENSORS)
    assert source.name == "live realsense+realsense,depth"
    assert source.rig.has_depth
    assert source.imu_noise is not None
    assert json.dumps(source.rig.T_body_cams[0].tolist())
