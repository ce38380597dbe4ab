"""The front half of the pipeline: everything that runs at the rate of the sensors and gives the continuous pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.geometry import invert, level_rotation, transform
from vislam.core.memory import FrontMemory, FrontNews, StartFacts
from vislam.core.messages import (
    AS_MODELLED,
    Array,
    Frame,
    GraphUpdate,
    ImuSample,
    ImuSpan,
    KeyframePacket,
    MagSample,
    NavState,
    NoiseScale,
    Tracking,
    VoMeasurement,
)
from vislam.core.readings import Reading
from vislam.ekf import Ekf, Hint
from vislam.ekf.correction import ToldReading
from vislam.ekf.filtering import Filtering
from vislam.ekf.tight import EarlyFrames
from vislam.frontend import TrackResult, make_frontend
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.feed import CameraFeed
from vislam.frontend.pixel_noise import NoiseUsed
from vislam.frontend.result import identity_motion, lost_motion, scaled_motion
from vislam.frontend.start import Initialisation
from vislam.frontend.stillness import Stillness
from vislam.frontend.uniform_motion import UniformMotion
from vislam.imu import (
    ConditionWatch,
    ImuBuffer,
    ImuNoise,
    NoiseFloor,
    RestDetector,
    pose_after,
    subtract_bias,
)
from vislam.pipeline.front_report import FrontReport, learned_of_camera
from vislam.pipeline.gravity import GravityWait, Released
from vislam.pipeline.reading_intake import ReadingIntake
from vislam.pipeline.settings import derived, refuse_without_scale
from vislam.pipeline.steps import Estimate, FrontStep
from vislam.pipeline.waypoints import Waypoints, surer_gyro_bias, unseen_keyframe
from vislam.sensors import Suite
from vislam.trajectory.continuity import in_odom
from vislam.trajectory.odometry_keyframe import OdometryKeyframe

_KNOWN_MOTION_M = 0.02  # sigma of the motion between two frames below which the filter may overrule the image
_SWAY_M_S = 0.03  # that a filter at rest may take for speed; a body that sets off is soon faster
_BLIND_S = 5.0  # dead reckoning from an unknown velocity is off by metres after so long


class Front:
    """Owns the IMU buffer, the filter, visual odometry and the search for the first state.

    Without an IMU, `odom` is the chain of visual odometry. With one, it is the filter's frame, gravity-aligned, and
    keyframes wait for it; visual odometry before that lives in its own frame `vo`.

    Everything that leaves is stamped in the IMU's time: what the camera's clock is off is added to its frames. What
    left before that was known keeps the camera's own time.
    """

    def __init__(
        self, config: Config, rig: Rig, noise: ImuNoise | None, clock: StageClock, suite: Suite | None = None
    ) -> None:
        """Build the stages for a rig; without `noise` there is no IMU and odometry is visual only.

        `suite` are the sensors other than IMU and camera, if there are any.
        """
        self.config = config = derived(config, rig, noise)
        self.frontend = make_frontend(config.frontend, rig, config.seed)
        refuse_without_scale(config.ekf, self.frontend.mode, noise is not None)
        self.counters = {
            "frames_lost": 0, "frames_degraded": 0, "longest_loss_ms": 0, "imu_outages": 0, "frames_at_rest": 0,
            "submaps": 1,
        }  # fmt: skip
        self._lost_since_ns: int | None = None
        self._clock = clock
        self.noise, self._has_imu = noise, noise is not None  # as told; spans and the filter hear what samples show
        self.camera_clock = CameraClock(config.init)
        self.uniform = UniformMotion(config.init)
        self.feed, self._track_noise = CameraFeed(), NoiseUsed()
        self._filter: Filtering | None = None
        if noise is not None:
            self._buffer = ImuBuffer(config.imu, config.machine, noise)
            self.condition = ConditionWatch()
            self._rest = RestDetector(config.init, noise)
            self._stillness = Stillness(config.init)
            self._filter = Filtering(config.ekf, noise, config.machine, rig, suite)
            early = EarlyFrames(config.ekf, rig, config.machine) if self.frontend.mode == "mono" else None
            self._gravity = GravityWait(config, rig, noise, self._filter, self._buffer, early)
            self.ekf_coupling = self._filter.coupling
        self._readings: ReadingIntake | None = None
        if suite is not None and len(suite):
            buffer, density = (None, 0.0) if noise is None else (self._buffer, noise.accelerometer_noise_density)
            has_window = config.graph.coupling == "tight"
            self._readings = ReadingIntake(
                suite, self._filter, buffer, config.machine.gravity_m_s2, density, has_window
            )
        self._waypoints = Waypoints()
        self._published = in_odom(config)
        self._last_state: NavState | None = None  # at the last frame
        self._graph_state: NavState | None = None  # at the newest keyframe that the graph has told of
        self._last_frame_t_ns: int | None = None
        self._keyframe_t_ns, self._keyframe_id = 0, -1
        self._keyframe_variance_m2 = 0.0  # of the filter's position there
        self._rested_since_keyframe = True
        self._mag: MagSample | None = None
        # without gravity, up is where the first image has it
        self._T_upright = transform(level_rotation(-rig.T_body_cams[0][:3, 1]), np.zeros(3))
        self._T_vo_keyframe = np.eye(4) if self._has_imu else self._T_upright
        self._T_odom_keyframe: Array | None = None
        self._T_odom_body: Array | None = None
        self._T_vo_body = self._T_vo_keyframe.copy()
        self._resumed: FrontMemory | None = None  # until its keyframe was seen again
        self._first_id = 0  # of the keyframes of this recording

    def resume(self, memory: FrontMemory) -> None:
        """Go on where an earlier run was, before the first sample and frame: the first frame is its newest keyframe.

        That keyframe comes out again, with its old id and pose, as it is seen now.
        """
        self._resumed = memory
        self.frontend.begin_at(memory.keyframe_id, memory.news)
        self._T_vo_keyframe, self._T_vo_body = memory.T_odom_body, memory.T_odom_body.copy()
        start, state = memory.start, memory.state
        if start is None or state is None or self._filter is None:
            return
        self.camera_clock.start_at(memory.time_offset_s, memory.news.time_offset_sigma_s)
        self._gravity.resume(start)
        vo = identity_motion(memory.t_ns, memory.keyframe_id, True, 0)
        self._filter.resume(state, vo, memory.news.filter_camera)

    def begin_in_map(self, keyframe_id: int, next_track_id: int) -> None:
        """Number keyframes and tracks on from those of a map, before the first frame; the first begins a new submap."""
        self._first_id = keyframe_id
        self.frontend.begin_at(keyframe_id, FrontNews(next_track_id), seeks_place=True)

    @property
    def start(self) -> StartFacts | None:
        """How gravity was found; None until then, or without an IMU."""
        return None if self.noise is None else self._gravity.start

    @property
    def initialisation(self) -> Initialisation | None:
        """The settled start; None until then, or without an IMU."""
        return None if self.noise is None else self._gravity.initialisation

    @property
    def newest_start(self) -> Initialisation | None:
        """The start that the filter goes by, provisional or settled; None without one."""
        return None if self.noise is None else self._gravity.newest_start

    @property
    def first_state(self) -> NavState | None:
        """The state of keyframe 0, once gravity is known."""
        return None if self.noise is None else self._gravity.first_state

    @property
    def last_refusal(self) -> str:
        """Why there is no first state, when it was last looked for."""
        return "no frame yet" if self.noise is None else self._gravity.last_refusal

    @property
    def news(self) -> FrontNews:
        """What was learned so far, beside the filter's state."""
        camera = None if self._filter is None else self._filter.camera
        return replace(self.frontend.news, time_offset_sigma_s=self.camera_clock.sigma_s, filter_camera=camera)

    def add(self, value: ImuSample | MagSample | Reading) -> None:
        """Take a sample of an inertial sensor, or a reading of another; the filter predicts at once."""
        if isinstance(value, MagSample):
            self._mag = value
            if self._readings is not None:
                self._readings.add_field(value)
        elif isinstance(value, Reading):
            if self._readings is not None:
                self._readings.add(value)
        elif self._has_imu and self._filter is not None and self._buffer.add(value):
            with self._clock.measure("ekf predict"):
                self._filter.ekf.predict(value)
            self.condition.add(value)
            if self._readings is not None and self._gravity.initialisation is not None:
                self._readings.hand_on(value.t_ns)

    def take_told_readings(self) -> list[ToldReading]:
        """Return what the filter was told by further sensors since this was asked last."""
        return [] if self._filter is None else self._filter.take_told_readings()

    def sensor_doubts(self) -> dict[str, str]:
        """Return, of further sensors that contradict the rest now, a word on how."""
        return {} if self._readings is None else self._readings.doubts()

    def add_hint(self, hint: Hint) -> None:
        """Tell the filter what holds a body while the camera sees nothing."""
        if self._filter is not None and isinstance(self._filter.ekf, Ekf):
            hint.apply(self._filter.ekf)

    def is_ready(self, frame_t_ns: int, newest_frame_t_ns: int) -> bool:
        """Whether a frame can be processed: an inertial sample newer than it is there, or none will come in time."""
        if not self._has_imu:
            return True
        newest = self._buffer.newest_t_ns
        waited_s = (newest_frame_t_ns - frame_t_ns) * 1e-9
        offset_ns = self.camera_clock.offset_ns(frame_t_ns)
        most_s = self.config.imu.max_wait_s + max(offset_ns, 0) * 1e-9
        return (newest is not None and newest > frame_t_ns + offset_ns) or waited_s > most_s

    def process(self, frame: Frame) -> FrontStep:
        """Track one frame, update the filter with it, and hand over keyframes that are ready."""
        self.feed.add(frame)
        frame = self.camera_clock.in_imu_time(frame)
        span = self._span(self._last_frame_t_ns, frame.t_ns)
        before = None if self._filter is None else self._filter.state
        with self._clock.measure("track"):
            track = self.frontend.track(frame, *self._without_bias(span, before), self._predicted(frame.t_ns, before))
            track = self._with_waypoint(frame, self._linked(frame, track))
            track = replace(track, vo=self.camera_clock.loosened(track.vo, span, before))
        self._track_noise.add(track.sigma_px, track.observations)
        still_image = self._has_imu and self._stillness.add(frame.t_ns, track.observations)
        at_rest = self._has_imu and self._rest.add(span) and self._stillness.resting
        self.feed.moved(at_rest)
        self._count(track, at_rest)
        if self.frontend.mode == "mono":
            self.uniform.add(span, before, at_rest)
            self._gravity.see(frame.t_ns, track.observations, at_rest)
        T_vo_keyframe_body = track.vo.T_keyframe_body if track.vo.has_scale else None
        if track.vo.T_keyframe_body is not None:
            self._T_vo_body = self._T_vo_keyframe @ scaled_motion(track.vo)
        with self._clock.measure("ekf"):
            ready = self._seek_gravity(span, track, still_image)
            estimate, state = self._correct(frame, track, at_rest, span)
        T_odom_body = None if estimate is None else estimate.T_odom_body
        if self._readings is not None:
            self._readings.see(frame.t_ns, T_odom_body)
        T_keyframe_body = self._since_keyframe(T_vo_keyframe_body, T_odom_body)
        if track.keyframe is not None:
            ready += self._take_keyframe(track, T_odom_body, state)
            T_keyframe_body = np.eye(4)
        self._last_frame_t_ns = frame.t_ns
        self._follow_clock(track.vo)
        told = [] if self._filter is None else self._filter.take_told()
        shown = self._publish(frame.t_ns, estimate)
        return FrontStep(frame, track, shown, estimate, state, self._keyframe_id, T_keyframe_body, ready, told)

    def feed_back(self, update: GraphUpdate) -> None:
        """Let the graph's biases correct the filter's, if the configuration wants that; the pose does not move."""
        self._graph_state = update.newest
        if self._filter is not None:
            self._filter.feed_back(update)

    def give_up_waiting(self) -> list[OdometryKeyframe]:
        """Return the keyframes that still wait for a settled start when the recording ends.

        With one camera a provisional start has to do, and without any the list is empty; else vision alone does.
        """
        if not self._has_imu or self._gravity.initialisation is not None:
            return []
        return self._take_released(self._gravity.give_up(self._T_upright))

    def report(self) -> FrontReport:
        """Return what there is to say of the run so far."""
        return FrontReport(
            self.frontend.mode, self.ekf_coupling if self.noise is not None else None, self.start, self.last_refusal,
            self.all_counters, self.nis_statistics,
            [] if self._floor is None else self._floor.warnings(self.config.imu.noise_tolerance),
            {} if self._floor is None else self._floor.summary(),
            self.uniform.longest_s, self.calibration,
            None if self.noise is None else self._gravity.scaled_from_ns,
            None if self._floor is None else self._floor.ratios,
            self.condition.condition() if self.noise is not None else None,
            self.noise,
            self._track_noise.summary(self._told_px),
            {} if self._readings is None else self._readings.report(),
        )  # fmt: skip

    @property
    def _told_px(self) -> dict[str, float]:
        """What estimators that see the tracks themselves are told of their pixels' noise."""
        config = self.config
        graph = {"graph": config.window.sigma_px} if config.graph.coupling == "tight" else {}
        is_tight = self._has_imu and self.ekf_coupling == "tight"
        return graph | ({"filter": config.ekf.tight_pixel_sigma_px} if is_tight else {})

    @property
    def calibration(self) -> dict[str, float]:
        """What was learned of the camera; see `learned_of_camera`."""
        camera = self.news.filter_camera
        return learned_of_camera(self.frontend, self.camera_clock, camera, self.config.ekf, self._has_imu)

    @property
    def all_counters(self) -> dict[str, dict[str, int]]:
        """Counters of this room and of those inside."""
        counters = {"front": dict(self.counters)}
        if self.noise is not None:
            counters["front"] |= {"imu_outages": self._buffer.outages, **self._gravity.counters}
        if self.frontend.mode == "mono":
            counters["front"]["frames_without_excitation"] = self.uniform.frames
        feed = self.feed
        counters["camera feed"] = {"frames": feed.frames, "missing": feed.missing, "repeated": feed.repeated}
        if self._has_imu:
            counters["imu"] = dict(self._buffer.counters)
            counters |= self._gravity.search_counters
            counters["camera clock"] = {"changes": self.camera_clock.changes}
        if self._filter is not None:
            counters["ekf"] = dict(self._filter.ekf.counters)
        if self._readings is not None:
            counters |= {f"sensor {name}": dict(counts) for name, counts in self._readings.counters.items()}
        return counters

    @property
    def nis_statistics(self) -> dict[str, tuple[int, float, int]]:
        """Innovations that the filter accepted, by measurement: count, sum of NIS, sum of degrees of freedom."""
        return {} if self._filter is None else self._filter.ekf.nis_statistics

    @property
    def noise_scale(self) -> NoiseScale:
        """White noise of the IMU over that of its model, as the newest samples show it."""
        return AS_MODELLED if self._floor is None else self._floor.now.scale

    @property
    def _floor(self) -> NoiseFloor | None:
        return self._buffer.noise_floor if self._has_imu else None

    def _linked(self, frame: Frame, track: TrackResult) -> TrackResult:
        """Return the track, tied to the keyframes of an earlier run where it begins anew."""
        memory, self._resumed = self._resumed, None
        if memory is not None and track.keyframe is None:  # too little to see there for a start: a lost keyframe
            self.frontend.begin_at(memory.keyframe_id + 1, memory.news)
            vo = identity_motion(frame.t_ns, memory.keyframe_id, track.vo.has_scale, 0)
            return replace(track, keyframe=unseen_keyframe(memory.keyframe_id, frame), vo=vo)
        is_alone = track.keyframe is not None and track.vo.keyframe_id == track.keyframe.id
        if memory is None and is_alone and self._keyframe_id >= 0:
            return replace(track, vo=lost_motion(frame.t_ns, self._keyframe_id, track.vo.has_scale))
        return track

    def _with_waypoint(self, frame: Frame, track: TrackResult) -> TrackResult:
        """Return the track, as that of a keyframe where vision gives none for long and the filter knows the way."""
        if self._readings is None or self._filter is None or self._gravity.holds_keyframes:
            return track
        state = self._filter.ekf.state_at(frame.t_ns)
        if state is None or not self._waypoints.wants(track.vo, track.keyframe is not None):
            return track
        if not self._bridged(frame.t_ns, self._buffer.span(self._keyframe_t_ns, frame.t_ns), state):
            return track
        self.counters["waypoints"] = self.counters.get("waypoints", 0) + 1
        keyframe = unseen_keyframe(self._keyframe_id + 1, frame)
        self.frontend.begin_at(keyframe.id + 1, FrontNews(self.frontend.news.next_track_id), seeks_place=True)
        return replace(track, keyframe=keyframe, vo=lost_motion(frame.t_ns, self._keyframe_id, track.vo.has_scale))

    def _span(self, from_t_ns: int | None, to_t_ns: int) -> ImuSpan | None:
        if not self._has_imu or from_t_ns is None:
            return None
        return self._buffer.unbroken(from_t_ns, to_t_ns)

    def _without_bias(self, span: ImuSpan | None, state: NavState | None) -> tuple[ImuSpan | None, float]:
        """Return the span with the filter's biases taken off, and how well the gyroscope's is known."""
        if span is None or state is None:
            return span, np.inf
        sigma_rad_s = float(np.sqrt(np.diag(state.covariance)[9:12].max())) + self.camera_clock.gyro_sigma_rad_s(span)
        return subtract_bias(span, state.gyro_bias_rad_s, state.accel_bias_m_s2), sigma_rad_s

    def _predicted(self, t_ns: int, state: NavState | None) -> Array | None:
        """Return the motion since the last frame where the filter knows it to centimetres."""
        if self._filter is None or state is None or self._last_frame_t_ns is None:
            return None
        dt_s = (t_ns - self._last_frame_t_ns) * 1e-9
        if np.sqrt(np.trace(state.covariance[6:9, 6:9])) * dt_s > _KNOWN_MOTION_M:
            return None
        return self._filter.motion(self._last_frame_t_ns, t_ns)

    def _follow_clock(self, vo: VoMeasurement) -> None:
        """Learn the camera's time offset; what waits for gravity is stamped anew, what left stays as it was."""
        if not self._has_imu:
            return
        refused = self._gravity.take_refused()
        if refused is not None and np.isfinite(refused.time_offset_sigma_s):
            self._shift(self.camera_clock.tell(refused.time_offset_s, refused.time_offset_sigma_s))
        else:
            self._shift(self.camera_clock.follow(vo, self._buffer, self._gravity.initialisation is not None))

    def _shift(self, shift_ns: int) -> None:
        """Bring what waits for gravity to the time that a change of the camera's offset gives it."""
        if shift_ns == 0 or self._gravity.initialisation is not None or self._last_frame_t_ns is None:
            return
        self._gravity.restamp(shift_ns)
        self._last_frame_t_ns += shift_ns
        self._keyframe_t_ns += shift_ns
        self.camera_clock.took_keyframe()

    def _count(self, track: TrackResult, at_rest: bool) -> None:
        is_lost = track.vo.tracking == Tracking.LOST
        self.counters["frames_lost"] += is_lost
        self._lost_since_ns = (self._lost_since_ns or track.vo.t_ns) if is_lost else None
        if self._lost_since_ns is not None:
            lasted_ms = (track.vo.t_ns - self._lost_since_ns) // 1_000_000
            self.counters["longest_loss_ms"] = max(self.counters["longest_loss_ms"], lasted_ms)
        self.counters["frames_degraded"] += track.vo.tracking == Tracking.DEGRADED
        self.counters["frames_at_rest"] += at_rest
        if track.by_depth:
            self.counters["frames_by_depth"] = self.counters.get("frames_by_depth", 0) + 1
        self._rested_since_keyframe = self._rested_since_keyframe and at_rest

    def _seek_gravity(self, span: ImuSpan | None, track: TrackResult, still_image: bool) -> list[OdometryKeyframe]:
        """Look for the first gravity-aligned state; once it is settled, return what waited for it."""
        if self._filter is None:
            return []
        offset_sigma_s = self.camera_clock.sigma_s
        return self._take_released(self._gravity.seek(span, track, still_image, self._T_vo_body, offset_sigma_s))

    def _take_released(self, released: Released | None) -> list[OdometryKeyframe]:
        """Return the keyframes that waited, and place the newest one in `odom`."""
        if released is None:
            return []
        self._T_odom_keyframe = released.place(self._keyframe_t_ns, self._T_vo_keyframe)
        return released.keyframes

    def _correct(
        self, frame: Frame, track: TrackResult, at_rest: bool, span: ImuSpan | None
    ) -> tuple[Estimate | None, NavState | None]:
        """Return the pose in `odom` and the filter's state after this frame."""
        if self._filter is None:
            T_vo_body = self._T_vo_body.copy()
            return Estimate(T_vo_body, T_vo_body, np.inf), None
        ekf = self._filter.ekf
        if not ekf.initialised:
            return None, None
        keyframe_id = None if track.keyframe is None else track.keyframe.id
        assert self._floor is not None
        self._filter.see(
            frame.t_ns, track.vo, track.observations, at_rest, keyframe_id, self.uniform.shows_scale, self._floor.now
        )
        after, state = ekf.pose_at(frame.t_ns), ekf.state_at(frame.t_ns)
        if after is None:
            after = self._without_filter(track.vo)
        self._T_odom_body = after
        if after is None:
            return None, state
        last, self._last_state = self._last_state, state
        is_blind = self.config.ekf.vision == "none"  # nothing corrects it, and the graph's bias is not to turn it
        if is_blind or state is None or last is None or span is None or span.t_ns[0] != last.t_ns:
            return Estimate(after, after, 0.0), state
        walk = 0.0 if self.noise is None else self.noise.gyroscope_random_walk
        gyro_bias, sigma_rad_s = surer_gyro_bias(last, self._graph_state, walk)
        before = _uncorrected(replace(last, gyro_bias_rad_s=gyro_bias), span, self.config.machine.gravity_m_s2, at_rest)
        return Estimate(before, after, sigma_rad_s), state

    def _publish(self, t_ns: int, estimate: Estimate | None) -> Array | None:
        """Return the pose in `odom`, where it is to be continuous without the jumps of corrections."""
        if estimate is None:
            return None
        before, after, sigma_rad_s = estimate.T_odom_before, estimate.T_odom_body, estimate.rate_sigma_rad_s
        return self._published.follow(t_ns, before, after, sigma_rad_s)

    def _without_filter(self, vo: VoMeasurement) -> Array | None:
        """Return the pose in `odom` where inertial data stopped before the frame: vision carries the last one on."""
        if self._T_odom_keyframe is None or vo.T_keyframe_body is None:
            return self._T_odom_body
        return self._T_odom_keyframe @ scaled_motion(vo)

    def _since_keyframe(self, T_vo_keyframe_body: Array | None, T_odom_body: Array | None) -> Array | None:
        if T_vo_keyframe_body is not None:
            return T_vo_keyframe_body
        is_settled = self._filter is not None and not self._gravity.holds_keyframes
        if is_settled and T_odom_body is not None and self._T_odom_keyframe is not None:
            return invert(self._T_odom_keyframe) @ T_odom_body
        return None

    def _take_keyframe(
        self, track: TrackResult, T_odom_body: Array | None, state: NavState | None
    ) -> list[OdometryKeyframe]:
        """Pack a new keyframe with all that the back end needs of it; return it unless it has to wait for gravity."""
        keyframe = track.keyframe
        assert keyframe is not None
        imu = None
        if self._has_imu and self._keyframe_id >= 0:
            imu = self._buffer.span(self._keyframe_t_ns, keyframe.t_ns)
        at_rest = self._rested_since_keyframe and self._keyframe_id >= 0
        begins_submap = track.vo.tracking is Tracking.LOST and not self._bridged(keyframe.t_ns, imu, state)
        begins_submap = begins_submap or keyframe.id == self._first_id > 0
        self.counters["submaps"] += begins_submap
        packet = KeyframePacket(
            keyframe, track.vo, track.observations, imu, self._mag, at_rest, self.camera_clock.applied_s, begins_submap
        )
        if self._readings is not None and not (self._has_imu and self._gravity.holds_keyframes):
            packet = self._waypoints.marked(self._readings.pack(packet, self._keyframe_t_ns, state), state)
        self.camera_clock.took_keyframe()
        self._keyframe_variance_m2 = _variance_m2(state)
        self._keyframe_id, self._keyframe_t_ns = keyframe.id, keyframe.t_ns
        self._rested_since_keyframe, self._mag = True, None
        self._T_vo_keyframe = self._T_vo_body.copy()
        self._T_odom_keyframe = T_odom_body
        if T_odom_body is not None and not (self._has_imu and self._gravity.holds_keyframes):
            return [OdometryKeyframe(packet, T_odom_body)]
        self._gravity.hold(OdometryKeyframe(packet, self._T_vo_body.copy()), T_odom_body)
        return self._give_up_if_late(keyframe.t_ns)

    def _bridged(self, t_ns: int, imu: ImuSpan | None, state: NavState | None) -> bool:
        """Return whether inertial data tell where a keyframe is from the one before, which vision has lost.

        `state` is the filter's at the keyframe.
        """
        if imu is None:
            return False
        if not np.isfinite(self._keyframe_variance_m2):
            return (t_ns - self._keyframe_t_ns) * 1e-9 <= _BLIND_S
        grown_m2 = _variance_m2(state) - self._keyframe_variance_m2
        return bool(grown_m2 <= self.config.ekf.submap_sigma_m**2)

    def _give_up_if_late(self, now_t_ns: int) -> list[OdometryKeyframe]:
        """Go on without the IMU when gravity could not be found for too long; keyframes must not wait for ever."""
        if not self._gravity.is_late(now_t_ns):
            return []
        if self.frontend.mode == "mono":
            return self._take_released(self._gravity.give_up_scale(now_t_ns))
        self.counters["imu_given_up"] = 1
        self._filter, self._has_imu = None, False
        if self._readings is not None:
            self._readings.give_up_filter()
        released = self._take_released(self._gravity.give_up(self._T_upright))
        self._T_vo_keyframe, self._T_vo_body = self._T_upright @ self._T_vo_keyframe, self._T_upright @ self._T_vo_body
        return released


def _variance_m2(state: NavState | None) -> float:
    """Return how unsure a filter is of where the body is; infinite before it has a state."""
    return np.inf if state is None else float(np.trace(state.covariance[3:6, 3:6]))


def _uncorrected(last: NavState, span: ImuSpan, gravity_m_s2: float, at_rest: bool) -> Array:
    """Return the pose [4, 4] after a span by inertial data alone.

    A correction may enter with a later sample only, so what the filter was told is no measure of it.
    """
    after = pose_after(last, span, gravity_m_s2)
    way_m = float(np.linalg.norm(after[:3, 3] - last.T_world_body[:3, 3]))
    sways = way_m < _SWAY_M_S * (int(span.t_ns[-1]) - int(span.t_ns[0])) * 1e-9
    return last.T_world_body if at_rest and sways else after
