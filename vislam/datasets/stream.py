"""A recording on disk as a stream of values: what the readers of all formats share."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vislam.config import MachineConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.messages import Array, Frame, ImuSample, MagSample
from vislam.core.recording import Problems
from vislam.datasets.formats.truth import Truth
from vislam.datasets.images import (
    DepthFormat,
    ImageList,
    UnreadableImageError,
    check_size_px,
    decode_ahead,
    frames_ahead,
    match_by_time,
    probe,
)
from vislam.datasets.imu_pairs import ImuRows
from vislam.datasets.imu_tables import check_names
from vislam.datasets.loaders import FolderLoader, FrameTable, Loader, RegisteringLoader, VideoLoader
from vislam.datasets.tables import Row, in_time_order, read_numbers
from vislam.imu import ImuCalibration, ImuNoise, MagCalibration
from vislam.trajectory import Trajectory

if TYPE_CHECKING:
    from vislam.datasets.bags.streams import BagStreams

STEREO_TOLERANCE_NS = 2_000_000  # at 1 m/s the body moves 2 mm in it, far less than any baseline
DEPTH_TOLERANCE_NS = 20_000_000  # as in the TUM benchmark's own association
_NO_PARTNER = "stereo image without partner"
FRAME_HOLE_S = 0.5  # of images, that is worth reporting
IMU_HOLE_S = MachineConfig().max_gap_s  # spans are interpolated over shorter ones


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a bag and what it was taken for."""

    name: str
    type: str
    count: int
    rate_hz: float  # NaN when there are fewer than two
    taken_for: str


@dataclass(frozen=True, slots=True, eq=False)
class KnownCamera:
    """What a recording states of one camera, None where it does not."""

    camera: Camera | None = None
    T_body_cam: Array | None = None  # [4, 4]


