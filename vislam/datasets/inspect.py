"""What a recording holds and everything wrong with it, for `vislam doctor`; damaged recordings are its daily bread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from math import ceil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.findings import Finding, Severity, worst
from vislam.core.progress import Progress, silent
from vislam.core.recording import Problems
from vislam.datasets import survey as survey_recording
from vislam.datasets.extrinsics import judged_places, judged_turns_of
from vislam.datasets.images import (
    DepthFormat,
    ImageList,
    UnreadableImageError,
    bits_of,
    check_size_px,
    probe,
    read_depth,
    read_grey_or_color,
)
from vislam.datasets.loaders import FrameTable
from vislam.datasets.plausibility import (
    ImuFacts,
    camera_tilt_rad,
    force_seems_in_g,
    imu_facts,
    mean_force,
    rates_seem_in_degrees,
)
from vislam.datasets.rgbd import rgbd_findings
from vislam.datasets.stream import IMU_HOLE_S, Survey, TopicSummary, frame_table, open_loader
from vislam.datasets.stream_checks import StreamChecks, repeats
from vislam.datasets.tables import Row, in_time_order
from vislam.imu import ImuNoise
from vislam.trajectory import Trajectory
from vislam.trajectory.truth_fit import fit_truth

Stamps = NDArray[np.int64]

_GRAVITY_M_S2 = 9.81
_REST_TOLERANCE_M_S2 = 0.3  # bias and scale of a cheap accelerometer
_MOVING_TOLERANCE_M_S2 = 1.0  # what an honest journey may average to
_MAX_TILT_RAD = np.deg2rad(60.0)
_MIN_IMU_RATE_HZ = 50.0  # below it, preintegration between frames of 20 Hz has next to nothing to integrate
_DECODED_PER_CAMERA = 200  # each image's head and end are read; this many, spread evenly, are decoded


@dataclass(frozen=True, slots=True)
class StreamSummary:
    """One stream of a recording; rates are those of the usual period."""

    name: str
    count: int
    rate_hz: float  # NaN when there are fewer than two
    first_t_ns: int
    last_t_ns: int
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class Inspection:
    """What a recording holds and what was found."""

    source: str
    format: str
    duration_s: float
    size_bytes: int
    streams: tuple[StreamSummary, ...]
    findings: tuple[Finding, ...]
    topics: tuple[TopicSummary, ...] = ()  # of a bag

    @property
    def worst(self) -> Severity:
        """The worst severity among the findings."""
        return worst(self.findings)


def inspect(uri: str, progress: Progress = silent) -> Inspection:
    """Examine `FORMAT:PATH` or a bare path; `progress` takes what is done, of how much, and of what.

    Raises UsageError or DataError only when there is no recording to look at: a wrong name, an empty folder.
    """
    found = survey_recording(uri)
    problems = Problems()
    problems.update(found.problems)
    problems.judges |= found.problems.judges
    inspector = _Inspector(found, problems, progress)
    return inspector.run(uri)


class _Inspector:
    """Goes through one survey and collects findings; each check stands alone, so that one failure hides no other."""

    def __init__(self, found: Survey, problems: Problems, progress: Progress) -> None:
        self._found, self._progress = found, progress
        self._problems = problems
        self._findings: list[Finding] = [Finding("error", str(error), str(found.root)) for error in found.errors]
        self._findings += [Finding("warning", str(error), str(found.root)) for error in found.lacking.values()]
        self._streams: list[StreamSummary] = []
        self._checks = StreamChecks(problems)
        self._size_bytes = found.streams.size_bytes if found.streams is not None else 0

    def run(self, uri: str) -> Inspection:
        found = self._found
        frames = frame_table(found, self._problems) if found.cameras else None
        findings, depth_rows = rgbd_findings(found, frames, self._progress)
        self._findings += (*found.findings, *findings)
        self._check_cameras(frames, depth_rows)
        facts = self._check_imu()
        if frames is not None and facts is not None:
            self._check_overlap(frames.t_ns, facts.t_ns, "IMU")
        self._check_geometry(frames, facts)
        self._check_truth(frames)
        for kind, count in self._problems.items():
            self._add_problem(kind, count, frames)
        ends = [(s.first_t_ns, s.last_t_ns) for s in self._streams if s.count]
        begin_ns = int(frames.t_ns[0]) if frames is not None and len(frames.t_ns) else min(ends, default=(0, 0))[0]
        self._findings += self._checks.findings(begin_ns)
        duration_ns = max(end for _, end in ends) - min(begin for begin, _ in ends) if ends else 0
        return Inspection(
            source=uri,
            format=found.format,
            duration_s=duration_ns * 1e-9,
            size_bytes=self._size_bytes,
            streams=tuple(self._streams),
            findings=tuple(sorted(self._findings, key=lambda f: ("error", "warning", "ok").index(f.severity))),
            topics=found.topics,
        )

    def _add(self, severity: Severity, what: str, where: str, next_step: str = "") -> None:
        self._findings.append(Finding(severity, what, where, next_step if severity != "ok" else ""))

    def _add_problem(self, kind: str, count: int, frames: FrameTable | None) -> None:
        total = len(frames.t_ns) if frames is not None else 0
        minor = kind == "frame without depth" and count < 0.2 * total
        severity: Severity = "ok" if minor else "warning"
        self._add(severity, f"{kind}: {count}", self._found.root.name, "skipped or bridged in a run")

    def _check_stream(self, name: str, t_ns: Stamps) -> None:
        """Summarise a stream and judge how even it is."""
        steps_s = np.diff(t_ns) * 1e-9
        if not len(t_ns):
            self._add("error", f"{name} is empty", name, "record again, or remove the sensor's folder")
            return
        rate_hz = 1.0 / float(np.median(steps_s)) if len(steps_s) else float("nan")
        longest = float(steps_s.max()) if len(steps_s) else 0.0
        self._streams.append(StreamSummary(name, len(t_ns), rate_hz, int(t_ns[0]), int(t_ns[-1]), longest))
        late = float(np.mean(steps_s > 1.5 / rate_hz)) if len(steps_s) else 0.0
        if late > 0.02:
            what = f"{name}: {100 * late:.0f} % of the intervals are over 1.5 periods"
            self._add("warning", what, name, "samples were dropped or stamped late; record at a lower load")
        if len(steps_s):
            self._add("ok", f"{name}: {len(t_ns)} at {rate_hz:.1f} Hz, longest gap {longest:.3f} s", name)

    def _check_cameras(self, frames: FrameTable | None, depth_rows: frozenset[int]) -> None:
        found = self._found
        if not found.cameras and found.has_imu:
            self._add("ok", "no camera: it runs by the IMU and what --sensors.file names", str(found.root))
        elif not found.cameras and not found.errors:
            self._add("error", "neither camera images nor an IMU", str(found.root), "it can be evaluated but not run")
        streams = [*found.cameras, *([found.depth] if found.depth is not None else [])]
        for index, images in enumerate(streams):
            self._check_stream(images.name, images.t_ns)
            if found.video is None and found.streams is None:
                is_depth = images is found.depth
                cameras = () if found.rig is None else found.rig.cameras
                camera = next(iter(cameras[0 if is_depth else index :]), None)
                stored = found.depth_format.camera(camera) if is_depth and camera is not None else camera
                self._check_images(images, stored, depth_rows if is_depth else None)
        self._size_bytes += sum(path.stat().st_size for path in found.videos)
        if found.streams is not None and frames is not None:
            for index, images in enumerate(found.cameras):
                self._checks.compare(images, found.streams.repeats(index))
            self._findings += _message_findings(found, frames, self._checks)
        if frames is not None and not len(frames.t_ns):
            self._add("error", "no frame: the cameras share no stamps", str(found.root), "synchronise the cameras")

    def _check_images(self, images: ImageList, camera: Camera | None, depth_rows: frozenset[int] | None) -> None:
        """Probe all, decode some (`depth_rows` of depth are decoded already; None: colour), report what is unusable."""
        bad: dict[str, list[Path]] = {}
        per_decoded = len(images.files) / _DECODED_PER_CAMERA
        stride = max(1, int(per_decoded) if depth_rows is None else ceil(per_decoded))  # what colour shows is timed
        decoded = len(depth_rows or ())
        bits = None if camera is None else bits_of(images, camera)
        self._checks.compare(images, repeats(images))
        for i in range(len(images.files)):
            path = images.path(i)
            self._progress(i + 1, len(images.files), images.name)
            try:
                size = probe(path)
                self._size_bytes += path.stat().st_size
                if camera is None or bits is None:
                    continue
                check_size_px(size, camera, path)
                if i % stride == 0 and not (depth_rows and depth_rows.intersection(range(i, i + stride))):
                    decoded += 1
                    if depth_rows is not None:
                        read_depth(path, camera, DepthFormat())
                        continue
                    until = min(i + stride, len(images.files) - 1)
                    grey = read_grey_or_color(images, i, camera, bits)[0]
                    self._checks.look_at(images.name, grey, int(images.t_ns[i]), int(images.t_ns[until]))
            except UnreadableImageError as error:
                bad.setdefault(error.kind, []).append(path)
            except DataError as error:
                bad.setdefault(f"image of wrong size ({error})", []).append(path)
        for kind, paths in bad.items():
            hopeless = kind.startswith("image of wrong") or len(paths) > len(images.files) // 2
            severity: Severity = "error" if hopeless else "warning"
            what = f"{images.name}: {len(paths)} of {len(images.files)}: {kind}"
            self._add(severity, what, str(paths[0]), "copy the files again; the run skips what it cannot read")
        if not bad and images.files:
            said = "" if bits is None else bits.said
            self._add("ok", f"{images.name}: all images are there, {decoded} of them decoded{said}", images.name)

    def _rows(self, problems: Problems) -> Iterator[Row[list[float]]]:
        calibration = self._found.imu_calibration
        rate_hz = 0.0 if self._found.imu_noise is None else self._found.imu_noise.rate_hz
        rows = in_time_order(self._found.imu_rows(problems), problems, "imu", hole_s=IMU_HOLE_S, rate_hz=rate_hz)
        for t_ns, values in rows:
            yield t_ns, values if calibration is None else calibration.apply_to(np.array([values]))[0].tolist()

    def _check_imu(self) -> ImuFacts | None:
        if not self._found.has_imu:
            if self._found.cameras:
                self._add("ok", "no IMU: vision alone gives the motion", str(self._found.root))
            return None
        if self._found.imu_file is not None:
            self._size_bytes += self._found.imu_file.stat().st_size
        try:
            facts = imu_facts(self._checks.watched(self._rows(self._problems)))
        except DataError as error:
            self._add("error", str(error), str(self._found.imu_file or self._found.root))
            return None
        self._check_stream("imu0", facts.t_ns)
        if len(facts.window_t_ns) == 0:
            return None
        self._check_gravity(facts)
        self._check_gyro(facts, self._found.imu_noise)
        return facts

    def _check_gravity(self, facts: ImuFacts) -> None:
        norm, rest = mean_force(facts)
        state = f"over {int(facts.at_rest.sum()) * 0.5:.1f} s at rest" if rest else "on average (never at rest)"
        what = f"specific force {norm:.2f} m/s^2 {state}"
        off = abs(norm - _GRAVITY_M_S2)
        if force_seems_in_g(norm):
            self._add("error", f"{what}: the unit seems to be g", "imu0", f"multiply by {_GRAVITY_M_S2}")
        elif norm < 0.5 * _GRAVITY_M_S2:
            self._add("error", f"{what}: gravity is missing", "imu0", "record raw data, with gravity, in m/s^2")
        elif off > (_REST_TOLERANCE_M_S2 if rest else _MOVING_TOLERANCE_M_S2):
            self._add("warning", f"{what}, expected {_GRAVITY_M_S2}", "imu0", "calibrate the accelerometer")
        else:
            self._add("ok", what, "imu0")

    def _check_gyro(self, facts: ImuFacts, noise: ImuNoise | None) -> None:
        rate = np.linalg.norm(facts.gyro_mean, axis=1)
        if rates_seem_in_degrees(facts):
            self._add(
                "error", f"gyro of up to {rate.max():.0f} rad/s: the unit seems to be deg/s", "imu0", "convert it"
            )
        period_ns = float(np.median(np.diff(facts.t_ns))) if len(facts.t_ns) > 1 else 0.0
        if period_ns > 1e9 / _MIN_IMU_RATE_HZ:
            self._add("warning", f"only {1e9 / period_ns:.0f} Hz of IMU", "imu0", "100 Hz or more serve better")
        if noise is None and not self._found.errors and not self._found.lacking:
            self._add("error", "the IMU has no noise model", "imu0", "write its sensor.yaml, see docs/formats.md")

    def _check_overlap(self, frame_t_ns: Stamps, t_ns: Stamps, what: str) -> None:
        """Judge how many frames lie within the time of another stream."""
        if not len(frame_t_ns) or not len(t_ns):
            return
        outside = int(np.count_nonzero((frame_t_ns < t_ns[0]) | (frame_t_ns > t_ns[-1])))
        where = f"{what} {t_ns[0] * 1e-9:.3f} to {t_ns[-1] * 1e-9:.3f} s"
        if outside == len(frame_t_ns):
            self._add("error", f"no frame lies within the time of the {what}", where, "stamp both with one clock")
        elif outside:
            text = f"{outside} of {len(frame_t_ns)} frames lie outside the time of the {what}"
            minor = what != "IMU" and outside < 0.05 * len(frame_t_ns)
            self._add("ok" if minor else "warning", text, where, "start it earlier and stop it later")
        else:
            self._add("ok", f"every frame lies within the time of the {what}", where)

    def _check_geometry(self, frames: FrameTable | None, facts: ImuFacts | None) -> None:
        """Compare calibration with images and gravity, as far as all of them are there."""
        rig = self._found.rig
        if rig is None or frames is None or not len(frames.t_ns):
            return
        try:
            if facts is not None:
                self._judge_extrinsics(rig, frames, facts)
            if len(rig.cameras) > 1:
                self._findings += judged_places(self._found, rig, frames)
        except DataError as error:
            self._add("error", str(error), str(self._found.root))

    def _judge_extrinsics(self, rig: Rig, frames: FrameTable, facts: ImuFacts) -> None:
        turns, *others = (
            judged_turns_of(k, self._found, rig, frames, facts, lambda: self._rows(Problems()))
            for k in (0, *rig.further)
        )
        self._findings += [*turns, *chain.from_iterable(others)]
        tilt_rad = camera_tilt_rad(facts, rig)
        tilt = f"gravity is {np.rad2deg(tilt_rad):.0f} deg from the vertical of cam0's image"
        if tilt_rad < _MAX_TILT_RAD or (turns and worst(turns) == "ok"):
            self._add("ok", tilt, "cam0")
        else:
            step = "fine if the camera is mounted so; else check T_BS and that the accelerometer at rest reads +g up"
            self._add("warning", tilt, "cam0", step)

    def _check_truth_fit(self, truth: Trajectory) -> None:
        """Report by how much the truth's body is turned, displaced and late against the IMU."""
        if not self._found.has_imu:
            return
        try:
            rows = list(self._rows(Problems()))
        except DataError:
            return  # reported by the check of the IMU
        values = np.array([row[1] for row in rows]).reshape(-1, 6)
        fit = fit_truth(np.array([row[0] for row in rows], dtype=np.int64), values[:, :3], values[:, 3:], truth)
        if fit.summary:
            self._add("ok", f"{fit.summary}; `points:` and NEES undo it", "truth")
        if fit.noise:
            self._add("ok", fit.noise, "truth")

    def _check_truth(self, frames: FrameTable | None) -> None:
        if self._found.truth is None:
            self._add("ok", "no truth: a run is not scored", str(self._found.root))
            return
        try:
            truth = self._found.truth(self._problems)
        except DataError as error:
            self._add("warning", f"truth cannot be used: {error}", str(self._found.root), "repair or remove it")
            return
        if truth is None or not len(truth.t_ns):
            self._add("warning", "the truth holds no pose", str(self._found.root), "repair or remove it")
            return
        self._check_stream("truth", truth.t_ns)
        self._check_truth_fit(truth)
        if frames is not None:
            self._check_overlap(frames.t_ns, truth.t_ns, "truth")


