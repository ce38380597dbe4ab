"""Live without a camera: the same filter, graph and run folder by further sensors, however these are late."""

import csv
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import SensorsConfig, load
from vislam.core import ImuSample, Reading
from vislam.core.files import write_json
from vislam.hw.health import Health
from vislam.live.fast import FastPath
from vislam.live.frames import NoCamera
from vislam.live.handover import KeyframeOut
from vislam.live.processes.front import FrontProcess
from vislam.live.replay import ReplaySource
from vislam.live.run_live import LiveRun
from vislam.live.sources import open_live
from vislam.live.status import status_line
from vislam.live.wire.published_pose import PublishedPose
from vislam.pipeline.settings import derived
from vislam.runs import further_readings
from vislam.runs.folder import prepare
from vislam.runs.report import write_report
from vislam.runs.sources import open_source
from vislam.trajectory import align, associate, read_tum

WORLD = "points:cart-drive,rig=none"
WHEELS = '[sensors.wheels]\nkind = "wheels"\nsimulated_hz = 20.0\n'
STEP_NS = 10**9 // 200
LATEST_NS = 250_000_000  # that readings may come after the samples of their time


@dataclass
class Post:
    """Takes what a process sends, in place of its queues; and plays the life of that process."""

    sent: list = field(default_factory=list)
    age_s: float = 0.0
    is_orphan: bool = False
    is_brief: bool = False

    def put(self, value: object, timeout_s: float = 0.0) -> bool:
        self.sent.append(value)
        return True

    send = put
    __len__ = lambda self: 0  # noqa: E731

    def note(self, **values: object) -> None:
        """Nobody listens."""


class Batches:
    """Samples and readings of a recording as they come in batches: both ends that the front process reads."""

    def __init__(self, values: list, sizes: Callable[[], int], late_ns: int) -> None:
        self._samples = [value for value in values if isinstance(value, ImuSample)]
        self._readings = [value for value in values if isinstance(value, Reading)]
        self._sizes, self._late_ns = sizes, late_ns
        self._newest_ns = 0
        self.ended = False

    def receive(self, take: Callable) -> None:
        batch, self._samples = self._samples[: (size := self._sizes())], self._samples[size:]
        self.ended = not self._samples
        self._newest_ns = batch[-1].t_ns if batch else self._newest_ns
        for sample in batch:
            take(sample)

    def read(self) -> list[Reading]:
        due_ns = self._newest_ns - (0 if self.ended else self._late_ns)
        batch = [one for one in self._readings if one.t_ns <= due_ns]
        self._readings = self._readings[len(batch) :]
        return batch

    def status(self) -> dict[str, str]:
        return {}


class Quick(NoCamera):
    """A camera that is not there, and that nobody waits for."""

    def read(self, timeout_s: float) -> None:
        """Return None at once."""


def driven(
    folder: Path, sizes: Callable[[], int], late_ns: int = 0, silent_s: float = 60.0
) -> tuple[list, list[PublishedPose]]:
    """Drive 15 s by wheels that fall silent; return the keyframes, and what would be published with each sample."""
    recording = open_source(f"{WORLD},duration_s=15")
    (folder / "cart.toml").write_text(WHEELS)
    config = load(None, {"view.enabled": False, "sensors.file": str(folder / "cart.toml")})
    config, further = (
        derived(config, recording.rig, recording.imu_noise),
        further_readings(recording, config.sensors, 0),
    )
    values = list(further.among(recording.events()))
    end_ns = values[0].t_ns + round(silent_s * 1e9)
    values = [value for value in values if not isinstance(value, Reading) or value.t_ns < end_ns]
    to_fast, to_back, noise = Post(), Post(), recording.imu_noise
    front = FrontProcess(Post(), config, recording.rig, noise, further.suite, to_fast, to_back, Post())
    batches = Batches(values, sizes, late_ns)
    front.loop(Quick(), batches, batches)
    front.end()
    poses: list[PublishedPose] = []
    fast, messages = FastPath(config, noise, np.eye(4), poses.append, suite=further.suite), list(to_fast.sent)
    stamps = {id(one): getattr(one, "t_ns", 0) or getattr(getattr(one, "state", None), "t_ns", 0) for one in messages}
    for value in values:
        if isinstance(value, ImuSample):
            assert fast.add(value) is None, "frames without an image say what rests"
            while messages and stamps[id(messages[0])] + LATEST_NS <= value.t_ns:
                fast.correct(messages.pop(0))
            fast.publish(value.t_ns + 100_000, lambda: Health(0))
    return [one for one in to_back.sent if isinstance(one, KeyframeOut)], poses


