"""A simulated world as a recording: renders while it is read, with exact truth beside it."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vislam.config import validated
from vislam.core.errors import UsageError
from vislam.core.files import replacing, write_text
from vislam.core.messages import Array, Frame, ImageF32, ImageU8, ImuSample, MagSample
from vislam.imu import ImuNoise
from vislam.sim.faults.disturbance import Disturbance
from vislam.sim.motion.spline import BodySpline
from vislam.sim.scene import NAMES, Renderer, Scene, painted
from vislam.sim.sensing import DepthNoise, Imager, exposure_gains, sense_depth, sense_field, sense_imu
from vislam.sim.worlds.table import WORLD_NAMES, WORLDS, RigKind, Sensors, World, make_rig, surrounded
from vislam.trajectory import Trajectory

_START_NS = 1_000_000_000_000  # not zero, so that no code can rely on it
_MARGIN_S = 0.05  # frames keep this distance from both ends, so that shutters and blur stay inside the motion
Event = ImuSample | MagSample | Frame
_AHEAD = 3  # frames under way or waiting, per worker: enough to ride over a slow keyframe


@dataclass(frozen=True, slots=True)
class SimOptions:
    """What can be chosen about a simulated recording."""

    rig: RigKind | None = None  # None: the world's own
    further_cameras: Annotated[int, Field(ge=0, le=6)] = 0  # beside those, evenly around the vertical
    duration_s: Annotated[float, Field(ge=0.5)] | None = None  # seconds from the beginning
    camera_hz: Annotated[float, Field(gt=0.1, le=120.0)] | None = None  # None: the world's own
    image_width_px: Annotated[int, Field(ge=64, le=1920, multiple_of=4)] = 640  # 4:3
    exposure_s: Annotated[float, Field(ge=0.0, le=0.05)] | None = None  # motion blur; 0: none, None: the world's own
    blur_samples: Annotated[int, Field(ge=2, le=16)] = 5
    readout_s: Annotated[float, Field(ge=0.0, le=0.05)] = 0.0  # from the first to the last row; 0: global shutter
    image_noise: bool = True  # shot and read noise, vignetting
    exposure_changes: bool = True
    camera_delay_s: Annotated[float, Field(ge=-0.5, le=0.5)] | None = None  # frames are stamped so late; None: as above
    camera_jitter_s: Annotated[float, Field(ge=0.0, le=0.02)] | None = None  # standard deviation of that
    camera_drift: Annotated[float, Field(ge=-0.05, le=0.05)] = 0.0  # the camera's clock is so much too fast
    depth_noise: bool = True
    imu_noise: bool = True  # white noise and biases
    mag_hz: Annotated[float, Field(ge=0.0, le=200.0)] = 50.0  # 0: no magnetometer
    mag_sigma_ut: Annotated[float, Field(ge=0.0)] = 0.4
    blank_begin_s: Annotated[float, Field(ge=0.0)] = 0.0  # a view without any texture, since the first frame ...
    blank_length_s: Annotated[float, Field(ge=0.0)] = 0.0  # ... for so long ...
    blank_every_s: Annotated[float, Field(ge=0.0)] = 0.0  # ... and again after so long; 0: once
    light_every_s: Annotated[float, Field(ge=0.0)] = 0.0  # the light goes off and on again every so often; 0: never
    light_stops: Annotated[float, Field(ge=0.0, le=6.0)] = 2.0  # how much darker it is then, in powers of two
    moving_share: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0  # of the image: filled by a person walking to and fro
    moving_begin_s: Annotated[float, Field(ge=0.0)] = 0.0
    moving_length_s: Annotated[float, Field(ge=0.0)] | None = None  # None: to the end
    moving_masks: bool = False  # frames have masks that leave the person out
    gravity_m_s2: float = 9.81
    world_seed: int = 0  # of the place: its textures and where things stand; `seed` is that of motion and sensors
    workers: Annotated[int, Field(ge=1, le=16)] = 1  # threads that render ahead


@dataclass(frozen=True, slots=True, eq=False)
class TrueStates:
    """The exact state of the body, for consistency checks; biases are those in the IMU samples, interpolated."""

    t_ns: NDArray[np.int64]  # [N]
    T_world_body: Array  # [N, 4, 4]
    velocity_world_m_s: Array  # [N, 3]
    gyro_bias_rad_s: Array  # [N, 3]
    accel_bias_m_s2: Array  # [N, 3]


def open_world(world: str | World, seed: int = 0, **options: object) -> Simulation:
    """Open a simulated world, by the name of one of the table or as one of one's own.

    Raises UsageError for an unknown world, and for an unknown or ill-typed option (see `SimOptions`).
    """
    if isinstance(world, str) and world not in WORLDS:
        raise UsageError(f"no simulated world '{world}'; there are: {', '.join(WORLD_NAMES)}")
    name, built = (world, WORLDS[world]) if isinstance(world, str) else (world.description, world)
    return Simulation(name, built, seed, validated(SimOptions, options, f"simulated world '{name}'"))


class Simulation:
    """A recording of a simulated world (see `vislam.core.recording.Recording`); the same bytes each time."""

    def __init__(self, name: str, world: World, seed: int, options: SimOptions) -> None:
        """Prepare motion and inertial data; the world is painted when the first frame is asked for.

        Raises UsageError when `duration_s` is longer than the world's motion.
        """
        self.name = name
        self.options, self._world, self._seed = options, world, seed
        motion_seed, imu_seed, mag_seed, exposure_seed = np.random.SeedSequence(seed).spawn(4)
        self.spline: BodySpline = world.motion(np.random.default_rng(motion_seed))
        whole_s = self.spline.duration_s
        if options.duration_s is not None and options.duration_s > whole_s:
            raise UsageError(f"world '{name}' lasts {whole_s:.1f} s, asked for {options.duration_s} s; ask for less")
        self.duration_s = options.duration_s or whole_s
        rig = make_rig(world, options.rig or world.rig, options.image_width_px)
        self.rig = surrounded(rig, options.further_cameras)
        sensors = world.sensors
        self.imu_noise: ImuNoise | None = sensors.imu
        self.problems: dict[str, int] = {}
        self._imu_s = _times(0.0, self.duration_s, sensors.imu.rate_hz)
        imu_motion = self.spline.at(self._imu_s)
        self._imu = sense_imu(
            imu_motion, sensors.imu, options.gravity_m_s2, np.random.default_rng(imu_seed), options.imu_noise,
            sensors.turn_on,
        )  # fmt: skip
        self._mag_s = _times(0.0, self.duration_s, options.mag_hz)
        self._field_ut = sense_field(self.spline.at(self._mag_s), options.mag_sigma_ut, np.random.default_rng(mag_seed))
        self._frame_s = _times(_MARGIN_S, self.duration_s - _MARGIN_S, options.camera_hz or world.camera_hz)
        gains = exposure_gains(self._frame_s, np.random.default_rng(exposure_seed))
        self._gains = gains if options.exposure_changes else np.ones(len(self._frame_s))
        self.frame_count = len(self._frame_s)
        self._exposure_s = sensors.exposure_s if options.exposure_s is None else options.exposure_s
        self._stamp_ns = self._stamps(sensors)

    def _stamps(self, sensors: Sensors) -> NDArray[np.int64]:
        """Return when frames say they were taken: late, with jitter, by a clock that drifts."""
        o = self.options
        delay_s = sensors.camera_delay_s if o.camera_delay_s is None else o.camera_delay_s
        jitter_s = sensors.camera_jitter_s if o.camera_jitter_s is None else o.camera_jitter_s
        if delay_s == 0.0 and jitter_s == 0.0 and o.camera_drift == 0.0:
            return _ns(self._frame_s)
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(2,)))
        # no frame overtakes another: a driver that waits for one hands out the next later still
        late = np.clip(rng.normal(0.0, jitter_s, len(self._frame_s)), -3.0 * jitter_s, 3.0 * jitter_s)
        stamps = (1.0 + o.camera_drift) * (self._frame_s + delay_s + late)
        return _ns(np.maximum.accumulate(stamps) + 1e-9 * np.arange(len(stamps)))

    @cached_property
    def scene(self) -> Scene:
        """The painted world; made on first use (a few seconds)."""
        return painted(self._world.build, self.options.world_seed)

    @cached_property
    def _renderers(self) -> list[Renderer]:
        return [Renderer(camera) for camera in self.rig.cameras]

    @cached_property
    def _disturbance(self) -> Disturbance:
        return Disturbance(self.rig, self.options, np.random.SeedSequence(self.options.world_seed, spawn_key=(7,)))

    @cached_property
    def _imager(self) -> Imager:
        camera = self.rig.cameras[0]
        return Imager(camera.width, camera.height, self.options.image_noise)

    def events(self, from_ns: int | None = None) -> Iterator[Event]:
        """Yield samples and frames in time order, no frame before `from_ns`; each call yields the same again."""
        frames = self._frames(0 if from_ns is None else int(np.searchsorted(self._stamp_ns, from_ns)))
        try:
            streams: list[Iterator[Event]] = [self._imu_samples(), self._mag_samples(), frames]
            yield from heapq.merge(*streams, key=_stamp)
        finally:
            frames.close()

    def _imu_samples(self) -> Iterator[ImuSample]:
        for t_ns, gyro, accel in zip(
            _ns(self._imu_s).tolist(), self._imu.gyro_rad_s, self._imu.accel_m_s2, strict=True
        ):
            yield ImuSample(t_ns, gyro, accel)

    def _mag_samples(self) -> Iterator[MagSample]:
        for t_ns, field_ut in zip(_ns(self._mag_s).tolist(), self._field_ut, strict=True):
            yield MagSample(t_ns, field_ut)

    def _frames(self, first: int) -> Generator[Frame, None, None]:
        """Yield frames rendered ahead by worker threads; closing the generator ends the threads."""
        pool = ThreadPoolExecutor(self.options.workers, thread_name_prefix="vislam-render")
        waiting: deque[Future[Frame]] = deque()
        try:
            for index in range(first, self.frame_count):
                while len(waiting) < self.options.workers * _AHEAD and index + len(waiting) < self.frame_count:
                    waiting.append(pool.submit(self.render, index + len(waiting)))
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def render(self, index: int) -> Frame:
        """Render frame `index` (0-based); any order, any thread.

        The stamp is the middle of the exposure of the middle row, as the camera's clock has it. Raises
        UsageError for an index that does not exist.
        """
        self._check_index(index)
        t_s, since_s = float(self._frame_s[index]), float(self._frame_s[index] - self._frame_s[0])
        images: list[ImageU8] = []
        color: ImageU8 | None = None
        depth: ImageF32 | None = None
        for camera, renderer in enumerate(self._renderers):
            rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(1, camera, index)))
            light, exact = self._see(renderer, self.rig.T_body_cams[camera], t_s)
            light, exact = self._disturbance.spoil(camera, since_s, light, exact)
            gain = float(self._gains[index]) * self._disturbance.gain(since_s)
            picture = self._imager.sense(light, gain, rng)
            images.append(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
            if camera == 0:
                color = picture
                if self.rig.has_depth:
                    depth = sense_depth(exact, DepthNoise(), rng) if self.options.depth_noise else exact
        count = len(images) if self.options.moving_masks else 0
        masks = tuple(self._disturbance.mask(camera, since_s) for camera in range(count))
        return Frame(int(self._stamp_ns[index]), index, tuple(images), color, depth, masks=masks)

    def labels(self, index: int) -> tuple[int, ImageU8]:
        """Return the stamp of frame `index`, and what its first image shows [H, W]; see `Renderer.labels`.

        A person who walks through the image is not seen. Raises UsageError as `render`.
        """
        self._check_index(index)
        poses = self._poses(self.rig.T_body_cams[0], self._rows_s(float(self._frame_s[index])))
        return int(self._stamp_ns[index]), self._renderers[0].labels(self.scene, poses)

    def _check_index(self, index: int) -> None:
        if not 0 <= index < self.frame_count:
            raise UsageError(f"world '{self.name}' has frames 0..{self.frame_count - 1}, asked for {index}")

    def _rows_s(self, t_s: float) -> Array:
        """Return when the rows of an image are taken; one time for all where the shutter is global."""
        readout, height = self.options.readout_s, self.rig.cameras[0].height
        return t_s + readout * ((np.arange(height) + 0.5) / height - 0.5) if readout > 0.0 else np.array([t_s])

    def _see(self, renderer: Renderer, T_body_cam: Array, t_s: float) -> tuple[ImageF32, ImageF32]:
        """Return noise-free light (averaged over the exposure) and the exact depth at the stamp."""
        exposure, rows_s = self._exposure_s, self._rows_s(t_s)
        shutter: Array | None = None
        if exposure > 0.0:
            moments = (np.arange(self.options.blur_samples) + 0.5) / self.options.blur_samples - 0.5
            shutter = np.stack([self._poses(T_body_cam, rows_s + exposure * moment) for moment in moments])
        return renderer.render(self.scene, self._poses(T_body_cam, rows_s), shutter)

    def _poses(self, T_body_cam: Array, rows_s: Array) -> Array:
        """Return the camera's pose [4, 4] at one time, or its poses [H, 4, 4] at the times of H rows."""
        poses: Array = self.spline.at(rows_s).T_world_body @ T_body_cam
        return poses[0] if len(poses) == 1 else poses

    def truth(self) -> Trajectory:
        """Return the exact body poses at the times of the frames."""
        return Trajectory(_ns(self._frame_s), self.spline.at(self._frame_s).T_world_body)

    def dense_truth(self) -> Trajectory:
        """Return the exact body poses at the times of the IMU samples."""
        return Trajectory(_ns(self._imu_s), self.spline.at(self._imu_s).T_world_body)

    def true_states(self, t_ns: NDArray[np.int64]) -> TrueStates:
        """Return exact states at times [N] within the recording; UsageError outside."""
        t_s: Array = (t_ns - _START_NS).astype(np.float64) * 1e-9
        motion = self.spline.at(t_s)
        biases = np.hstack([self._imu.gyro_bias_rad_s, self._imu.accel_bias_m_s2])
        between = np.stack([np.interp(t_s, self._imu_s, column) for column in biases.T], axis=1)
        return TrueStates(t_ns, motion.T_world_body, motion.velocity_world_m_s, between[:, :3], between[:, 3:])


def _times(begin_s: float, end_s: float, rate_hz: float) -> Array:
    """Return times from `begin_s` to `end_s` at a rate, rounded to whole nanoseconds; none for a rate of 0."""
    if rate_hz == 0.0:
        return np.empty(0)
    count = int(np.floor((end_s - begin_s) * rate_hz + 1e-9)) + 1
    return np.round((begin_s + np.arange(count) / rate_hz) * 1e9) * 1e-9


def _stamp(event: Event) -> int:
    return event.t_ns


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.round(t_s * 1e9).astype(np.int64) + _START_NS


def write_labels(world: Simulation, folder: Path, on_frame: Callable[[int], None] | None = None) -> None:
    """Write a PNG of labels for every frame of a world, named by its stamp, and `labels.toml`: for `map.labels.folder`.

    `on_frame` gets how many are written. Raises StorageError when one cannot be.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "labels.toml", "".join(f'{i} = "{name}"\n' for i, name in enumerate(NAMES, start=1)))
    for index in range(world.frame_count):
        t_ns, labels = world.labels(index)
        with replacing(folder / f"{t_ns}.png") as file:
            file.write(bytes(cv2.imencode(".png", labels)[1]))
        if on_frame is not None:
            on_frame(index + 1)