def _message_findings(found: Survey, frames: FrameTable, checks: StreamChecks) -> list[Finding]:
    """Decode some frames of a bag, evenly spread, have them looked at, and report which cannot be used."""
    rig = found.rig or _rig_of_first_sizes(found)
    if rig is None or not len(frames.t_ns):
        return []
    bad: dict[str, list[str]] = {}
    chosen = np.unique(np.linspace(0, len(frames.t_ns) - 1, _DECODED_PER_CAMERA).astype(int))
    try:
        with closing(open_loader(found, rig, frames)) as loader:
            for i, after in zip(chosen.tolist(), [*chosen[1:].tolist(), -1], strict=True):
                loaded = loader.load(i)
                for images, image in zip(found.cameras, loaded.images, strict=False):
                    checks.look_at(images.name, image, int(frames.t_ns[i]), int(frames.t_ns[after]))
                if (trouble := loaded.trouble) is not None:
                    bad.setdefault(trouble.kind, []).append(str(trouble.path))
    except DataError as error:
        return [Finding("error", str(error), str(found.root), "leave the topic out, or record with one size")]
    if not bad:
        what = f"{len(chosen)} of {len(frames.t_ns)} frames decoded{''.join(bits.said for bits in loader.bits)}"
        return [Finding("ok", what, str(found.root))]
    step = "the run skips what it cannot read"
    return [
        Finding("error" if len(where) > len(chosen) // 2 else "warning", f"{kind}: {len(where)} of {len(chosen)} "
        "frames decoded", where[0], step)
        for kind, where in bad.items()
    ]  # fmt: skip


def _rig_of_first_sizes(found: Survey) -> Rig | None:
    """Return a rig that only has the sizes of the images, where there is no calibration yet; None without lenses."""
    lenses = [known.camera for known in found.known_cameras if known.camera is not None]
    whole = len(lenses) == len(found.cameras) > 0
    return Rig(tuple(lenses), tuple(np.eye(4) for _ in lenses), found.depth is not None) if whole else None
