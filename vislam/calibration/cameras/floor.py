"""`vislam calibrate floor`: how a cart's camera is tilted against the floor, and how high it is above it.

The floor's flow shows the tilt, whatever the height: points that pass near and far have to move as one plane does. The
height is pure scale: only a measured way, or a tape, gives it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vislam.calibration.options import FloorOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.config import Config, PlanarConfig
from vislam.core.errors import UsageError
from vislam.core.messages import Array, Frame, ImuSample, ImuSpan, MagSample, Tracking
from vislam.core.recording import Recording, with_camera
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.planar import PlanarFrontEnd
from vislam.imu import ImuBuffer, subtract_bias
from vislam.runs.sources import open_source

_FILES = ("floor.toml", "floor.png", "floor.json")
_START_TILT_SIGMA_DEG = 5.0  # of where the recording's own extrinsics have the camera
_USUAL_HEIGHT_M = 0.5  # to begin with: tilt does not depend on it
_MIN_WAY_HEIGHTS = 4.0  # driven; 3 m with a camera at 0.6 m are 5
_MAX_LOST = 0.2  # of the frames
_MAX_TILT_SIGMA_DEG = 0.15  # more is no calibration: 0.75 % of scale
_MAX_HALVES_DEG = 0.5  # between what both halves of the drive say
_MIN_DISTANCE_HEIGHTS = 2.0
_MAX_TURN_DEG = 5.0  # between begin and end of a measured drive: what turns, is not where the tape is
_LEVER_M = 0.5  # from the camera to where the tape may have been held
_ODOMETRY_SIGMA = 0.002  # relative, of the way by a camera whose tilt is known
_SCALE_BY_TILT = 2.9  # per rad
_MAX_HEIGHT_SIGMA = 0.015  # relative
_LEAST_TILT_SIGMA_DEG = 0.02  # lens and floor are no better


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What one pass over the recording gave, at an assumed height."""

    T_start_body: Array  # [N, 4, 4] of every frame
    tilt_deg: Array  # [N] as believed then
    tilt_sigma_deg: Array  # [N]
    roll_deg: Array  # [N]
    roll_sigma_deg: Array  # [N]
    lost: int
    reasons: tuple[str, ...]  # of frames that were lost, each once
    offset_s: float  # of the camera's clock
    gyro_bias_rad_s: Array | None  # [3]; None: not known

    @property
    def way_m(self) -> Array:
        """Way driven up to every frame [N]."""
        steps = np.linalg.norm(np.diff(self.T_start_body[:, :2, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(np.where(steps > 2e-4, steps, 0.0))])  # rest is no way


@dataclass(frozen=True, slots=True, eq=False)
class FloorCalibration:
    """Height and tilt with standard deviations, and the drive behind them."""

    height_m: float
    height_sigma_m: float
    tilt_deg: float
    tilt_sigma_deg: float
    roll_deg: float
    roll_sigma_deg: float
    by_distance: bool
    halves_deg: float  # between what both halves of the drive say of the tilt
    drive: Drive


def calibrate_floor(options: FloorOptions) -> Outcome:
    """Find height and tilt of the camera and write them; raises DataError where the drive does not determine them."""
    if (options.distance_m is None) == (options.height_m is None):
        raise UsageError(
            "the floor's flow does not show the height: give --distance-m of a measured drive, or --height-m by tape"
        )
    folder = Folder(options.out, _FILES, options.overwrite)
    recording = with_camera(open_source(options.source))
    found = fit_floor(recording, options)
    statements = _statements(found, recording)
    path = folder.write_text("floor.toml", floor_text(found, statements))
    folder.write_picture("floor.png", (10.0, 4.2), lambda figure, colors: draw(figure, colors, found))
    report = _report(found, statements)
    folder.write_report("floor.json", report)
    return Outcome(report, (*_lines(found), *statements, _next(path)), tuple(folder.files))


def fit_floor(recording: Recording, options: FloorOptions) -> FloorCalibration:
    """Return the calibration of a recording's cam0; raises DataError when it does not determine it."""
    height_m = options.height_m or _USUAL_HEIGHT_M
    planar = PlanarConfig(height_m=height_m, tilt_sigma_deg=_START_TILT_SIGMA_DEG, tilt_walk_deg=0.0)
    first = _driven(recording, options, planar, None)
    _refuse_blind(first, options, height_m)
    # once more from the tilt that was found, with the gyroscope, whose bias and clock are known now
    planar = replace(planar, tilt_deg=float(first.tilt_deg[-1]), roll_deg=float(first.roll_deg[-1]), tilt_sigma_deg=1.0)
    drive = _driven(recording, options, planar, first)
    _refuse_blind(drive, options, height_m)
    halves_deg = _halves_deg(drive)
    tilt_sigma_deg = float(np.hypot(max(drive.tilt_sigma_deg[-1], _LEAST_TILT_SIGMA_DEG), 0.5 * halves_deg))
    height_sigma_m = options.height_sigma_m
    reasons = []
    if not tilt_sigma_deg < _MAX_TILT_SIGMA_DEG:
        reasons.append(f"the tilt is only known to {tilt_sigma_deg:.2f} deg, its halves differ by {halves_deg:.2f} deg")
    if not halves_deg < _MAX_HALVES_DEG:
        reasons.append("the floor is not level, the camera moves on its mount, or the lens is not calibrated")
    refuse(f"the floor in {options.source}", [*reasons, "drive farther on a level floor"] if reasons else [])
    if options.distance_m is not None:
        height_m, height_sigma_m = _height(drive, options, height_m, np.deg2rad(tilt_sigma_deg))
    return FloorCalibration(
        height_m, height_sigma_m, float(drive.tilt_deg[-1]), tilt_sigma_deg, float(drive.roll_deg[-1]),
        float(max(drive.roll_sigma_deg[-1], _LEAST_TILT_SIGMA_DEG)), options.distance_m is not None, halves_deg, drive,
    )  # fmt: skip


def _height(drive: Drive, options: FloorOptions, assumed_m: float, tilt_sigma_rad: float) -> tuple[float, float]:
    """Return the height that makes the way from begin to end as long as it was measured, and its sigma."""
    T = drive.T_start_body[-1]
    seen_m, distance_m = float(np.linalg.norm(T[:2, 3])), options.distance_m or 0.0
    turn_deg = float(np.rad2deg(abs(np.arctan2(T[1, 0], T[0, 0]))))
    reasons = []
    if seen_m < _MIN_DISTANCE_HEIGHTS * assumed_m:
        reasons.append(f"it ends {seen_m / assumed_m:.1f} camera heights from where it began; measure a longer way")
    if turn_deg > _MAX_TURN_DEG:
        reasons.append(f"it ends turned by {turn_deg:.0f} deg, so that the tape depends on where it was held")
    if distance_m <= 0.0:
        reasons.append(f"--distance-m is {distance_m}")
    relative = float(np.linalg.norm([
        options.distance_sigma_m / max(distance_m, 1e-9), _ODOMETRY_SIGMA, _SCALE_BY_TILT * tilt_sigma_rad,
        _LEVER_M * np.deg2rad(turn_deg) / max(distance_m, 1e-9),
    ]))  # fmt: skip
    if relative > _MAX_HEIGHT_SIGMA and not reasons:
        reasons.append(f"the height is only known to {relative:.1%}; measure a longer way, driven straight")
    refuse(f"the height in {options.source}", reasons)
    height_m = assumed_m * distance_m / seen_m
    return height_m, height_m * relative


def _refuse_blind(drive: Drive, options: FloorOptions, height_m: float) -> None:
    """Refuse a drive in which too little was seen, or that is too short."""
    count, reasons = len(drive.tilt_deg), []
    if count == 0:
        reasons.append("there are no frames in that part of it")
    elif drive.lost > _MAX_LOST * count:
        reasons.append(f"{drive.lost} of {count} frames are lost: {'; '.join(drive.reasons[:2])}")
    elif drive.way_m[-1] < _MIN_WAY_HEIGHTS * height_m:
        reasons.append(
            f"the way is {drive.way_m[-1] / height_m:.1f} camera heights long, {_MIN_WAY_HEIGHTS:.0f} are the least"
        )
    refuse(f"the floor in {options.source}", reasons)


def _halves_deg(drive: Drive) -> float:
    """Return by how much the tilt of the way's halves differs, from how the estimate moved."""
    way = drive.way_m
    half = int(np.searchsorted(way, 0.5 * way[-1]))
    first, second = drive.tilt_sigma_deg[half] ** -2, drive.tilt_sigma_deg[-1] ** -2
    fresh = second - first
    if fresh <= 0.1 * second:
        return float("inf")
    later = (drive.tilt_deg[-1] * second - drive.tilt_deg[half] * first) / fresh
    return float(abs(later - drive.tilt_deg[half]))


def _driven(recording: Recording, options: FloorOptions, planar: PlanarConfig, known: Drive | None) -> Drive:
    """Pass over the recording once; the gyroscope counts where its bias is `known`."""
    config = Config()
    frontend = PlanarFrontEnd(replace(config.frontend, mode="planar", planar=planar), recording.rig, config.seed)
    clock, buffer = CameraClock(config.init), ImuBuffer(replace(config.imu, buffer_s=60.0), config.machine)
    bias = None if known is None else known.gyro_bias_rad_s
    shift_ns = 0 if known is None else round(known.offset_s * 1e9)
    poses, said, reasons, lost = [], [], list[str](), 0
    T_key, T, last_ns = np.eye(4), np.eye(4), None
    for value in _part(recording, options):
        if isinstance(value, ImuSample):
            buffer.add(value)
            continue
        frame = replace(value, t_ns=value.t_ns + shift_ns)
        span: ImuSpan | None = None
        if bias is not None and last_ns is not None:
            raw = buffer.span(last_ns, frame.t_ns)
            span = None if raw is None else subtract_bias(raw, bias, np.zeros(3))
        track = frontend.track(frame, span, 1e-3 if span is not None else np.inf)
        last_ns = frame.t_ns
        if track.vo.tracking is Tracking.LOST:
            lost += 1
            reasons += [track.reason] if track.reason not in reasons else []
        if track.vo.T_keyframe_body is not None:
            T = T_key @ track.vo.T_keyframe_body
        if track.keyframe is not None:
            T_key = T
        if known is None:
            clock.follow(track.vo, buffer, is_started=True)
        now = frontend.calibration
        poses.append(T)
        said.append([now["tilt_deg"], now["tilt_sigma_deg"], now["roll_deg"], now["roll_sigma_deg"]])
    found = clock.estimate
    tilt, tilt_sigma, roll, roll_sigma = np.array(said).reshape(-1, 4).T
    if known is not None:
        offset_s, learnt = known.offset_s, known.gyro_bias_rad_s
    else:
        offset_s, learnt = found.offset_s, found.gyro_bias_rad_s if found.frames else None
    T_start_body = np.array(poses).reshape(-1, 4, 4)
    return Drive(T_start_body, tilt, tilt_sigma, roll, roll_sigma, lost, tuple(reasons), offset_s, learnt)


def _part(recording: Recording, options: FloorOptions) -> Iterator[ImuSample | Frame]:
    """Yield the part of a recording that is asked for; a frame comes after inertial samples that reach past it."""
    begin_ns: int | None = None
    waiting: list[Frame] = []
    for value in recording.events():
        if isinstance(value, MagSample):
            continue
        begin_ns = value.t_ns if begin_ns is None else begin_ns
        at_s = (value.t_ns - begin_ns) * 1e-9 - options.begin_s
        if options.duration_s is not None and at_s > options.duration_s:
            break
        if isinstance(value, Frame):
            waiting += [value] if at_s >= 0.0 else []
            continue
        yield value
        while waiting and value.t_ns > waiting[0].t_ns + 100_000_000:
            yield waiting.pop(0)
    yield from waiting


def floor_text(found: FloorCalibration, statements: list[str]) -> str:
    """Return the file that the config takes."""
    comments = "".join(f"# {line}\n" for line in ["vislam calibrate floor", *statements])
    return (
        f'{comments}\n[frontend]\nmode = "planar"\n\n[frontend.planar]\n'
        f"height_m = {found.height_m:.5f}\nheight_sigma_m = {found.height_sigma_m:.5f}\n"
        f"tilt_deg = {found.tilt_deg:.4f}\nroll_deg = {found.roll_deg:.4f}\n"
        f"tilt_sigma_deg = {max(found.tilt_sigma_deg, found.roll_sigma_deg):.4f}\n"
    )


def _statements(found: FloorCalibration, recording: Recording) -> list[str]:
    """Return what a user must know of how far the numbers can be trusted."""
    scale = np.hypot(found.height_sigma_m / found.height_m, _SCALE_BY_TILT * np.deg2rad(found.tilt_sigma_deg))
    said = [
        f"lengths are right to {scale:.2%}: {found.height_sigma_m / found.height_m:.2%} by height, "
        f"{_SCALE_BY_TILT * np.deg2rad(found.tilt_sigma_deg):.2%} by tilt",
        f"the halves of the drive differ by {found.halves_deg:.2f} deg of tilt",
    ]
    if not found.by_distance:
        said.append("the height is what the tape said; a measured drive (--distance-m) would check it")
    if recording.imu_noise is None or found.drive.gyro_bias_rad_s is None:
        said.append("without a gyroscope, springs that rock count as noise of the tilt")
    return said


def _lines(found: FloorCalibration) -> list[str]:
    way = found.drive.way_m[-1]
    how = "by the measured drive" if found.by_distance else "by tape"
    return [
        f"tilt {found.tilt_deg:.3f} ± {found.tilt_sigma_deg:.3f} deg, roll {found.roll_deg:.3f} ± "
        f"{found.roll_sigma_deg:.3f} deg, from {way:.1f} m by the height assumed",
        f"height {found.height_m:.4f} ± {found.height_sigma_m:.4f} m {how}",
    ]


def _next(path: Path) -> str:
    return f"next: vislam run ... --config {path}"


def _report(found: FloorCalibration, statements: list[str]) -> dict[str, Any]:
    return {
        "kind": "floor",
        "height_m": found.height_m,
        "height_sigma_m": found.height_sigma_m,
        "height_by": "distance" if found.by_distance else "tape",
        "tilt_deg": found.tilt_deg,
        "tilt_sigma_deg": found.tilt_sigma_deg,
        "roll_deg": found.roll_deg,
        "roll_sigma_deg": found.roll_sigma_deg,
        "halves_deg": found.halves_deg,
        "frames": len(found.drive.tilt_deg),
        "frames_lost": found.drive.lost,
        "camera_offset_s": found.drive.offset_s,
        "statements": statements,
    }


def draw(figure: Figure, colors: Mapping[str, str], found: FloorCalibration) -> None:
    """Draw how tilt and roll became known, and the way that was driven."""
    left, right = figure.subplots(1, 2)
    way = found.drive.way_m
    for name, value, sigma, color in (
        ("tilt", found.drive.tilt_deg, found.drive.tilt_sigma_deg, colors["axis-x"]),
        ("roll", found.drive.roll_deg, found.drive.roll_sigma_deg, colors["axis-z"]),
    ):
        off = value - value[-1]
        left.plot(way, off, color=color, label=f"{name}, {value[-1]:.2f} deg at the end")
        left.fill_between(way, off - sigma, off + sigma, color=color, alpha=0.2, linewidth=0)
    reach = 3.0 * float(np.max(np.abs(found.drive.tilt_deg[len(way) // 2 :] - found.tilt_deg), initial=0.1))
    left.set(xlabel="way [m]", ylabel="against the end [deg]", title="what the floor shows", ylim=(-reach, reach))
    left.legend(loc="upper right")
    at = found.drive.T_start_body[:, :2, 3]
    right.plot(at[:, 0], at[:, 1], color=colors["axis-x"])
    right.plot(*at[0], "o", color=colors["axis-z"])
    right.set(xlabel="x [m]", ylabel="y [m]", title="the drive", aspect="equal")
