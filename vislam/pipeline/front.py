"""The front half of the pipeline: everything that runs at the rate of the sensors and gives the continuous pose."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from vislam.config import Config
from vislam.core.blas import on_one_blas_thread
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.geometry import level_rotation, transform
from vislam.core.memory import FrontMemory, Learned, StartFacts
from vislam.core.messages import (
    AS_MODELLED,
    Array,
    Frame,
    GraphUpdate,
    ImuSample,
    Keyframe,
    MagSample,
    NavState,
    NoiseScale,
    Tracking,
)
from vislam.core.readings import Reading
from vislam.ekf import Hint
from vislam.ekf.correction import AppliedReading
from vislam.frontend import TrackResult, make_frontend
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.masks import Masks
from vislam.frontend.result import identity_motion, lost_motion
from vislam.imu import ImuNoise
from vislam.pipeline.blind_start import Said
from vislam.pipeline.chain import KeyframeChain, believed, seek_place, torn
from vislam.pipeline.dark import Waypoints, unseen_keyframe
from vislam.pipeline.front_report import FrontReport, RunWatch, report_of
from vislam.pipeline.gravity import GravityWait, Phase, Start
from vislam.pipeline.inertial_stages import Inertial, Since
from vislam.pipeline.reading_intake import ReadingIntake
from vislam.pipeline.settings import derived, refuse_without_scale
from vislam.pipeline.smooth_motion import SmoothMotion
from vislam.pipeline.steps import Estimate, FrontStep
from vislam.sensors import Suite
from vislam.trajectory.continuity import in_odom
from vislam.trajectory.odometry_keyframe import OdometryKeyframe

_MAX_WAIT_S = 0.5  # a frame waits so long for the inertial sample after it, then goes on without


class Front:
    """Tracks frames, corrects the filter with them and hands over keyframes; `process` is the order of it.

    Without an IMU, `odom` is the chain of visual odometry. With one, it is the filter's frame, gravity-aligned, and
    keyframes wait for it; visual odometry before that lives in its own frame `vo`.

    Everything that leaves is stamped in the IMU's time: what the camera's clock is off is added to its frames. What
    left before that was known keeps the camera's own time.

    Attributes:
        config: what runs, see `settings.derived`.
        noise: of the IMU as it was given; None without one.
        frontend: visual odometry.
        camera_clock: what the camera's clock is off.
        begun: the phase of the run, and the start that led to it.
        watch: counters, and what frames showed of camera and tracks.
        inertial: samples and filter; None without an IMU. Unused once gravity was given up.
        gravity: the search for gravity; None without an IMU.
        readings: those of further sensors; None without any.
    """

    def __init__(
        self, config: Config, rig: Rig, noise: ImuNoise | None, clock: StageClock, suite: Suite | None = None
    ) -> None:
        """Build the stages for a rig; without `noise` there is no IMU; `suite` has those beside IMU and camera."""
        self.config = config = derived(config, rig, noise)
        self.noise = noise
        self.frontend = make_frontend(config.frontend, rig, config.seed)
        refuse_without_scale(config.ekf, self.frontend.knows_scale, noise is not None)
        self.camera_clock = CameraClock(config.init)
        self.begun = Start(noise is not None)
        self.watch = RunWatch(config.init, self.frontend.knows_scale, Masks(config.frontend.masks, rig), suite)
        self._T_upright = _upright(rig)
        most_m = np.inf if rig.is_blind else config.ekf.submap_sigma_m  # no loop would join submaps
        self._chain = KeyframeChain(self._T_upright if noise is None else np.eye(4), most_m)
        self.inertial: Inertial | None = None
        self.gravity: GravityWait | None = None
        if noise is not None:
            self.inertial = Inertial(config, rig, noise, suite)
            self.gravity = GravityWait(
                config, rig, noise, self.begun, self._chain, self.inertial, self.frontend.knows_scale,
                lambda from_ns: Said() if self.readings is None else self.readings.said(from_ns),
            )  # fmt: skip
        self.readings: ReadingIntake | None = None
        if suite is not None and len(suite):
            self.readings = ReadingIntake.of_run(config, suite, noise, self.inertial)
        self._clock, self._waypoints, self._published = clock, Waypoints(), in_odom(config)
        self._by_vision = SmoothMotion(config.graph, config.publish)
        self._last_frame_t_ns: int | None = None

    def resume(self, memory: FrontMemory) -> None:
        """Go on where an earlier run was, before the first sample and frame: the first frame is its newest keyframe.

        That keyframe comes out again, with its old id and pose, as it is seen now.
        """
        self.begun.resume(memory)
        self.frontend.begin_at(memory.keyframe_id, memory.learned)
        self._chain.begin_at(memory.T_odom_body)
        if self.begun.settled is None or memory.state is None or self.inertial is None:
            return
        self.camera_clock.start_at(memory.time_offset_s, memory.learned.time_offset_sigma_s)
        vo = identity_motion(memory.t_ns, memory.keyframe_id, True, 0)
        self.inertial.filtering.resume(memory.state, vo, memory.learned.filter_camera)

    def begin_in_map(self, keyframe_id: int, next_track_id: int) -> None:
        """Number keyframes and tracks on from those of a map, before the first frame; the first begins a new submap."""
        self._chain.first_id = keyframe_id
        self.frontend.begin_at(keyframe_id, Learned(next_track_id), seeks_place=True)

    # -- what goes in ------------------------------------------------------------------------------------------------

    def add(self, value: ImuSample | MagSample | Reading) -> None:
        """Take a sample of an inertial sensor, or a reading of another; the filter predicts at once."""
        self.watch.hear(value)
        if isinstance(value, MagSample):
            self._chain.mag = value
            if self.readings is not None:
                self.readings.add_field(value)
        elif isinstance(value, Reading):
            if self.readings is not None:
                self.readings.add(value)
        elif (imu := self._imu) is not None and imu.buffer.add(value):
            with self._clock.measure("ekf predict"):
                imu.filtering.ekf.predict(value)
            imu.condition.add(value)
            if self.readings is not None and self.begun.settled is not None:
                self.readings.hand_on(value.t_ns)

    def add_hint(self, hint: Hint) -> None:
        """Give the filter what holds a body while the camera sees nothing."""
        if self._imu is not None:
            self._imu.filtering.ekf.hold(hint)

    def is_ready(self, frame_t_ns: int, newest_frame_t_ns: int) -> bool:
        """Whether a frame can be processed: an inertial sample newer than it is there, or none will come in time."""
        if self._imu is None:
            return True
        newest = self._imu.buffer.newest_t_ns
        waited_s = (newest_frame_t_ns - frame_t_ns) * 1e-9
        offset_ns = self.camera_clock.offset_ns(frame_t_ns)
        most_s = _MAX_WAIT_S + max(offset_ns, 0) * 1e-9
        return (newest is not None and newest > frame_t_ns + offset_ns) or waited_s > most_s

    @on_one_blas_thread
    def process(self, frame: Frame) -> FrontStep:
        """Track one frame, correct the filter with it, and hand over keyframes that are ready."""
        frame = self.camera_clock.in_imu_time(self.watch.see(frame))
        imu = self._imu
        if torn(frame, self._chain, self.frontend, imu, self._last_frame_t_ns if self.readings is None else None):
            self._last_frame_t_ns = None
        since = Since() if imu is None else imu.since(self._last_frame_t_ns, frame.t_ns, self.camera_clock)
        with self._clock.measure("track"):
            track = self._track(frame, since)
        still_image, at_rest = (False, False) if imu is None else imu.rests(track, since.span)
        self._chain.follow(track.vo, at_rest)
        since = since if imu is None or not self.begun.settled else imu.compare(track, self._chain.T_vo_body, since)
        self.watch.note(track, since.span, since.state, at_rest)
        offset_sigma_s, ready = self.camera_clock.sigma_s, list[OdometryKeyframe]()
        with self._clock.measure("ekf"):
            if self.gravity is not None:
                ready = self.gravity.seek(since.span, track, still_image, at_rest, offset_sigma_s)
            estimate, state = self._estimate(_late(track, since, self.camera_clock, self.frontend.mode), since, at_rest)
        T_odom_body = self._chain.T_vo_body.copy() if self._imu is None else estimate.T_odom_body if estimate else None
        if self.readings is not None:
            self.readings.see(frame.t_ns, T_odom_body)
        is_settled = self.begun.phase is Phase.SETTLED
        T_keyframe_body = self._chain.since_keyframe(track.vo, T_odom_body if is_settled else None)
        if track.keyframe is not None:
            ready += self._take_keyframe(track, track.keyframe, T_odom_body, state)
            T_keyframe_body = np.eye(4)
        shift_ns = 0 if self.gravity is None else self.gravity.follow_clock(self.camera_clock, track.vo)
        self._last_frame_t_ns = frame.t_ns + shift_ns
        corrections = [] if self._imu is None else self._imu.filtering.take_applied()
        shown = None if estimate is None else estimate.shown(frame.t_ns, self._published)
        return FrontStep(frame, track, shown, estimate, state, self._chain.id, T_keyframe_body, ready, corrections)

    def take_applied_readings(self) -> list[AppliedReading]:
        """Return what the filter was given of further sensors since the last call."""
        return [] if self._imu is None else self._imu.filtering.take_applied_readings()

    def sensor_doubts(self) -> dict[str, str]:
        """Return, of further sensors that contradict the rest now, a word on how."""
        return {} if self.readings is None else self.readings.doubts()

    def feed_back(self, update: GraphUpdate) -> None:
        """Let the graph's biases correct the filter's, if the configuration wants that; the pose does not move."""
        if self._imu is not None:
            self._imu.feed_back(update)

    def give_up_waiting(self) -> list[OdometryKeyframe]:
        """Return the keyframes that still wait for a settled start when the recording ends.

        With one camera a provisional start has to do, and without any the list is empty; else vision alone does.
        """
        return [] if self.gravity is None else self.gravity.finish(self._T_upright)

    # -- the steps of a frame ----------------------------------------------------------------------------------------

    @property
    def _imu(self) -> Inertial | None:
        """The inertial stages, as long as the run uses them."""
        return None if self.begun.phase is Phase.VISION_ALONE else self.inertial

    def _track(self, frame: Frame, since: Since) -> TrackResult:
        """Return where visual odometry has a frame; as a keyframe also where only the filter knows the way."""
        track = self.frontend.track(frame, since.unbiased, since.gyro_sigma_rad_s, since.T_last_now)
        track = believed(track, self._chain, self.frontend) if self._imu is None else track
        track = self._as_waypoint(frame, _as_blind(self._linked(frame, track), self.frontend.mode))
        return replace(track, vo=self.camera_clock.loosened(track.vo, since.span, since.state))

    def _linked(self, frame: Frame, track: TrackResult) -> TrackResult:
        """Return the track, tied to the keyframes of an earlier run where it begins again."""
        memory = self.begun.see_again(self.inertial is not None)
        if memory is not None and track.keyframe is None:  # too little to see there for a start: a lost keyframe
            self.frontend.begin_at(memory.keyframe_id + 1, memory.learned)
            vo = identity_motion(frame.t_ns, memory.keyframe_id, track.vo.has_scale, 0)
            return replace(track, keyframe=unseen_keyframe(memory.keyframe_id, frame), vo=vo)
        is_alone = track.keyframe is not None and track.vo.keyframe_id == track.keyframe.id
        if memory is None and is_alone and self._chain.id >= 0:
            return replace(track, vo=lost_motion(frame.t_ns, self._chain.id, track.vo.has_scale))
        return track

    def _as_waypoint(self, frame: Frame, track: TrackResult) -> TrackResult:
        """Return the track, as that of a keyframe where vision gives none for long and the filter knows the way."""
        imu, chain, is_blind = self._imu, self._chain, track.vo.tracking is Tracking.BLIND
        if (self.readings is None and not is_blind) or imu is None or self.begun.holds_keyframes:
            return track
        state = imu.filtering.ekf.state_at(frame.t_ns)
        if state is None or not self._waypoints.wants(track.vo, track.keyframe is not None):
            return track
        if not is_blind and not chain.is_bridged(frame.t_ns, imu.buffer.span(chain.t_ns, frame.t_ns), state):
            return track
        self.watch.counters["waypoints"] = self.watch.counters.get("waypoints", 0) + 1
        keyframe = unseen_keyframe(chain.id + 1, frame)
        seek_place(self.frontend, keyframe.id + 1)
        lost = replace(lost_motion(frame.t_ns, chain.id, track.vo.has_scale), tracking=track.vo.tracking)
        return replace(track, keyframe=keyframe, vo=self.begun.begin_blind(state) if chain.id < 0 else lost)

    def _estimate(self, track: TrackResult, since: Since, at_rest: bool) -> tuple[Estimate | None, NavState | None]:
        """Return the pose in `odom` and the filter's state after this frame."""
        chain = self._chain
        if self._imu is None:
            return self._by_vision.follow(track.vo, chain.T_vo_body.copy(), chain.is_torn), None
        shows_scale = self.watch.uniform.shows_scale
        estimate, state = self._imu.correct(track, at_rest, shows_scale, since.span, chain.by_vision(track.vo))
        chain.T_odom_body = None if estimate is None else estimate.T_odom_body
        return estimate, state

    def _take_keyframe(
        self, track: TrackResult, keyframe: Keyframe, T_odom_body: Array | None, state: NavState | None
    ) -> list[OdometryKeyframe]:
        """Pack a new keyframe with all that the back end needs of it; return it unless it has to wait for gravity."""
        chain, holds, imu = self._chain, self.begun.holds_keyframes, None
        if self._imu is not None and chain.id >= 0 and not chain.is_torn:
            imu = self._imu.between_keyframes(chain.t_ns, keyframe.t_ns)
        packet = chain.packet(track, keyframe, imu, state, self.camera_clock.applied_s)
        self.watch.counters["submaps"] += packet.begins_submap
        if self.readings is not None and not holds:
            packet = self._waypoints.marked(self.readings.pack(packet, chain.t_ns, state), state)
        self.camera_clock.took_keyframe()
        chain.extend(packet, T_odom_body, state)
        if T_odom_body is not None and not holds:
            return [OdometryKeyframe(packet, T_odom_body)]
        assert self.gravity is not None
        ready = self.gravity.hold(packet, T_odom_body, self._T_upright)
        if self._imu is None and self.readings is not None:
            self.readings.give_up_filter()
        return ready

    # -- what is known -----------------------------------------------------------------------------------------------

    @property
    def start(self) -> StartFacts | None:
        """How gravity was found; None until then, or without an IMU."""
        return self.begun.facts(self.noise)

    @property
    def learned(self) -> Learned:
        """What was learned so far, beside the filter's state."""
        camera = None if self._imu is None else self._imu.filtering.camera
        return replace(self.frontend.learned, time_offset_sigma_s=self.camera_clock.sigma_s, filter_camera=camera)

    @property
    def noise_scale(self) -> NoiseScale:
        """White noise of the IMU over that of its model, as the newest samples show it."""
        return AS_MODELLED if self._imu is None else self._imu.noise_scale

    def report(self) -> FrontReport:
        """Return what there is to say of the run so far."""
        return report_of(self)


