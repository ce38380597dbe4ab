"""Do the places of cameras fit what they and the gyroscope saw? For doctor, and for a run that went wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress

import numpy as np

from vislam.core.angles import angles_of
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.messages import Array, ImageU8
from vislam.core.recording import Problems, Recording, Wrapping
from vislam.datasets.camera_turns import TurnFit, follow_turns, judged_turns, turn_findings, turn_places
from vislam.datasets.loaders import FrameTable
from vislam.datasets.plausibility import ImuFacts, imu_facts
from vislam.datasets.rgbd import MEND, misplaced, misplaced_words
from vislam.datasets.rig_checks import judged_cameras
from vislam.datasets.stream import FileRecording, Survey, open_loader
from vislam.datasets.tables import Row

_CHECKED_FRAMES, _FEWEST_TURNS = 6, 6
Rows = Callable[[], Iterator[Row[list[float]]]]  # inertial ones, calibrated; begins again at every call


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
