"""What the front half has to say of a whole run, as plain values for metrics, report and verdict."""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vislam.config import EkfConfig, InitConfig
from vislam.core.geometry import so3_exp
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import StartFacts
from vislam.core.messages import Array, Frame, ImuSample, ImuSpan, MagSample, NavState, Tracking
from vislam.core.readings import Reading
from vislam.core.streams import StreamEvent
from vislam.frontend import TrackResult, knows_scale
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.intake import CameraFeed
from vislam.frontend.masks import Masks
from vislam.frontend.pixel_noise import NoiseUsed
from vislam.frontend.time_offset import TURN_SIGMA
from vislam.imu import InertialCondition, NoiseRatios
from vislam.pipeline.dark import dark
from vislam.pipeline.gravity import Phase
from vislam.pipeline.turn_witness import turn_witnesses
from vislam.sensors import Suite
from vislam.trajectory import Alignment, gauge_alignment

if TYPE_CHECKING:
    from vislam.pipeline.front import Front

_PIECE_S = 0.2  # over which force is averaged: noise and vibration show no scale
_PIECES = 20  # 4 s, the longest that the search for a first scale looks at, too
_NUMBER = re.compile(r"\d+(\.\d+)?")
_MOST_REASONS = 50  # that are counted separately
# a run whose quietest second has less than a third of the white noise given is warned
_NOISE_TOLERANCE = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class FrontReport:
    """What the front half has to say of a whole run."""

    mode: str  # of the front end
    coupling: str | None  # of the filter; None without an IMU
    start: StartFacts | None  # how gravity was found; None: it was not, or there is no IMU
    refusal: str  # why there was no first state, when last tried
    counters: dict[str, dict[str, int]]
    nis: dict[str, tuple[int, float, int]]  # innovations that the filter accepted, see `Ekf.nis_statistics`
    noise_warnings: list[str]
    imu_noise: dict[str, dict[str, float]]  # white noise of the IMU: stated, and as the samples showed it
    uniform_s: float  # longest stretch without motion that shows scale
    calibration: dict[str, float]  # what was learned of the camera
    scaled_from_ns: int | None = None  # before, poses of one camera have no scale; None: all have
    noise_ratios: NoiseRatios | None = None  # white noise seen over that of the model; None without an IMU
    condition: InertialCondition | None = None  # of the IMU; None without one
    stated_noise: ImuNoise | None = None  # of the IMU
    track_noise: dict[str, Any] = field(default_factory=dict)  # of pixels: what tracks showed, and what was used for it
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)  # further ones, see `ReadingIntake.report`
    shared_errors: Mapping[str, tuple[float, tuple[float, ...], float]] = field(default_factory=dict)  # by the filter
    first_t_ns: int = 0  # of the first frame
    is_confirmed: bool = True  # the start, by what came after it
    lost_reason: str = ""  # why vision lost most of the frames that it lost
    events: tuple[StreamEvent, ...] = ()  # what happened in the streams of camera and IMU
    turns: tuple[tuple[Array, Array], ...] = ()  # the last large ones [3, 3] of the body, by gyroscope and by vision

    @property
    def alignment(self) -> Alignment:
        """How the run may be moved onto a truth."""
        return gauge_alignment(self.start is not None, knows_scale(self.mode))


class UniformMotion:
    """Measures the excitation of the motion as the initialisation does: the rms change of acceleration.

    Attributes:
        frames: how many frames came while it was less than the initialisation asks for.
        longest_s: the longest time in a row that it was.
    """

    def __init__(self, config: InitConfig) -> None:
        """Take the least excitation."""
        self._least_m_s2 = config.min_excitation_m_s2
        self._forces: deque[Array] = deque(maxlen=_PIECES)  # [3] m/s^2 in odom
        self._sum_m_s: Array = np.zeros(3)
        self._piece_s = 0.0
        self._lasted_s = 0.0
        self.frames = 0
        self.longest_s = 0.0

    @property
    def shows_scale(self) -> bool:
        """Whether the last 4 s show scale, or are not yet over."""
        return self._lasted_s == 0.0

    def add(self, span: ImuSpan | None, state: NavState | None, at_rest: bool) -> None:
        """Take a frame's inertial span and the filter's state at its end; rest and outages start the 4 s again."""
        if span is None or state is None or at_rest:
            self._forces.clear()
            self._sum_m_s, self._piece_s, self._lasted_s = np.zeros(3), 0.0, 0.0
            return
        dt_s = float(span.t_ns[-1] - span.t_ns[0]) * 1e-9
        rate = span.gyro_rad_s.mean(axis=0) - state.gyro_bias_rad_s
        R_middle = state.T_world_body[:3, :3] @ so3_exp(-0.5 * dt_s * rate)
        self._sum_m_s = self._sum_m_s + dt_s * (R_middle @ span.accel_m_s2.mean(axis=0))
        self._piece_s += dt_s
        if self._piece_s >= _PIECE_S:
            self._forces.append(self._sum_m_s / self._piece_s)
            self._sum_m_s, self._piece_s = np.zeros(3), 0.0
        if len(self._forces) < _PIECES:
            return
        change = np.asarray(self._forces) - np.mean(self._forces, axis=0)
        if np.sqrt(np.mean(np.sum(change * change, axis=1))) >= self._least_m_s2:
            self._lasted_s = 0.0
            return
        self.frames += 1
        self._lasted_s = max(self._lasted_s, _PIECES * _PIECE_S) + dt_s
        self.longest_s = max(self.longest_s, self._lasted_s)