def _late(track: TrackResult, since: Since, clock: CameraClock, mode: str) -> TrackResult:
    """Return vision's motion for a filter, whose times are the stamps': with their jitter, unless it has one."""
    return track if mode == "planar" else replace(track, vo=clock.jittered(track.vo, since.span, since.state))


def _as_blind(track: TrackResult, mode: str) -> TrackResult:
    """Return the track, as that of no camera where the front end has none."""
    return replace(track, vo=replace(track.vo, tracking=Tracking.BLIND)) if mode == "none" else track


def _upright(rig: Rig) -> Array:
    """Return what turns the body [4, 4] so that the first image is upright: up, where gravity is not known."""
    return np.eye(4) if rig.is_blind else transform(level_rotation(-rig.T_body_cams[0][:3, 1]), np.zeros(3))


def odometry(front: Front, values: Iterable[ImuSample | MagSample | Reading | Frame]) -> Iterator[FrontStep]:
    """Feed measurements to a front half alone, without loops and graph; yield a step for every frame it can process."""
    waiting = deque[Frame]()
    for value in values:
        if isinstance(value, Frame):
            waiting.append(value)
        else:
            front.add(value)
        while waiting and front.is_ready(waiting[0].t_ns, waiting[-1].t_ns):
            yield front.process(waiting.popleft())
