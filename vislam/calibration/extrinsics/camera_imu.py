"""`vislam calibrate camera-imu`: how the camera is turned against the IMU, and how far their clocks are apart."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vislam.calibration.extrinsics.hand_eye import (
    HandEye,
    RotationPair,
    metric_rotations,
    solve_hand_eye,
    visual_rotations,
)
from vislam.calibration.options import CameraImuOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.config import FrontEndConfig
from vislam.core.errors import DataError
from vislam.core.geometry import invert, so3_log, transform
from vislam.core.messages import Array, Frame, ImuSample
from vislam.core.recording import Recording, with_camera
from vislam.datasets.camera_files import camchain_text
from vislam.datasets.foreign_cameras import CameraCalibration
from vislam.runs.sources import open_source

_FILES = ("camera-imu.yaml", "camera-imu.png", "camera-imu.json")
_MAX_ROTATION_SIGMA_RAD = np.deg2rad(0.5)
_MAX_OFFSET_SIGMA_S = 0.003
_LEAST_CORRELATION = 0.5  # of the speeds of turning: less, and camera and IMU saw different things
_MIN_PAIRS = 60
_MONO_WIDER = 4.0  # one camera takes a little motion for a turn: errors were 3 to 5 sigmas of its scatter (MH_01, laps)


@dataclass(frozen=True, slots=True, eq=False)
class CameraImuResult:
    """The answer, and what the recording's own files say."""

    solved: HandEye
    given: Array  # [4, 4] T_body_cam of the recording
    frames: int
    metric: bool  # stereo or depth, not one camera alone


def calibrate_camera_imu(options: CameraImuOptions) -> Outcome:
    """Calibrate and write; raises DataError when the motion does not determine rotation or offset."""
    folder = Folder(options.out, _FILES, options.overwrite)
    recording = with_camera(open_source(options.source, 0, options.calibration))
    result = solve_camera_imu(recording, options)
    report = _report(result)
    path = folder.write_text(
        "camera-imu.yaml", camchain_text(_chain(result, recording), "; ".join(_statements(result)))
    )
    folder.write_picture("camera-imu.png", (11.0, 3.8), lambda figure, colors: draw(figure, colors, result))
    folder.write_report("camera-imu.json", report)
    lines = (*_lines(result), f"next: vislam run ... --calibration.camera {path}")
    return Outcome(report, lines, tuple(folder.files))


def solve_camera_imu(recording: Recording, options: CameraImuOptions) -> CameraImuResult:
    """Return rotation and offset; raises DataError that names what the motion lacks."""
    if recording.imu_noise is None:
        raise DataError(f"{options.source} has no IMU; record camera and IMU together")
    what = f"camera against IMU in {options.source}"
    samples: list[ImuSample] = []
    frames = 0

    def seen() -> Iterator[Frame]:
        nonlocal frames
        begin: int | None = None
        for value in recording.events():
            begin = value.t_ns if begin is None else begin
            if value.t_ns - begin > options.max_s * 1e9:
                return
            if isinstance(value, ImuSample):
                samples.append(value)
            elif isinstance(value, Frame):
                frames += 1
                yield value

    rig, config = recording.rig, FrontEndConfig()
    metric = rig.is_stereo or rig.has_depth
    pairs: list[RotationPair] = list(
        metric_rotations(seen(), rig, config) if metric else visual_rotations(seen(), rig.cameras[0], config)
    )
    refuse(what, [f"only {len(pairs)} of {frames} frames gave a rotation; show texture, avoid blur"]
           if len(pairs) < _MIN_PAIRS else [])  # fmt: skip
    t_ns = np.array([sample.t_ns for sample in samples], dtype=np.int64)
    gyro = np.array([sample.gyro_rad_s for sample in samples]).reshape(-1, 3)
    solved = solve_hand_eye(pairs, t_ns, gyro) if len(samples) > 1 else None
    if solved is None:
        raise DataError(f"{what}: images and inertial samples hardly overlap in time; are both by the same clock?")
    if not metric:
        solved = replace(solved, covariance=solved.covariance * _MONO_WIDER**2)
    refuse(what, _doubts(solved))
    return CameraImuResult(solved, rig.T_body_cams[0], frames, metric)


def _doubts(solved: HandEye) -> list[str]:
    doubts = []
    best = float(solved.correlation[:, 1].max())
    turned = ", ".join(f"{np.rad2deg(t):.0f}" for t in solved.turned_rad)
    values, vectors = (
        np.linalg.eigh(solved.covariance[:3, :3])
        if np.isfinite(solved.covariance).all()
        else (np.full(3, np.inf), np.eye(3))
    )
    if not np.sqrt(values[-1]) < _MAX_ROTATION_SIGMA_RAD:
        axis = ", ".join(f"{x:+.2f}" for x in vectors[:, -1])
        doubts.append(
            f"the rotation about the IMU's axis ({axis}) would be known to {np.rad2deg(np.sqrt(values[-1])):.1f} deg "
            f"only (turned along the principal axes, in degrees: {turned}); turn more, and about two axes at least"
        )
    if not solved.sigmas[3] < _MAX_OFFSET_SIGMA_S:
        doubts.append(
            f"the time offset would be known to {1e3 * solved.sigmas[3]:.1f} ms only; turn to and fro more briskly"
        )
    if best < _LEAST_CORRELATION:
        doubts.append(
            f"camera and gyroscope turn differently (correlation {best:.2f}); check stamps, and that both are fixed "
            "to the same body"
        )
    return doubts


