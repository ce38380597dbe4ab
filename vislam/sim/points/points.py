"""Simulated vision as a recording: inertial data, real or simulated, and tracks of landmarks around the true path.

With the real IMU of a recording that has truth but no images, everybody can test an estimator on real inertial data;
with a simulated motion, an hour costs seconds. Frames carry `tracks` and no images.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vislam.config import validated
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array, Frame, FurtherTracks, ImuSample, Observations
from vislam.imu import ImuNoise
from vislam.sim.faults.disturbance import in_window
from vislam.sim.motion.measured import MeasuredMotion
from vislam.sim.motion.motions import POINT_WORLDS, vi_sensor_rig, world_motion, world_rig
from vislam.sim.motion.spline import BodySpline
from vislam.sim.points.followed import LandmarkField, SimulatedTracker
from vislam.sim.sensing import CONSUMER_IMU, sense_imu
from vislam.sim.worlds.simulation import TrueStates
from vislam.sim.worlds.table import WORLDS, surrounded
from vislam.trajectory import Trajectory
from vislam.trajectory.truth_fit import TruthFit

Stamps = NDArray[np.int64]
_Share = Annotated[float, Field(ge=0.0, lt=1.0)]
_Seconds = Annotated[float, Field(ge=0.0)]
_WORLD_ZERO_NS = 1_000_000_000_000
_MARGIN_S = 0.05  # frames keep this distance from the ends of the motion
_TRUTH_STEP_S = 0.01  # so dense that a straight line between poses is exact enough
_PATH_STEP_S = 0.1  # of the path around which landmarks are placed
_AXIS = np.array([0.6, -0.64, 0.48])  # about which stated and true extrinsics differ, in the camera's axes
_ID_BITS = 40  # of a track, below its camera
_AT_ONCE = 2000  # poses evaluated in one go
_CHUNK = 4000  # samples made at once


class RecordedImu:
    """The samples of a recording between two stamps, and the next one on either side."""

    def __init__(self, t_ns: Stamps, gyro_rad_s: Array, accel_m_s2: Array, begin_ns: int, end_ns: int) -> None:
        """Take samples at times [N], gyro and accel [N, 3]."""
        first = max(int(np.searchsorted(t_ns, begin_ns, "right")) - 1, 0)
        used = slice(first, int(np.searchsorted(t_ns, end_ns)) + 1)
        self._t_ns, self._gyro, self._accel = t_ns[used], gyro_rad_s[used], accel_m_s2[used]

    def samples(self) -> Iterator[ImuSample]:
        """Yield the samples in time order; can be called again and yields the same again."""
        for t_ns, gyro, accel in zip(self._t_ns.tolist(), self._gyro, self._accel, strict=True):
            yield ImuSample(t_ns, gyro, accel)

    def biases(self, t_ns: Stamps) -> tuple[Array, Array]:
        """Return gyro and accelerometer biases [N, 3] at times [N]: NaN, they are unknown of a real IMU."""
        return np.full((len(t_ns), 3), np.nan), np.full((len(t_ns), 3), np.nan)


class SimulatedImu:
    """A simulated IMU on a spline; the samples are made in pieces, so that an hour needs little memory."""

    def __init__(
        self,
        motion: BodySpline,
        zero_ns: int,
        span_s: tuple[float, float],
        noise: ImuNoise,
        gravity_m_s2: float,
        seed: np.random.SeedSequence,
        disturbed: bool,
    ) -> None:
        """Sense a motion over a span of its seconds; `zero_ns` is the stamp of second 0. See `sense_imu`."""
        self._motion, self._zero_ns, self._noise, self._gravity = motion, zero_ns, noise, gravity_m_s2
        self._disturbed = disturbed
        count = int(np.floor((span_s[1] - span_s[0]) * noise.rate_hz + 1e-9)) + 1
        self._t_ns: Stamps = np.round((span_s[0] + np.arange(count) / noise.rate_hz) * 1e9).astype(np.int64)
        self._seeds = seed.spawn(-(-count // _CHUNK))

    def samples(self) -> Iterator[ImuSample]:
        """Yield the samples in time order; can be called again and yields the same again."""
        for t_ns, values in self._pieces():
            for t, row in zip((t_ns + self._zero_ns).tolist(), values, strict=True):
                yield ImuSample(t, row[:3], row[3:6])

    def biases(self, t_ns: Stamps) -> tuple[Array, Array]:
        """Return gyro and accelerometer biases [N, 3] in the samples at times [N], interpolated."""
        known = np.concatenate([values[:, 6:] for _, values in self._pieces()])
        columns = [np.interp(t_ns - self._zero_ns, self._t_ns, column) for column in known.T]
        return np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1)

    def _pieces(self) -> Iterator[tuple[Stamps, Array]]:
        """Yield times [n] and gyro, accel, gyro bias, accel bias [n, 12]; biases walk on from piece to piece."""
        last: Array | None = None
        for index, seed in enumerate(self._seeds):
            t_ns = self._t_ns[index * _CHUNK : (index + 1) * _CHUNK]
            rng = np.random.default_rng(seed)
            motion = self._motion.at(t_ns.astype(np.float64) * 1e-9)
            record = sense_imu(motion, self._noise, self._gravity, rng, self._disturbed)
            biases = np.hstack([record.gyro_bias_rad_s, record.accel_bias_m_s2])
            # every piece has a turn-on value of its own: only that of the first one counts
            shift = np.zeros(6) if last is None else last - biases[0]
            values = np.hstack([record.gyro_rad_s, record.accel_m_s2]) + shift
            biases = biases + shift
            last = biases[-1]
            yield t_ns, np.hstack([values, biases])


@dataclass(frozen=True, slots=True)
class PointOptions:
    """What can be chosen about simulated vision; times count from the first frame."""

    rig: Literal["mono", "stereo", "rgbd", "none"] = "stereo"  # none: no camera
    further_cameras: Annotated[int, Field(ge=0, le=6)] = 0  # beside those, evenly around the vertical
    start_s: _Seconds = 0.0  # into the recording or motion
    duration_s: Annotated[float, Field(ge=0.5)] | None = None  # None: all there is; for point worlds their usual
    camera_hz: Annotated[float, Field(gt=0.1, le=120.0)] = 20.0
    tracks: Annotated[int, Field(ge=0, le=2000)] = 200  # at any time, as far as landmarks are in view
    pixel_sigma_px: Annotated[float, Field(ge=0.0, le=20.0)] = 1.0  # white, on every pixel
    stereo_sigma_px: Annotated[float, Field(ge=0.0, le=20.0)] = 0.3  # of the match; the right pixel shares the left's
    outlier_share: _Share = 0.05  # of the tracks: 70 % slipped onto another landmark and stay, 30 % jump for a frame
    dropout_share: _Share = 0.02  # of the tracks: not found in a frame, but in the next
    track_life_s: Annotated[float, Field(gt=0.05)] = 4.0  # mean, within the image
    distortion: bool = True  # of the lenses
    descriptors: bool = True  # that recognise a landmark when it is seen again; without, no loops
    lost_share: _Share = 0.0  # of the frames: they never arrive
    outage_begin_s: _Seconds = 0.0  # frames without a single track of the first camera, or pair ...
    outage_length_s: _Seconds = 0.0  # ... for so long ...
    outage_every_s: _Seconds = 0.0  # ... and again after so long; 0: once
    moving_share: _Share = 0.0  # of the image: filled by a person who walks to and fro
    moving_begin_s: _Seconds = 0.0
    moving_length_s: _Seconds | None = None  # None: to the end
    time_offset_s: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0  # to be added to a frame's stamp to get the IMU's
    extrinsic_rotation_deg: Annotated[float, Field(ge=-20.0, le=20.0)] = 0.0  # between the stated rig and the true one
    readout_s: Annotated[float, Field(ge=0.0, le=0.05)] = 0.0  # from first to last row; the stamp is the middle row's
    imu_noise_factor: Annotated[float, Field(gt=0.0)] = 1.0  # what is stated of the IMU's noise, relative to the truth
    imu_noise: bool = True  # of a simulated IMU; False: exact
    gravity_m_s2: float = 9.81  # of a simulated IMU
    world_seed: int = 0  # of the landmarks; `seed` is that of motion and sensors


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredInertial:
    """A real recording without its images."""

    name: str
    t_ns: Stamps  # [N]
    gyro_rad_s: Array  # [N, 3]
    accel_m_s2: Array  # [N, 3]
    noise: ImuNoise
    truth: Trajectory  # of the body, which is the IMU
    rig: Rig | None  # its own cameras, if it has any
    truth_fit: TruthFit | None = None  # what was undone in `truth`; None: it is as it came


def open_points(source: str | MeasuredInertial, seed: int = 0, **options: object) -> PointRecording:
    """Return simulated vision in a world (by name, of `POINT_WORLDS` or `WORLDS`) or on a real recording's IMU.

    Raises UsageError for an unknown world, and for an unknown or ill-typed option (see `PointOptions`); DataError when
    the recording's truth does not suffice.
    """
    return PointRecording(source, seed, validated(PointOptions, options, "simulated vision"))


class PointRecording:
    """A recording (see `vislam.core.recording.Recording`) whose frames carry tracks; the same each time.

    Attributes:
        true_rig: the cameras that projected the landmarks; `rig` is what the estimator is given.
        motion: the body's true motion; its seconds count from `zero_ns`.
        field: the landmarks.
    """

    def __init__(self, source: str | MeasuredInertial, seed: int = 0, options: PointOptions | None = None) -> None:
        """Prepare motion, landmarks and the times of frames; tracks and simulated samples are made while reading."""
        self.options = options = options or PointOptions()
        motion_seed, imu_seed, loss_seed, self._track_seed = np.random.SeedSequence(seed).spawn(4)
        self.problems: dict[str, int] = {}
        self.motion: BodySpline | MeasuredMotion
        self._imu: RecordedImu | SimulatedImu
        if isinstance(source, str):
            self._take_world(source, np.random.default_rng(motion_seed), imu_seed)
        else:
            self._take_recording(source)
        self._set_rigs()
        t_s = self._frame_times()
        lost = np.random.default_rng(loss_seed).random(len(t_s)) < options.lost_share
        self._frame_s = t_s[~lost] if options.rig != "none" else t_s[:0]
        self.frame_count = len(self._frame_s)
        path = self.motion.at(_steps(self._begin_s, self._end_s, _PATH_STEP_S)).T_world_body
        cam0 = (path @ self.true_rig.T_body_cam0)[:, :3, 3]
        self.field = LandmarkField(cam0, np.random.default_rng(np.random.SeedSequence(options.world_seed)))

    # -- where motion and inertial data come from --------------------------------------------------------------------

    def _take_world(self, name: str, rng: np.random.Generator, imu_seed: np.random.SeedSequence) -> None:
        options = self.options
        if name not in POINT_WORLDS and name not in WORLDS:
            raise UsageError(
                f"no world '{name}'; there are: {', '.join((*POINT_WORLDS, *WORLDS))}, or give a recording"
            )
        wanted = None if options.duration_s is None else options.start_s + options.duration_s
        motion = world_motion(name, rng, wanted)
        self.name, self.motion, self.zero_ns = f"points-{name}", motion, _WORLD_ZERO_NS
        self._set_span(0.0, motion.duration_s)
        self._base_rig = world_rig(name)
        disturbed = options.imu_noise
        self._imu = SimulatedImu(
            motion, self.zero_ns, (self._begin_s, self._end_s), CONSUMER_IMU, options.gravity_m_s2, imu_seed, disturbed
        )
        self.imu_noise: ImuNoise | None = _stated(CONSUMER_IMU, options.imu_noise_factor)

    def _take_recording(self, recorded: MeasuredInertial) -> None:
        motion = MeasuredMotion(recorded.t_ns, recorded.gyro_rad_s, recorded.accel_m_s2, recorded.truth)
        self.name, self.motion, self.zero_ns = f"points-{recorded.name}", motion, motion.zero_ns
        self._set_span(motion.begin_s, motion.end_s)
        own = recorded.rig
        self._base_rig = own if own is not None and own.is_stereo else vi_sensor_rig()
        span_ns = (self._ns(np.array([self._begin_s, self._end_s]))).tolist()
        self._imu = RecordedImu(recorded.t_ns, recorded.gyro_rad_s, recorded.accel_m_s2, span_ns[0], span_ns[1])
        self.imu_noise = _stated(recorded.noise, self.options.imu_noise_factor)
        if recorded.truth_fit is not None and recorded.truth_fit.summary:
            self.problems[f"{recorded.truth_fit.summary}: undone"] = 1

    def _set_span(self, begin_s: float, end_s: float) -> None:
        options = self.options
        self._begin_s = begin_s + options.start_s
        self._end_s = end_s if options.duration_s is None else self._begin_s + options.duration_s
        if self._end_s > end_s + 1e-6 or self._end_s - self._begin_s < 4.0 * _MARGIN_S:
            raise UsageError(
                f"{self.name} lasts {end_s - begin_s:.1f} s, asked for {options.duration_s or 0.0:g} s from "
                f"{options.start_s:g} s on; choose another start_s or duration_s"
            )
        self._end_s = min(self._end_s, end_s)
        self.duration_s = self._end_s - self._begin_s

    def _set_rigs(self) -> None:
        base, options = self._base_rig, self.options
        cameras = base.cameras if options.distortion else tuple(_undistorted(camera) for camera in base.cameras)
        if options.rig == "none":
            self.true_rig = self.rig = Rig((), ())
            return
        count = 2 if options.rig == "stereo" else 1
        self.true_rig = Rig(cameras[:count], base.T_body_cams[:count], has_depth=options.rig == "rgbd")
        self.true_rig = surrounded(self.true_rig, options.further_cameras)
        turn = so3_exp(_AXIS * np.deg2rad(options.extrinsic_rotation_deg))
        first = base.T_body_cams[0] @ transform(turn, np.zeros(3))
        given = tuple(first @ T for T in self.true_rig.T_cam0_cams[1:])
        self.rig = Rig(self.true_rig.cameras, (first, *given), self.true_rig.has_depth)

    def _frame_times(self) -> Array:
        shutter_s = 0.5 * self.options.readout_s
        begin_s, end_s = self._begin_s + _MARGIN_S, self._end_s - _MARGIN_S
        t_s = _steps(begin_s, end_s, 1.0 / self.options.camera_hz)
        if isinstance(self.motion, MeasuredMotion):
            known = self.motion.covers(t_s, shutter_s)
            if not known.all():
                self.problems["frames where truth or inertial data have a gap"] = int((~known).sum())
            t_s = t_s[known]
        if len(t_s) == 0:
            raise DataError(f"{self.name}: the true motion is known at no frame; choose another start_s or duration_s")
        return t_s

    # -- the recording -----------------------------------------------------------------------------------------------

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | Frame]:
        """Yield samples and frames in order of their stamps; can be called again and yields the same again.

        Tracks depend on what was followed before, so no frame is left out before `from_ns`, unless all are before it.
        """
        streams: list[Iterator[ImuSample | Frame]] = [self._imu.samples()]
        if not self.rig.is_blind and (from_ns is None or (self._stamps_ns >= from_ns).any()):
            streams.append(self._frames())
        yield from heapq.merge(*streams, key=lambda event: event.t_ns)

    def tracker(self, camera: int = 0) -> SimulatedTracker:
        """Return what makes a camera's tracks (the first: the pair's), at its beginning; for tests, too."""
        options, rig, seed = self.options, self.true_rig, self._track_seed
        if camera:
            rig = Rig((rig.cameras[camera],), (rig.T_body_cams[camera],))
            seed = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, camera))
        return SimulatedTracker(rig, self.field, self.motion, options, np.random.default_rng(seed), camera << _ID_BITS)

    def _frames(self) -> Iterator[Frame]:
        options, tracker = self.options, self.tracker()
        further = {camera: self.tracker(camera) for camera in self.true_rig.further}
        stamps = self._stamps_ns.tolist()
        zero_s = self._begin_s + _MARGIN_S
        for index, (t_s, t_ns) in enumerate(zip(self._frame_s.tolist(), stamps, strict=True)):
            since_s = t_s - zero_s
            if in_window(since_s, options.outage_begin_s, options.outage_length_s, options.outage_every_s):
                tracks = _nothing(self.true_rig)
            else:
                tracks = tracker.see(t_s, in_window(since_s, options.moving_begin_s, options.moving_length_s))
            others = ((camera, one.see(t_s, moving=False)) for camera, one in further.items())
            seen = tuple(FurtherTracks(camera, one.track_ids, one.pixels_px) for camera, one in others)
            yield Frame(t_ns, index, (), tracks=replace(tracks, further=seen))

    @property
    def _stamps_ns(self) -> Stamps:
        return self._ns(self._frame_s - self.options.time_offset_s)

    # -- truth -------------------------------------------------------------------------------------------------------

    @property
    def frame_times_ns(self) -> Stamps:
        """True times [F] of the frames by the IMU's clock; stamps are earlier by `time_offset_s`."""
        return self._ns(self._frame_s)

    def truth(self) -> Trajectory:
        """Return the true poses of the body by the IMU's clock, a hundred a second, where they are known."""
        t_s = _steps(self._begin_s, self._end_s, _TRUTH_STEP_S)
        if isinstance(self.motion, MeasuredMotion):
            t_s = t_s[self.motion.covers(t_s)]
        poses = [self.motion.at(part).T_world_body for part in _parts(t_s)]
        return Trajectory(self._ns(t_s), np.concatenate(poses))

    def true_states(self, t_ns: Stamps) -> TrueStates:
        """Return the true states at times [N] by the IMU's clock; biases are NaN where a real IMU keeps them secret."""
        t_s = (t_ns - self.zero_ns).astype(np.float64) * 1e-9
        motions = [self.motion.at(part) for part in _parts(t_s)]
        gyro_bias, accel_bias = self._imu.biases(t_ns)
        return TrueStates(
            t_ns, np.concatenate([m.T_world_body for m in motions]),
            np.concatenate([m.velocity_world_m_s for m in motions]), gyro_bias, accel_bias,
        )  # fmt: skip

    def _ns(self, t_s: Array) -> Stamps:
        return np.round(t_s * 1e9).astype(np.int64) + self.zero_ns