class RunWatch:
    """Collects what becomes of a run's frames, for its report.

    Attributes:
        counters: what became of frames.
        feed: what the camera delivered.
        tracks: what was seen of their noise.
        uniform: how long one camera has moved without showing scale.
        drives: for each sensor of what drives, whether it turns as the gyroscope has it.
    """

    def __init__(self, config: InitConfig, knows_scale: bool, masks: Masks, suite: Suite | None = None) -> None:
        """Start before the first frame; `knows_scale` is whether vision measures metres, `suite` further sensors."""
        self.counters = {
            "frames_lost": 0, "frames_degraded": 0, "longest_loss_ms": 0, "imu_outages": 0, "frames_at_rest": 0,
            "submaps": 1,
        }  # fmt: skip
        self.feed, self.tracks, self.uniform = CameraFeed(), NoiseUsed(), UniformMotion(config)
        self._knows_scale, self._masks, self.drives = knows_scale, masks, turn_witnesses(suite)
        self._lost_since_ns: int | None = None
        self._why_lost = Counter[str]()

    def hear(self, value: ImuSample | MagSample | Reading) -> None:
        """Take what comes of any sensor but the camera."""
        for one in self.drives:
            one.hear(value)

    def see(self, frame: Frame) -> Frame:
        """Take a frame as the camera gave it; return it as it can be used, masked; one that is frozen shows nothing."""
        if not frame.images and frame.tracks is None:  # there is no camera
            self.feed.count(frame)
            return frame
        seen = self.feed.add(frame)
        if self.feed.is_frozen:
            return replace(dark(frame, frame.t_ns), follows_step=frame.follows_step)
        return self._masks.onto(seen)

    def note(self, track: TrackResult, span: ImuSpan | None, state: NavState | None, at_rest: bool) -> None:
        """Take what became of the frame that `feed` has.

        Args:
            track: what vision made of it.
            span: inertial data since the frame before; None: no IMU, or a hole.
            state: the filter's before the frame.
            at_rest: whether the body rested over it.
        """
        self.feed.moved(at_rest, track.others > 0)
        self.tracks.add(track.sigma_px, track.observations)
        if not self._knows_scale:
            self.uniform.add(span, state, at_rest)
        counters, is_lost = self.counters, track.vo.tracking is Tracking.LOST
        counters["frames_lost"] += is_lost
        if is_lost and (why := _NUMBER.sub("N", track.reason)):
            self._why_lost[why if len(self._why_lost) < _MOST_REASONS else ""] += 1
        self._lost_since_ns = (self._lost_since_ns or track.vo.t_ns) if is_lost else None
        if self._lost_since_ns is not None:
            lasted_ms = (track.vo.t_ns - self._lost_since_ns) // 1_000_000
            counters["longest_loss_ms"] = max(counters["longest_loss_ms"], lasted_ms)
        counters["frames_degraded"] += track.vo.tracking is Tracking.DEGRADED
        counters["frames_at_rest"] += at_rest
        if track.by_depth:
            counters["frames_by_depth"] = counters.get("frames_by_depth", 0) + 1

    @property
    def lost_reason(self) -> str:
        """Why vision lost most of the frames that it lost, N for numbers; empty where it lost none."""
        return max(self._why_lost, key=self._why_lost.__getitem__, default="")

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """All that was counted, by what it is about."""
        front, feed = dict(self.counters), self.feed
        if not self._knows_scale:
            front["frames_without_excitation"] = self.uniform.frames
        return {
            "front": front,
            "camera feed": {name: getattr(feed, name) for name in ("frames", "missing", "repeated", "frozen")},
            **({"masks": dict(self._masks.problems)} if self._masks.problems else {}),
        }


