"""The process that sees: frames and samples through the front half, corrections to the pose, keyframes to the back."""

import logging
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.errors import DataError, HardwareError
from vislam.core.messages import Array, Frame, ImuSample, Keyframe, no_observations
from vislam.ekf.correction import Hint
from vislam.hw.health import Health
from vislam.hw.source import FrameSource, ReadingSource
from vislam.imu import ImuNoise
from vislam.live.beginning import Beginning
from vislam.live.corrections import Corrections
from vislam.live.handover import FrontEnded, KeyframeOut, Seen
from vislam.live.notices import CameraHealth, Doubted, ToFast
from vislam.live.pace import Pace
from vislam.live.processes.child import Life
from vislam.live.rehearsal import rehearse_front
from vislam.live.web.updates import FrameUpdate
from vislam.live.wire.mail import Outbox
from vislam.live.wire.publisher import PoseReader
from vislam.live.wire.stream import SampleReceiver, Value
from vislam.pipeline.dark import SilentCamera
from vislam.pipeline.front import Front
from vislam.pipeline.front_report import FrontReport
from vislam.pipeline.settings import makes_depth
from vislam.pipeline.steps import FrontStep, seen_between
from vislam.runs.evidence import front_evidence
from vislam.runs.verdict import Trust, Verdict, judge
from vislam.sensors import Suite

_CROWDED_SPACING = 2.0  # factor on the distances between keyframes then
_LOG = logging.getLogger(__name__)
_LATE_NS = 300_000_000  # most that readings may come late, and be in their keyframe, where frames have no image
_READ_S = 0.005  # most that waiting for a frame may take: samples come meanwhile
_PUT_S = 0.1
_SENSORS_S = 1.0  # between two words on how further sensors are
_JUDGE_NS = 1_000_000_000  # of frames between verdicts: one costs a millisecond
_STEPS = 4096  # frames that may wait for the map process: minutes; then it is stuck
_FRAME_S = 0.2  # between two pictures
_WIDTH_PX = 480
_QUALITY = 70
_MAX_REASON = 200


class FrameShare:
    """Shows the page frames, a few a second: where the last one was not taken yet, none."""

    def __init__(self, to_web: Connection) -> None:
        """Take the page's wire, to be used in this process only."""
        self._box = Outbox(to_web, 1)
        self._due_s = 0.0

    def show(self, step: FrontStep) -> None:
        """Show a frame with the points that vision follows, if it is time for one."""
        now_s = time.monotonic()
        if now_s < self._due_s or len(self._box) or self._box.is_broken:
            return
        self._due_s = now_s + _FRAME_S
        track = step.track
        jpeg = picture(step.frame, track.observations.pixels_px)
        self._box.put(
            FrameUpdate(step.frame.t_ns, jpeg, str(track.vo.tracking), track.vo.inliers, track.reason[:_MAX_REASON])
        )


def picture(frame: Frame, pixels_px: Array) -> bytes:
    """Return a small JPEG of a frame with points [N, 2] on it; empty where the frame has no image."""
    image = frame.color if frame.color is not None else frame.images[0] if frame.images else None
    if image is None:
        return b""
    scale = min(1.0, _WIDTH_PX / image.shape[1])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    drawn = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR) if small.ndim == 2 else small
    for x, y in ((pixels_px + 0.5) * scale - 0.5)[np.isfinite(pixels_px).all(axis=1)].tolist():
        cv2.circle(drawn, (round(x), round(y)), 2, (90, 200, 60), -1, cv2.LINE_AA)
    _, encoded = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return encoded.tobytes()


def run(
    life: Life,
    config: Config,
    rig: Rig,
    noise: ImuNoise,
    open_camera: Callable[[], FrameSource],
    open_readings: Callable[[], ReadingSource],
    suite: Suite,
    samples: socket.socket,
    to_fast: Connection,
    to_back: Connection,
    to_map: Connection,
    beginning: Beginning | None,
    to_web: Connection | None = None,
) -> None:
    """Process frames until the samples end; then signal the back and the map process that there are no more.

    Args:
        life: of this process.
        config: of the run.
        rig: the cameras.
        noise: of the IMU.
        open_camera: opens them, in this process.
        open_readings: opens the further sensors, in this process.
        suite: what those are.
        samples: from the fast process.
        to_fast: corrections.
        to_back: `KeyframeOut`.
        to_map: `Seen`, then `FrontEnded`.
        beginning: the session that the run goes on from.
        to_web: small pictures for the page that shows the run; None: there is none.
    """
    cv2.setNumThreads(1)
    rehearse_front(config, rig, noise)
    with ExitStack() as devices:
        camera = devices.enter_context(closing(open_camera()))
        readings = devices.enter_context(closing(open_readings()))
        back, follower = Outbox(to_back, config.live.keyframe_queue), Outbox(to_map, _STEPS)
        share = None if to_web is None else FrameShare(to_web)
        process = FrontProcess(life, config, rig, noise, suite, to_fast, back, follower, share)
        if beginning is not None:
            process.front.begin_in_map(beginning.first_id, beginning.next_track_id)
        if life.ready():
            process.loop(camera, SampleReceiver(samples), readings)
            process.end()
        process.closing(camera.counters(), readings)