def _chain(result: CameraImuResult, recording: Recording) -> list[CameraCalibration]:
    """Return the chain: rotation and offset as found, translation as the recording has it."""
    rig, solved = recording.rig, result.solved
    T_body_cam = transform(solved.R_body_cam, result.given[:3, 3].copy())
    chain = [CameraCalibration(rig.cameras[0], T_body_cam, solved.time_offset_s, float(solved.sigmas[3]))]
    for camera, T in zip(rig.cameras[1:], rig.T_body_cams[1:], strict=True):
        pose = T_body_cam @ invert(rig.T_body_cams[0]) @ T
        chain.append(CameraCalibration(camera, pose, solved.time_offset_s, float(solved.sigmas[3])))
    return chain


def _difference_deg(result: CameraImuResult) -> float:
    return float(np.rad2deg(np.linalg.norm(so3_log(result.given[:3, :3].T @ result.solved.R_body_cam))))


def _statements(result: CameraImuResult) -> list[str]:
    given = ", ".join(f"{x:.3f}" for x in result.given[:3, 3])
    said = [
        f"translation is not determined by turns: it is the ({given}) m of the recording; measure it with a ruler",
        "a lens or a gyroscope that is off by 1 % turns the answer by about as much of the turns between frames; "
        "calibrate both before",
    ]
    if not result.metric:
        said.append(f"one camera takes some motion for turns; sigmas are widened {_MONO_WIDER:.0f} times for that")
    if result.solved.grouping > 2.0:
        said.append(
            f"parts of the recording contradict each other {np.sqrt(result.solved.grouping):.1f} times as much as "
            "single rotations scatter; sigmas are widened by that"
        )
    return said


def _report(result: CameraImuResult) -> dict[str, Any]:
    solved = result.solved
    return {
        "kind": "camera-imu",
        "R_body_cam": solved.R_body_cam.tolist(),
        "rotation_sigma_deg": np.rad2deg(solved.sigmas[:3]).tolist(),
        "time_offset_s": solved.time_offset_s,
        "time_offset_sigma_s": float(solved.sigmas[3]),
        "gyro_bias_rad_s": solved.gyro_bias_rad_s.tolist(),
        "gyro_bias_sigma_rad_s": solved.sigmas[4:].tolist(),
        "from_recording_deg": _difference_deg(result),
        "frames": result.frames,
        "pairs": solved.pairs,
        "residual_median_deg": float(np.rad2deg(np.median(solved.residual_rad))),
        "misfit": solved.misfit,
        "grouping": solved.grouping,
        "correlation": float(solved.correlation[:, 1].max()),
        "turned_deg": np.rad2deg(solved.turned_rad).tolist(),
        "translation_m": result.given[:3, 3].tolist(),
        "translation_determined": False,
        "statements": _statements(result),
    }


def _lines(result: CameraImuResult) -> list[str]:
    solved = result.solved
    sigmas = ", ".join(f"{np.rad2deg(s):.2f}" for s in solved.sigmas[:3])
    rows = "; ".join(", ".join(f"{x:+.5f}" for x in row) for row in solved.R_body_cam)
    residual_deg = float(np.rad2deg(np.median(solved.residual_rad)))
    return [
        f"{solved.pairs} rotations from {result.frames} frames, usually {residual_deg:.3f} deg from the gyroscope's",
        f"R_body_cam [{rows}]",
        f"sigma about the IMU's axes {sigmas} deg; {_difference_deg(result):.2f} deg from what the recording states",
        f"time offset {1e3 * solved.time_offset_s:+.2f} ± {1e3 * solved.sigmas[3]:.2f} ms, to be added to the stamps "
        "of the camera",
        *_statements(result),
    ]


def draw(figure: Figure, colors: Mapping[str, str], result: CameraImuResult) -> None:
    """Draw correlation over offset, and what is left of the rotations over time."""
    solved = result.solved
    left, middle, right = figure.subplots(1, 3)
    left.plot(1e3 * solved.correlation[:, 0], solved.correlation[:, 1], color=colors["graph"])
    left.axvline(1e3 * solved.time_offset_s, color=colors["ekf"], linewidth=1.2)
    left.set(xlabel="offset [ms]", title="correlation of the speeds of turning")
    middle.plot(solved.times_s, np.rad2deg(solved.residual_rad), ".", markersize=3, color=colors["graph"])
    middle.set(xlabel="time [s]", title="camera and gyroscope differ by [deg]", yscale="log")
    names = ["rotation x", "rotation y", "rotation z"]
    right.barh(names, np.rad2deg(solved.sigmas[:3]), color=colors["graph"])
    right.set(title="sigma of the rotation [deg]")
    right.invert_yaxis()
