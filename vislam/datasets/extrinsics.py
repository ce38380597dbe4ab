"""Do the places of cameras fit what they and the gyroscope saw? For doctor, and for a run that went wrong.

What several cameras show is held against their places: epipolar lines of a pair, and what should look alike nowhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from vislam.core.angles import angles_of
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.geometry import invert, skew
from vislam.core.messages import Array, ImageU8
from vislam.core.recording import Problems, Recording, Wrapping
from vislam.datasets.camera_turns import TurnFit, follow_turns, judged_turns, turn_findings, turn_places
from vislam.datasets.loaders import FrameTable
from vislam.datasets.plausibility import ImuFacts, imu_facts
from vislam.datasets.rgbd import MEND, misplaced, misplaced_words
from vislam.datasets.stream import FileRecording, Survey, open_loader
from vislam.datasets.tables import Row

_CHECKED_FRAMES, _FEWEST_TURNS = 6, 6
Rows = Callable[[], Iterator[Row[list[float]]]]  # inertial ones, calibrated; begins again at every call
_MATCH_RATIO = 0.8
_EPIPOLAR_LIMIT_PX = 2.0
_MIN_MATCHES = 60  # of a pair, over all frames
_MIN_ON_LINE = 0.5
_ALIKE = 60.0  # matches per frame that two cameras have which see the same; such as do not have about ten by chance


def judged_cameras(rig: Rig, frames: Sequence[tuple[ImageU8, ...]]) -> list[Finding]:
    """Return what images of some frames say of the cameras' places; frames without images are passed over.

    Raises DataError where the first pair sits at one place.
    """
    frames = [images for images in frames if images]
    found = [_judged_pair(rig, [(images[0], images[1]) for images in frames])] if rig.is_stereo else []
    for one, other in combinations(range(len(rig.cameras)), 2):
        cameras, T_body_cams = zip(*((rig.cameras[k], rig.T_body_cams[k]) for k in (one, other)), strict=True)
        if Rig(cameras, T_body_cams).is_stereo:
            continue
        pairs = [images for images in frames if len(images) > other and images[one].size and images[other].size]
        alike = sum(len(_match(images[one], images[other])) for images in pairs) / max(len(pairs), 1)
        if alike > _ALIKE:
            text = f"cam{one} and cam{other} show the same ({alike:.0f} matches a frame), which their places rule out"
            step = "check T_BS of both, and that neither has the other's images"
            found.append(Finding("error", text, f"cam{other}", step))
    for camera in rig.further:
        if not any(finding.where == f"cam{camera}" for finding in found):
            found.append(Finding("ok", "makes no pair with cam0: tracks of its own", f"cam{camera}"))
    return found


def _judged_pair(rig: Rig, pairs: Sequence[tuple[ImageU8, ImageU8]]) -> Finding:
    facts = epipolar_facts(rig, pairs)
    what = f"stereo: {100 * facts.on_line:.0f} % of {facts.matches} matches lie on their epipolar line"
    if facts.matches < _MIN_MATCHES:
        return Finding("warning", f"stereo: only {facts.matches} matches, too few to judge", "cam1", "more texture")
    if facts.fits:
        return Finding("ok", what, "cam1")
    is_off = facts.on_line < _MIN_ON_LINE
    what += ": the extrinsics do not fit" if is_off else ", but behind the cameras"
    return Finding("error", what, "cam1", _tried(rig, pairs) or "check T_BS of both cameras, or calibrate them again")


def _tried(rig: Rig, pairs: Sequence[tuple[ImageU8, ImageU8]]) -> str:
    """Return which of the usual mistakes would explain that a pair does not fit, as what to do then."""
    cameras, (T0, T1) = rig.cameras[:2], rig.T_body_cams[:2]
    exchanged = Rig(cameras[::-1], (T1, T0))
    tries = (
        ("write the inverse of both T_BS", Rig(cameras, (invert(T0), invert(T1)))),
        ("write the inverse of cam1's pose in cam0", Rig(cameras, (T0, T0 @ invert(rig.T_cam0_cam1)))),
        ("swap their images", exchanged),
    )
    if any(epipolar_facts(rig, [pair]).fits for pair in pairs):
        count = sum(epipolar_facts(exchanged, [pair]).fits for pair in pairs)
        return f"swap their images in {count} of {len(pairs)} frames looked at" if count else ""
    found = ((step, epipolar_facts(tried, pairs)) for step, tried in tries)
    return ", or ".join(f"{step} ({100 * facts.on_line:.0f} % fit then)" for step, facts in found if facts.fits)


@dataclass(frozen=True, slots=True)
class EpipolarFacts:
    """How matched features of stereo pairs fit the extrinsics."""

    matches: int
    on_line: float  # fraction of matches within 2 px of their epipolar line
    in_front: float  # fraction of those that lie in front of both cameras

    @property
    def fits(self) -> bool:
        """Whether most are where the extrinsics have them."""
        return min(self.on_line, self.in_front) >= _MIN_ON_LINE


def epipolar_facts(rig: Rig, pairs: Iterable[tuple[ImageU8, ImageU8]]) -> EpipolarFacts:
    """Match ORB features between the cameras and compare with the epipolar geometry of the rig.

    Raises DataError where both cameras sit at one place.
    """
    rig.check_baseline()
    T_cam1_cam0 = invert(rig.T_cam0_cam1)
    R, t = T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3]
    E = skew(t) @ R
    matches, on_line, in_front = 0, 0, 0
    for left, right in pairs:
        pixels = _match(left, right)
        first, second = rig.cameras[0].unproject(pixels[:, :2]), rig.cameras[1].unproject(pixels[:, 2:])
        usable = np.all(np.isfinite(np.hstack([first, second])), axis=1)
        first, second = first[usable], second[usable]
        lines1, lines0 = first @ E.T, second @ E
        slope = np.sum(lines1[:, :2] ** 2, axis=1) + np.sum(lines0[:, :2] ** 2, axis=1)
        sampson_px = np.abs(np.sum(second * lines1, axis=1)) / np.sqrt(np.maximum(slope, 1e-18)) * rig.cameras[0].fx
        close = sampson_px < _EPIPOLAR_LIMIT_PX
        matches += len(first)
        on_line += int(close.sum())
        in_front += _count_in_front(first[close] @ R.T, second[close], t)
    return EpipolarFacts(matches, on_line / max(matches, 1), in_front / max(on_line, 1))


def _match(left: ImageU8, right: ImageU8) -> Array:
    """Return matched pixels [N, 4] (left x, y, right x, y) that pass the ratio test."""
    orb = cv2.ORB.create(nfeatures=800)
    points0, descriptors0 = orb.detectAndCompute(left, None)
    points1, descriptors1 = orb.detectAndCompute(right, None)
    if descriptors0 is None or descriptors1 is None or len(points1) < 2:
        return np.empty((0, 4))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors0, descriptors1, k=2)
    good = [m[0] for m in pairs if len(m) == 2 and m[0].distance < _MATCH_RATIO * m[1].distance]
    return np.array([[*points0[m.queryIdx].pt, *points1[m.trainIdx].pt] for m in good]).reshape(-1, 4)


def _count_in_front(rays0: Array, rays1: Array, t: Array) -> int:
    """Count points with positive depth on both rays: least squares of depth0 * ray0 + t = depth1 * ray1, cam1 axes."""
    a, b, c = np.sum(rays0**2, axis=1), np.sum(rays0 * rays1, axis=1), np.sum(rays1**2, axis=1)
    d, e = rays0 @ t, rays1 @ t
    # times the determinant a c - b b, which is never negative and near zero for points far away: those count as seen
    depth0, depth1 = b * e - c * d, a * e - b * d
    far = (a * c - b * b) < 1e-6 * a * c
    return int(np.count_nonzero(far | ((depth0 > 0.0) & (depth1 > 0.0))))


def judged_places(found: Survey, rig: Rig, frames: FrameTable) -> list[Finding]:
    """Return how some frames fit the places of several cameras; raises DataError where two sit at one place."""
    chosen = np.unique(np.linspace(0, len(frames.t_ns) - 1, _CHECKED_FRAMES).astype(int))
    with closing(open_loader(found, rig, frames)) as loader:
        return judged_cameras(rig, [loader.load(int(i)).images for i in chosen])


def judged_turns_of(
    camera: int, found: Survey, rig: Rig, frames: FrameTable, facts: ImuFacts, rows: Rows
) -> list[Finding]:
    """Return how turns that a camera of a rig saw fit the gyroscope's; raises DataError where images cannot be read."""
    with closing(open_loader(found, rig, frames, camera + 1)) as loader:
        tracks = follow_turns(
            turn_places(facts, frames.t_ns), frames.t_ns,
            lambda frame: [image for image in loader.load(frame).images[camera:] if image.size],
        )  # fmt: skip
    R_body_cam, bias = rig.T_body_cams[camera][:3, :3], facts.gyro_bias_rad_s
    return judged_turns(rig.cameras[camera], R_body_cam, tracks, rows, bias, f"cam{camera}")