class FrontProcess:
    """Owns the front half of this run and the ends of its wires."""

    def __init__(
        self, life: Life, config: Config, rig: Rig, noise: ImuNoise, suite: Suite, to_fast: Connection,
        to_back: Outbox, to_map: Outbox, share: FrameShare | None = None,
    ) -> None:  # fmt: skip
        self.clock = StageClock()
        self.front = Front(config, rig, noise, self.clock, suite)
        self._life, self._config = life, config
        self._to_fast, self._to_back, self._to_map, self._share = to_fast, to_back, to_map, share
        self._frames: deque[Frame] = deque()
        self._corrections = Corrections(self.front)
        self._begins_back = True
        self._camera_health = Health(0)
        self._verdict = Verdict(Trust.TRUSTED)
        self._judged_t_ns = 0
        self._sensors_noted_s = 0.0
        self._silence = SilentCamera(rig) if rig.is_blind and suite else None  # attitude is all of an IMU alone
        self._feeds_depth = makes_depth(config, rig)
        self._poses: PoseReader | None = None
        self._counters = {"frames_taken": 0, "crowded_frames": 0, "waits_for_back": 0, "back_late_ms": 0}
        self._pace, self._told_every = Pace(noise.rate_hz), 1

    def loop(self, camera: FrameSource, samples: SampleReceiver, readings: ReadingSource) -> None:
        """Take frames, samples and readings until the samples end."""
        while not samples.ended and not self._life.is_orphan:
            self._hear(samples, readings)
            for message in self._corrections.of_readings():
                self._send(message)
            self._follow_sensors(readings)
            frame = camera.read(_READ_S)
            if frame is not None and self._pace.wants(frame):
                self._frames.append(frame)
            self._follow_camera(camera.health())
            self._follow_pace()
            while self._is_next_ready:
                self._hear(samples, readings)
                self._process(self._frames.popleft())

    def end(self) -> None:
        """Process what still waits, unless the run has to end soon."""
        while self._frames and not self._life.is_brief:
            self._process(self._frames.popleft())
        for odometry in self.front.give_up_waiting():
            self._put_keyframe(KeyframeOut(odometry, *self._first()))

    def closing(self, camera_counters: dict[str, int], readings: ReadingSource) -> None:
        """Say good-bye to the others; what happened goes to the map process, which writes it down."""
        self._to_back.close()
        report = self._report()
        counters = {**report.counters, "camera": camera_counters}
        for name, read in readings.counters().items():
            counters[f"sensor {name}"] = {**counters.get(f"sensor {name}", {}), **read}
        datums = {name: {"datum": asdict(datum)} for name, datum in readings.datums().items()}
        sensors = {name: entry | datums.get(name, {}) for name, entry in report.sensors.items()}
        report = replace(report, counters=counters, sensors=sensors)
        ended = FrontEnded(report, self.front.start, self.front.learned, self.clock.summary_ms())
        self._put(self._to_map, ended)
        self._to_map.close()

    @property
    def _is_next_ready(self) -> bool:
        """Whether the oldest frame that waits can be processed."""
        late_ns = 0 if self._silence is None else _LATE_NS
        return bool(self._frames) and self.front.is_ready(self._frames[0].t_ns + late_ns, self._frames[-1].t_ns)

    def _hear(self, samples: SampleReceiver, readings: ReadingSource) -> None:
        """Take what came of samples and readings, each reading before the samples that are newer."""
        values: list[Value] = []
        samples.receive(values.append)
        for reading in readings.read():
            self.front.add(reading)
        for value in values:
            self._take(value)

    def _take(self, value: Value) -> None:
        if isinstance(value, Hint):
            self.front.add_hint(value)
            return
        self.front.add(value)
        if not isinstance(value, ImuSample):
            return
        self._pace.add_sample(value)
        if self._silence is not None:
            self._frames += self._silence.stand_in(value.t_ns)
            while self._is_next_ready:
                self._process(self._frames.popleft())

    def _report(self) -> FrontReport:
        """Return what the front half has to say, and how it kept up."""
        report = self.front.report()
        return replace(report, counters={**report.counters, "live": {**self._counters, **self._pace.counters}})

    def _process(self, frame: Frame) -> None:
        begun_ns, cpu_ns = time.monotonic_ns(), time.thread_time_ns()
        self._see(frame)
        if self._silence is None:  # else it is late on purpose
            self._pace.took(frame, begun_ns, time.monotonic_ns(), time.thread_time_ns() - cpu_ns)

    def _see(self, frame: Frame) -> None:
        live, waiting = self._config.live, len(self._to_back)
        is_crowded = self._pace.every > 1 or 2 * waiting >= live.keyframe_queue
        is_full = 4 * waiting >= 3 * live.keyframe_queue
        self.front.frontend.keyframe_spacing = _CROWDED_SPACING ** (is_crowded + is_full)
        self._counters["crowded_frames"] += is_crowded
        self._counters["back_late_ms"] = max(self._counters["back_late_ms"], round(1e3 * self._to_back.age_s))
        step = self.front.process(frame)
        for message in self._corrections.of_step(step):
            self._send(message)
        if self._share is not None:
            self._share.show(step)
        self._judge(frame.t_ns)
        for odometry in step.keyframes:
            self._put_keyframe(KeyframeOut(odometry, *self._first()))
        shows = self._config.view.enabled and self._counters["frames_taken"] % self._config.view.every_frames == 0
        shows = shows and self._to_map.age_s < live.map_age_s
        self._counters["frames_taken"] += 1
        seen = Seen(light(step, shows, self._feeds_depth), self._T_map_odom(), self.front.start, self.front.learned)
        if not self._to_map.put(seen):
            raise HardwareError(
                "the map process does not take frames any more; is the disk of --out stuck, or the machine too slow?"
            )

    def _follow_sensors(self, readings: ReadingSource) -> None:
        """Note once a second how the further sensors are, and which of them slip."""
        now_s = time.monotonic()
        if now_s - self._sensors_noted_s >= _SENSORS_S and (status := readings.status()):
            self._sensors_noted_s = now_s
            doubts = {name: word for name, word in self.front.sensor_doubts().items() if status.get(name) == "well"}
            self._life.note(sensors=status | doubts)

    def _judge(self, t_ns: int) -> None:
        """Mark the pose as doubtful or not, and log why; nothing while the run begins."""
        if self.front.begun.holds_keyframes or t_ns - self._judged_t_ns < _JUDGE_NS:
            return
        self._judged_t_ns = t_ns
        verdict = judge(front_evidence(self._report(), self._config.machine), self._config.verdict)
        if verdict.state != self._verdict.state:
            self._send(Doubted(verdict.state is not Trust.TRUSTED))
        if verdict != self._verdict:
            self._life.note(verdict={"state": str(verdict.state), "reasons": list(verdict.reasons)})
        self._verdict = verdict

    def _follow_camera(self, health: Health) -> None:
        if health != self._camera_health:
            self._camera_health = health
            self._send(CameraHealth(health))

    def _follow_pace(self) -> None:
        """Say when frames are left out, and when all are taken again."""
        every = self._pace.every
        if every == self._told_every:
            return
        how = "keeps up with" if every < self._told_every else "is too slow for"
        _LOG.warning("vision %s its camera: one frame in %d is taken from now on", how, every)
        self._told_every = every
        self._life.note(every=every)

    def _send(self, message: ToFast) -> None:
        try:
            self._to_fast.send(message)
        except OSError:  # the fast process has ended; the end of the samples follows in a moment
            return

    def _first(self) -> tuple[Any, Any]:
        """Return what the back end has to know before its first keyframe."""
        if not self._begins_back:
            return None, None
        self._begins_back = False
        return self.front.noise, self.front.begun.first_state

    def _put_keyframe(self, keyframe: KeyframeOut) -> None:
        """Hand a keyframe to the back end; where it has too many, vision waits and the pose is dead reckoning."""
        self._counters["waits_for_back"] += len(self._to_back) >= self._config.live.keyframe_queue
        self._put(self._to_back, keyframe)

    def _put(self, box: Outbox, value: object) -> None:
        while not (box.put(value, _PUT_S) or self._life.is_orphan):
            continue

    def _T_map_odom(self) -> Array | None:
        """Return where `odom` is in `map` as it is published now; None while that is a guess."""
        if self._poses is None:
            try:
                self._poses = PoseReader(self._config.live.name)
            except DataError:
                return np.eye(4)
        pose = self._poses.latest()
        if pose is not None and Health.NOT_IN_MAP in pose.health:
            return None
        return np.eye(4) if pose is None else pose.T_map_odom


def light(step: FrontStep, shows: bool, feeds_depth: bool = False) -> FrontStep:
    """Return a step without what comes to the map process from the back end.

    With pictures only if it `shows` them, or `feeds_depth` from one camera.
    """
    frame, track = step.frame, step.track
    bare = replace(frame, images=(), color=None, depth_m=None, tracks=None, masks=())
    if feeds_depth and seen_between(step):
        bare = replace(bare, images=frame.images[:1])
    keyframe = track.keyframe
    if keyframe is not None:
        keyframe = Keyframe(keyframe.id, keyframe.t_ns, bare, np.empty((0, 2)), np.empty((0, 32), np.uint8), None)
    observations = track.observations if shows else no_observations()
    track = replace(track, keyframe=keyframe, observations=observations)
    shown = replace(frame, depth_m=None, tracks=None, masks=()) if shows else bare
    return replace(step, frame=shown, track=track, keyframes=[], corrections=[])