def report_of(front: Front) -> FrontReport:
    """Return what there is to say of a run so far."""
    imu, begun = front.inertial, front.begun
    events = [*front.watch.feed.events, *([] if imu is None else imu.buffer.events)]
    report = FrontReport(
        front.frontend.mode, None, front.start, begun.refusal, _counters(front), {}, [], {},
        front.watch.uniform.longest_s, _learned_of_camera(front), begun.scaled_from_ns, stated_noise=front.noise,
        track_noise=front.watch.tracks.summary(_given_px(front)),
        sensors=_sensors(front),
        first_t_ns=front.watch.feed.first_t_ns or 0, lost_reason=front.watch.lost_reason,
        is_confirmed=not (front.gravity and front.gravity.counters.get("start_unconfirmed")),
        events=tuple(sorted(events, key=lambda event: event.from_ns)),
    )  # fmt: skip
    if imu is None:
        return report
    report = replace(report, coupling=imu.filtering.coupling, condition=imu.condition.condition(), turns=imu.turns)
    floor = imu.buffer.noise_floor
    if begun.phase is Phase.VISION_ALONE or floor is None:
        return report
    return replace(
        report, nis=imu.filtering.ekf.nis_statistics, shared_errors=imu.filtering.ekf.shared_errors,
        noise_warnings=floor.warnings(_NOISE_TOLERANCE),
        imu_noise=floor.summary(), noise_ratios=floor.ratios,
    )  # fmt: skip


def _sensors(front: Front) -> dict[str, dict[str, Any]]:
    """Return what is known of further sensors, by name."""
    found = {} if front.readings is None else front.readings.report()
    for one in front.watch.drives:
        found[one.name] |= one.report()
    return found


def _counters(front: Front) -> dict[str, dict[str, int]]:
    """Return the counters of the front half and of those inside."""
    counters, imu, gravity = front.watch.counts, front.inertial, front.gravity
    if imu is not None and gravity is not None:
        counters["front"] |= {"imu_outages": imu.buffer.outages, **gravity.counters}
        if front.begun.phase is not Phase.VISION_ALONE:
            counters["imu"] = dict(imu.buffer.counters)
            counters |= gravity.search_counters
            counters["camera clock"] = {"changes": front.camera_clock.changes}
            counters["ekf"] = dict(imu.filtering.ekf.counters)
    if front.readings is not None:
        counters |= {f"sensor {name}": dict(counts) for name, counts in front.readings.counters.items()}
    return counters


def _given_px(front: Front) -> dict[str, float]:
    """Return the noise of pixels that estimators which see the tracks themselves are given."""
    config = front.config
    graph = {"graph": config.window.sigma_px} if config.graph.coupling == "tight" else {}
    is_tight = front.begun.phase is not Phase.VISION_ALONE and config.ekf.coupling == "tight"
    return graph | ({"filter": config.ekf.tight_pixel_sigma_px} if is_tight else {})


def _learned_of_camera(front: Front) -> dict[str, float]:
    """Return what was learned of the camera, with standard deviations: clock and turn, and over a floor its mount."""
    mount = front.frontend.calibration
    if front.begun.phase is Phase.VISION_ALONE:
        return mount
    clock = front.camera_clock
    found = {"camera_offset_s": clock.applied_s, "camera_offset_sigma_s": clock.sigma_s}
    if clock.jitter_s > 0.0:
        found["stamp_jitter_s"] = clock.jitter_s
    if clock.drift_sigma > 0.0:
        found |= {"camera_drift": clock.drift, "camera_drift_sigma": clock.drift_sigma}
    return found | _turned(clock, front.learned.filter_camera, front.config.ekf) | mount


def _turned(clock: CameraClock, filter_camera: Array | None, config: EkfConfig) -> dict[str, float]:
    """Return by how much the camera is turned on the body against its calibration, in degrees, by rotations.

    `filter_camera` [8] is what the filter learned, see `Filtering.camera`.
    """
    found = clock.estimate
    turn, sigmas, prior_deg = found.R_correction, found.R_correction_sigma, float(np.rad2deg(TURN_SIGMA))
    if filter_camera is not None and filter_camera[5:8].all():
        turn, sigmas, prior_deg = filter_camera[2:5], filter_camera[5:8], config.tight_extrinsic_sigma_deg
    elif not found.frames:
        return {}
    angle = float(np.linalg.norm(turn))
    along = turn / max(angle, 1e-12)
    sigma = float(np.sqrt(np.sum((along * sigmas) ** 2)))
    return {
        "camera_turn_deg": float(np.rad2deg(angle)),
        "camera_turn_sigma_deg": float(np.rad2deg(sigma)),
        "camera_turn_prior_deg": prior_deg,
    }