def test_keyframes_are_the_same_however_samples_and_readings_are_batched(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    one, _ = driven(tmp_path, lambda: 1)
    for sizes, late_ns in ((lambda: int(rng.integers(0, 90)), 0), (lambda: 3, LATEST_NS)):
        other, _ = driven(tmp_path, sizes, late_ns)
        assert len(one) == len(other) > 9
        for a, b in zip(one, other, strict=True):
            assert a.odometry.packet.keyframe.t_ns == b.odometry.packet.keyframe.t_ns
            np.testing.assert_allclose(a.odometry.T_odom_body, b.odometry.T_odom_body, atol=1e-9)
            told = [[(r.reading.t_ns, *r.reading.values) for r in k.odometry.packet.readings] for k in (a, b)]
            assert told[0] == told[1]
    assert sum(len(k.odometry.packet.readings) for k in one) > 170


def test_the_pose_is_good_while_readings_come_and_says_so_when_they_end(tmp_path: Path) -> None:
    truth = open_source(f"{WORLD},duration_s=15").truth()
    _, poses = driven(tmp_path, lambda: 1, silent_s=8.0)
    begin_ns = poses[0].t_ns
    going = [pose for pose in poses if 2.0 <= (pose.t_ns - begin_ns) * 1e-9 < 8.0]
    assert all(Health.VISION_OK in pose.health and Health.INVALID not in pose.health for pose in going)
    T = truth.at(going[0].t_ns) @ np.linalg.inv(going[0].T_odom_base)
    assert max(np.linalg.norm((T @ p.T_odom_base - truth.at(p.t_ns))[:3, 3]) for p in going[::20]) < 0.1
    after = [pose for pose in poses if (pose.t_ns - begin_ns) * 1e-9 > 9.0]
    assert all(Health.DEAD_RECKONING in pose.health and Health.VISION_OK not in pose.health for pose in after)
    assert Health.INVALID in after[-1].health
    assert after[-1].vision_age_s == pytest.approx((after[-1].t_ns - begin_ns) * 1e-9 - 8.0, abs=0.2)


def test_a_run_without_a_camera_leaves_what_one_with_a_camera_does(tmp_path: Path, capsys) -> None:
    """A replay, with a sensor that is never heard; its graph is that of the recording's own run."""
    uri, file, out = f"{WORLD},duration_s=6", tmp_path / "cart.toml", tmp_path / "run"
    file.write_text(WHEELS + '[sensors.baro]\nkind = "height"\nfile = "baro.csv"\n')
    (tmp_path / "baro.csv").write_text("t_ns,height_m\n9000000000000,1.0\n")
    options = {"view.enabled": False, "sensors.file": str(file), "live.send_to": ()}
    base = load(None, {**options, "live.name": f"vislam-test-blind-run-{os.getpid()}"})
    source, config = open_live(f"replay:{uri}", base, SensorsConfig())
    assert isinstance(source, ReplaySource)
    prepare(out, overwrite=False)
    write_json(out / "sensors.json", asdict(SensorsConfig()))
    lines: list[str] = []
    live = LiveRun(source, config, out, f"replay:{uri}", ["vislam", "live"])

    def watch(run: LiveRun) -> None:
        lines.append(status_line(run))
        if run.notes.get("fast", {}).get("status", {}).get("samples", 0) >= 6 * 200:
            run.stop()

    metrics = live.execute(watch, 600.0)
    assert metrics["mode"] == "none" and metrics["verdict"]["state"] == "trusted"
    assert not metrics["sensors"]["baro"]["begun"] and "baro nothing yet" in " ".join(lines)
    assert metrics["sensors"]["wheels"]["readings"]["graph"]["used"] > 60
    rows = list(csv.DictReader((out / "tracking.csv").open()))
    assert {row["tracking"] for row in rows} == {"blind"}
    assert "Mode: no camera, inertial." in write_report(out).read_text()
    assert (
        run_verb(["run", uri, "--out", str(tmp_path / "again"), "--sensors.file", str(file), "--view.no-enabled"]) == 0
    )
    ours, theirs = (read_tum(of / "trajectory_graph.tum") for of in (out, tmp_path / "again"))
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(ours.positions_m, theirs.positions_m, atol=1e-3)
    pairs = associate(source.truth(), ours)
    assert pairs.aligned(align(pairs, "yaw")).position_errors_m().max() < 0.1
    capsys.readouterr()
    assert run_verb(["live", "--resume", str(out)]) == 2
    assert "no place tells where the cart is now; start a new run" in capsys.readouterr().err.replace("\n", " ")