def contradicted_extrinsics(
    recording: Recording, seen: Sequence[tuple[ImageU8, ...]] = (), turns: Sequence[tuple[Array, Array]] = ()
) -> tuple[str, ...]:
    """Return what contradicts the places of the cameras that a run read, and what to do then.

    Args:
        recording: is asked on disk, also where it is within others; its inertial data as they lie there.
        seen: images of some frames that the run took, which may be other ones than on disk, if there are any.
        turns: rotations [3, 3] of the body by the gyroscope and by cam0; asked where there is nothing on disk.
    """
    findings = list[Finding]()
    try:
        inner = _innermost(recording)
        is_file = isinstance(inner, FileRecording)
        asks_seen = bool(seen) and not (is_file and inner is recording)
        if asks_seen:
            used = min(map(len, seen))
            rig = Rig(recording.rig.cameras[:used], recording.rig.T_body_cams[:used])
            findings += judged_cameras(rig, [images[:used] for images in seen])
        if isinstance(inner, FileRecording) and inner.frame_count:
            findings += _on_disk(inner, not asks_seen)
        elif len(turns) >= _FEWEST_TURNS:
            findings += _turns_of_run(turns, recording.rig.T_body_cams[0][:3, :3])
    except DataError:
        return ()  # what cannot be read is said elsewhere
    return tuple(f"{finding.what}: {finding.next_step}" for finding in findings if finding.severity == "error")