def _stated(noise: ImuNoise, factor: float) -> ImuNoise:
    return replace(
        noise,
        gyroscope_noise_density=noise.gyroscope_noise_density * factor,
        accelerometer_noise_density=noise.accelerometer_noise_density * factor,
        gyroscope_random_walk=noise.gyroscope_random_walk * factor,
        accelerometer_random_walk=noise.accelerometer_random_walk * factor,
    )


def _undistorted(camera: Camera) -> Camera:
    return replace(camera, distortion="none", coefficients=())


def _steps(begin_s: float, end_s: float, step_s: float) -> Array:
    count = int(np.floor((end_s - begin_s) / step_s + 1e-9)) + 1
    return np.asarray(begin_s + step_s * np.arange(max(count, 0)))


def _parts(t_s: Array) -> Iterator[Array]:
    for begin in range(0, max(len(t_s), 1), _AT_ONCE):
        yield t_s[begin : begin + _AT_ONCE]


def _nothing(rig: Rig) -> Observations:
    right, depth = np.empty((0, 2)) if rig.is_stereo else None, np.empty(0) if rig.has_depth else None
    descriptors = np.empty((0, 32), dtype=np.uint8)
    return Observations(np.empty(0, dtype=np.int64), np.empty((0, 2)), right, depth, descriptors=descriptors)