ForceRows = Callable[[Problems], Iterator[Row[list[float]]]]


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What a recording holds, as found; `errors` are the reasons why it cannot be replayed, worst first."""

    format: str
    root: Path
    cameras: tuple[ImageList, ...] = ()
    depth: ImageList | None = None
    depth_format: DepthFormat = field(default_factory=DepthFormat)
    video: Path | None = None  # the frames come from here; the files of cam0 are frame numbers
    later_videos: tuple[tuple[Path, int], ...] = ()  # what follows it, and the numbers of their first frames
    rig: Rig | None = None
    clocks: tuple[float | None, ...] = ()  # of each camera: s to be added to its stamps, as its own calibration has it
    imu_file: Path | None = None
    samples: ImuRows | None = None  # inertial ones, where there is no table of them
    findings: tuple[Finding, ...] = ()  # what doctor reports of its parts
    imu_noise: ImuNoise | None = None
    imu_calibration: ImuCalibration | None = None  # of raw samples; None: they are calibrated
    mag_file: Path | None = None
    mag_calibration: MagCalibration | None = None  # as for the IMU, in the magnetometer's own axes
    R_body_mag: Array = field(default_factory=lambda: np.eye(3))
    truth: Truth | None = None
    forces: ForceRows | None = None  # of an accelerometer without a gyroscope, in body axes
    streams: BagStreams | None = None  # images and samples come from here; the files of a camera are names for messages
    topics: tuple[TopicSummary, ...] = ()
    known_cameras: tuple[KnownCamera, ...] = ()  # what is known where there is no rig yet
    lacking: Mapping[str, DataError] = field(default_factory=dict)  # why it cannot be replayed without that option
    problems: Problems = field(default_factory=Problems)  # met while listing
    errors: tuple[DataError, ...] = ()

    @property
    def has_imu(self) -> bool:
        """Whether there are inertial samples."""
        has = self.streams is not None and self.streams.has_imu
        return has or self.imu_file is not None or self.samples is not None

    @property
    def videos(self) -> tuple[Path, ...]:
        """The files that the frames come from, if they are videos."""
        return () if self.video is None else (self.video, *(path for path, _ in self.later_videos))

    def imu_rows(self, problems: Problems) -> Iterator[Row[list[float]]]:
        """Yield stamp, rates and forces as recorded, without calibration; raises DataError when most are unusable."""
        if self.streams is not None:
            return self.streams.imu_rows(problems)
        if self.samples is not None:
            return self.samples.imu_rows(problems)
        if self.imu_file is None:
            return iter(())
        check_names(self.imu_file)
        return read_numbers(self.imu_file, 6, problems)

    def mag_rows(self, problems: Problems) -> Iterator[Row[list[float]]]:
        """Yield stamp and field as recorded, as `imu_rows` does."""
        if self.streams is not None:
            return self.streams.mag_rows(problems)
        return iter(()) if self.mag_file is None else read_numbers(self.mag_file, 3, problems)


def with_depth_format(found: Survey, how: DepthFormat) -> Survey:
    """Return what a recording holds, with its depth read in another way: stamps move by the difference of offsets."""
    depth = found.depth
    later_ns = round((how.time_offset_s - found.depth_format.time_offset_s) * 1e9)
    if depth is not None and later_ns:
        depth = replace(depth, t_ns=depth.t_ns + later_ns)
    return replace(found, depth=depth, depth_format=how)


def image_list(
    name: str, folder: Path, rows: Iterable[Row[str]], problems: Problems, rate_hz: float | None = None
) -> ImageList:
    """Return the images of one camera from the rows of its list, in time order; bad rows are counted."""
    kept = list(in_time_order(rows, problems, name, hole_s=FRAME_HOLE_S, rate_hz=rate_hz or 0.0))
    stamps = np.array([row[0] for row in kept], dtype=np.int64)
    return ImageList(name, folder, stamps, tuple(row[1] for row in kept), rate_hz)


def frame_table(survey: Survey, problems: Problems) -> FrameTable:
    """Return which images form a frame; stereo images without a partner and frames without depth are counted.

    Cameras that make no pair with the first may lack an image of a frame: -1.
    """
    if not survey.cameras:
        return FrameTable(np.zeros(0, np.int64), np.zeros((0, 0), np.int64), np.zeros(0, np.int64))
    first = survey.cameras[0].t_ns
    rows = [np.arange(len(first))]
    further = () if survey.rig is None else survey.rig.further
    for number, other in enumerate(survey.cameras[1:], start=1):
        rows.append(match_by_time(first, other.t_ns, STEREO_TOLERANCE_NS))
        what = f"frame without an image of {other.name}, or the reverse" if number in further else _NO_PARTNER
        problems.count(what, times=_unpaired(rows[-1], len(other.t_ns)))
    camera_rows = np.stack(rows, axis=1)
    needed = [number for number in range(len(rows)) if number not in further]
    camera_rows = camera_rows[np.all(camera_rows[:, needed] >= 0, axis=1)]
    t_ns = first[camera_rows[:, 0]]
    depth_rows = np.full(len(t_ns), -1, dtype=np.int64)
    if survey.depth is not None:
        depth_rows = match_by_time(t_ns, survey.depth.t_ns, DEPTH_TOLERANCE_NS)
        problems.count("frame without depth", times=int(np.count_nonzero(depth_rows < 0)))
    return FrameTable(t_ns, camera_rows, depth_rows)


def _unpaired(partners: NDArray[np.int64], others: int) -> int:
    paired = int(np.count_nonzero(partners >= 0))
    return (len(partners) - paired) + (others - paired)


def open_loader(survey: Survey, rig: Rig, frames: FrameTable, cameras: int | None = None) -> Loader:
    """Return what loads the frames of a survey, of its first `cameras` only if given; close it after use.

    Depth comes registered to the first camera. Raises DataError when a video cannot be opened.
    """
    loader = _stored_loader(survey, rig, frames, cameras)
    own = survey.depth_format.own
    return loader if own is None else RegisteringLoader(loader, own, rig.cameras[0])


def _stored_loader(survey: Survey, rig: Rig, frames: FrameTable, cameras: int | None) -> Loader:
    if survey.streams is not None:
        return survey.streams.open_loader(rig, frames, cameras)
    if survey.video is not None:
        return VideoLoader(survey.video, survey.cameras[0].files, rig.cameras[0], survey.later_videos)
    return FolderLoader(frames, survey.cameras[:cameras], survey.depth, rig, survey.depth_format)


def _joined(
    samples: Iterator[ImuSample | MagSample], frames: Iterator[Frame]
) -> Iterator[ImuSample | MagSample | Frame]:
    """Yield both in time order, as `heapq.merge`, which would hold a frame behind the last sample to the very end."""
    sample = next(samples, None)
    for frame in frames:
        while sample is not None and sample.t_ns <= frame.t_ns:
            yield sample
            sample = next(samples, None)
        yield frame
        del frame  # before the next is decoded
    while sample is not None:
        yield sample
        sample = next(samples, None)


class FileRecording:
    """A recording on disk that implements `vislam.core.recording.Recording`.

    Memory does not grow with its length, apart from the index of its images (some 100 bytes each).
    """

    def __init__(self, survey: Survey) -> None:
        """Open what a survey found; raises DataError when it cannot be replayed, or images and calibration differ."""
        for error in (*survey.errors, *survey.lacking.values()):
            raise error
        rig = Rig((), ()) if not survey.cameras and survey.has_imu else survey.rig
        if rig is None or bool(rig.cameras) != bool(survey.cameras):
            raise DataError(
                f"{survey.root} holds neither camera images nor an IMU; `vislam doctor` shows what it holds"
            )
        self.name = survey.root.resolve().name
        self.rig: Rig = rig
        self.imu_noise: ImuNoise | None = survey.imu_noise
        self.cameras_read = len(survey.cameras)  # fewer, where the images of the others are not needed
        self.survey = survey
        self._counter = Problems()
        self._counter.update(survey.problems)
        self.frames = frame_table(survey, self._counter)
        self._known = dict(self._counter)
        judges = survey.problems.judges.values()
        self._steps_ns = [step_ns for judge in judges for step_ns in judge.steps_ns]
        self.problems: dict[str, int] = self._counter
        self.frame_count = len(self.frames.t_ns)
        if not self.frame_count and survey.cameras:
            names = " and ".join(camera.name for camera in survey.cameras)
            raise DataError(f"{survey.root} has no frame: {names} share no image within {STEREO_TOLERANCE_NS} ns")
        self._check_first_images()

    def events(self, from_ns: int | None = None) -> Generator[ImuSample | MagSample | Frame, None, None]:
        """Yield samples and frames in time order, inertial ones first when stamps are equal; no frame before `from_ns`.

        A second call starts over, also the counts. Raises DataError when an image is not of the calibrated size, or
        when most rows of a file are unusable.
        """
        self._counter.restart(self._known)
        self._counter.judges = dict(self.survey.problems.judges)
        reading = self._read_frames(from_ns)
        with (
            closing(reading) as frames,
            closing(self.imu_samples(self._counter)) as imu,
            closing(self._read_mag()) as mag,
        ):
            samples: list[Iterator[ImuSample | MagSample]] = [imu, mag]
            yield from _joined(heapq.merge(*samples, key=lambda sample: sample.t_ns), frames)

    def truth(self) -> Trajectory | None:
        """Return the true body trajectory, or None; raises DataError when its file is unusable."""
        if self.survey.truth is None:
            return None
        met = Problems()
        trajectory = self.survey.truth(met)
        self._known.update(met)
        self._counter.update(met)
        return trajectory

    def forces(self) -> tuple[NDArray[np.int64], Array] | None:
        """Return stamps [N] and forces [N, 3] in body axes of an accelerometer without a gyroscope; None without one.

        Their unit is the file's. Raises DataError when most of its rows are unusable.
        """
        if self.survey.forces is None:
            return None
        met = Problems()
        rows = list(in_time_order(self.survey.forces(met), met, "accelerometer"))
        self._known.update(met)
        self._counter.update(met)
        return np.array([t for t, _ in rows], dtype=np.int64), np.array([f for _, f in rows]).reshape(-1, 3)

    def _check_first_images(self) -> None:
        """Compare the first readable image of each camera with its calibration, before a run starts."""
        if self.rig.is_blind:
            return
        if self.survey.video is not None:
            open_loader(self.survey, self.rig, self.frames).close()
            return
        if self.survey.streams is not None:
            with closing(open_loader(self.survey, self.rig, self.frames)) as loader:
                next((i for i in range(min(100, self.frame_count)) if loader.load(i).images), None)
            return
        for column, (camera, stream) in enumerate(zip(self.rig.cameras, self.survey.cameras, strict=True)):
            for row in self.frames.camera_rows[:100, column]:
                if row < 0:
                    continue
                try:
                    check_size_px(probe(stream.path(int(row))), camera, stream.path(int(row)))
                    break
                except UnreadableImageError:
                    continue

    def _read_frames(self, from_ns: int | None) -> Generator[Frame, None, None]:
        last_ns = None
        if self.rig.is_blind:
            return
        with closing(open_loader(self.survey, self.rig, self.frames, self.cameras_read)) as loader:
            index = 0 if from_ns is None else int(np.searchsorted(self.frames.t_ns, from_ns))
            depth = None if self.survey.depth is None else self.survey.depth_format.camera(self.rig.cameras[0])
            ahead = frames_ahead(self.rig.cameras[: self.cameras_read], depth)
            with closing(decode_ahead(range(index, self.frame_count), loader.load, loader.workers, ahead)) as decoded:
                for t_ns, loaded in zip(self.frames.t_ns[index:].tolist(), decoded, strict=False):
                    if loaded.trouble is not None:
                        self._counter.count(loaded.trouble.kind, self._place(loaded.trouble.path))
                    if loaded.images:
                        lag_s = self._depth_lag_s(index)
                        is_torn = last_ns is not None and any(last_ns <= step_ns < t_ns for step_ns in self._steps_ns)
                        yield Frame(
                            t_ns, index, loaded.images, loaded.color, loaded.depth_m, depth_lag_s=lag_s,
                            follows_step=is_torn,
                        )  # fmt: skip
                        last_ns = t_ns
                        index += 1

    def _depth_lag_s(self, index: int) -> float:
        """Return how much later than the images of a frame its depth is stamped, in seconds; 0 without depth."""
        row = int(self.frames.depth_rows[index])
        if self.survey.depth is None or row < 0:
            return 0.0
        return int(self.survey.depth.t_ns[row] - self.frames.t_ns[index]) * 1e-9

    def imu_samples(self, problems: Problems) -> Generator[ImuSample, None, None]:
        """Yield the inertial samples, calibrated; what is skipped is counted. Raises DataError as `events`."""
        if not self.survey.has_imu:
            return
        rate_hz = self.imu_noise.rate_hz if self.imu_noise is not None else 0.0
        calibration = self.survey.imu_calibration
        rows = self.survey.imu_rows(problems)
        for t_ns, values in in_time_order(rows, problems, "imu", hole_s=IMU_HOLE_S, rate_hz=rate_hz):
            both = np.array(values)
            sample = ImuSample(t_ns, both[:3], both[3:])
            yield sample if calibration is None else calibration.apply(sample)

    def _read_mag(self) -> Generator[MagSample, None, None]:
        calibration = self.survey.mag_calibration
        rows = self.survey.mag_rows(self._counter)
        for t_ns, values in in_time_order(rows, self._counter, "mag"):
            raw = MagSample(t_ns, np.array(values))
            field_ut = raw.field_ut if calibration is None else calibration.apply(raw).field_ut
            yield MagSample(t_ns, self.survey.R_body_mag @ field_ut)

    def _place(self, path: Path) -> str:
        return str(path.relative_to(self.survey.root)) if path.is_relative_to(self.survey.root) else path.name