def misplaced_depth(recording: Recording) -> str:
    """Return how depth of a recording on disk lies elsewhere than stated, and what to do then; empty: it does not."""
    with suppress(DataError):  # what cannot be read is said elsewhere
        inner = _innermost(recording)
        if isinstance(inner, FileRecording) and inner.survey.depth is not None:
            place = misplaced(inner.survey, inner.rig)
            return "" if place is None else f"{misplaced_words(place)}: {MEND}"
    return ""


def _innermost(recording: Recording) -> Recording:
    return _innermost(recording.wrapped()) if isinstance(recording, Wrapping) else recording


def _turns_of_run(turns: Sequence[tuple[Array, Array]], R_body_cam: Array) -> list[Finding]:
    by_gyro, by_cam = (np.array(R) for R in zip(*turns, strict=True))

    def differ(R: Array) -> float:
        return float(np.median(angles_of(by_gyro.swapaxes(1, 2) @ (R @ by_cam @ R.T)) / angles_of(by_gyro)))

    inverse = R_body_cam.T @ R_body_cam.T  # from axes of the body as given to those by the inverse
    return turn_findings(TurnFit(differ(np.eye(3)), len(turns)), differ(inverse))


def _on_disk(recording: FileRecording, asks_places: bool) -> list[Finding]:
    found, frames, used = recording.survey, recording.frames, recording.cameras_read
    rig = Rig(recording.rig.cameras[:used], recording.rig.T_body_cams[:used])

    def rows() -> Iterator[Row[list[float]]]:
        return ((s.t_ns, [*s.gyro_rad_s, *s.accel_m_s2]) for s in recording.imu_samples(Problems()))

    findings = judged_places(found, rig, frames) if used > 1 and asks_places else []
    if recording.imu_noise is not None and len((facts := imu_facts(rows())).window_t_ns):
        findings += [f for k in (0, *rig.further) for f in judged_turns_of(k, found, rig, frames, facts, rows)]
    return findings
