"""`vislam calibrate self`: a camera's lens from waving it about before anything with texture."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vislam.calibration.cameras import COEFFICIENTS, Model, parameter_names
from vislam.calibration.options import SelfOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.calibration.self_calibration.adjust import Piece, Shared
from vislam.calibration.self_calibration.certainty import Certainty, certainty
from vislam.calibration.self_calibration.depth_lens import focal_by_depth, with_focal
from vislam.calibration.self_calibration.lens_search import Solution, find_lens, with_gyro
from vislam.calibration.self_calibration.lever_arm import LeverArm, find_lever_arm
from vislam.calibration.self_calibration.patches import found_again
from vislam.calibration.self_calibration.segments import Segment, follow_segments
from vislam.calibration.self_calibration.structure import BIAS, GYRO, OFFSET, READOUT, SCALE, Gyro
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.geometry import invert, so3_log, transform
from vislam.core.messages import Array, Frame, ImuSample
from vislam.core.recording import Recording, with_camera
from vislam.datasets.camera_files import camchain_text
from vislam.datasets.foreign_cameras import CameraCalibration
from vislam.runs.sources import open_source, recorded_path
from vislam.vision.depth_focal import FocalFit

_FILES = ("camchain.yaml", "self.png", "self.json")
_WIDE_DEG = 100.0  # a wider lens is no pinhole
_LEAST_SEGMENTS = 4
# Real images mislead all stretches alike, which no jackknife shows: errors of focal lengths and centres were 2 to 5
# times what it said (MH_01; the rotation 1.4), in rendered images 1 to 4 times
_IMAGES_WIDER = 4.0
_MAX_FOCAL_SIGMA = 0.02  # relative
_MAX_CENTRE_SIGMA = 0.02  # of the image's width
_MAX_SIGMA_PX = 2.0  # noise of tracks: more, and what moves is the scene, or it is all blur
_GLOBAL_S = 0.003  # a shorter readout than this counts as a global shutter
_SAME = 3.0  # sigmas
_GYRO_SCALE = 0.01  # of a gyroscope of which nothing is known
_MAX_TURN_SIGMA_DEG = 0.5
_MAX_OFFSET_SIGMA_S = 0.003
_MAX_ARM_SIGMA_M = 0.01  # about what a ruler gives


@dataclass(frozen=True, slots=True, eq=False)
class SelfResult:
    """The lens and what it rests on."""

    solution: Solution
    known: Certainty
    segments: int  # that were followed, whether or not they could be reconstructed
    given: Rig  # of the recording
    without_imu: str  # why there is no result for the IMU; empty where there is something
    widened: float  # of the sigmas
    by_depth: FocalFit | str = ""  # what depth images said of the focal length, or why nothing; empty: there are none
    lever: LeverArm | None = None  # where the camera sits on the IMU

    @property
    def camera(self) -> Camera:
        """The lens."""
        return self.solution.shared.camera

    @property
    def focal_sigma(self) -> float:
        """Relative sigma of the worse focal length."""
        return float(max(self.known.sigmas[0] / self.camera.fx, self.known.sigmas[1] / self.camera.fy))

    @property
    def arm_m(self) -> Array | None:
        """Translation [3] of T_body_cam where it is known better than by a ruler."""
        sure = self.lever is not None and bool(np.all(self.lever.known.sigmas[:3] < _MAX_ARM_SIGMA_M))
        return self.lever.arm_m if sure and self.lever is not None else None


def calibrate_self(options: SelfOptions) -> Outcome:
    """Calibrate and write; raises DataError when the motion does not show the lens."""
    folder = Folder(options.out, _FILES, options.overwrite)
    result = solve_self(with_camera(open_source(options.source)), options)
    report = _report(result, options)
    comment = f"without a board, from {options.source}; focal length to {result.focal_sigma:.2%} (1 sigma)"
    path = folder.write_text("camchain.yaml", camchain_text(_chain(result), comment))
    folder.write_picture("self.png", (11.0, 3.8), lambda figure, colors: draw(figure, colors, result))
    folder.write_report("self.json", report)
    readout_s = result.solution.shared.readout_s
    rolling = f" --frontend.readout-s {readout_s:.4f}" if readout_s > _GLOBAL_S else ""
    lines = (*_lines(result), f"next: vislam run ... --calibration.camera {path}{rolling}")
    return Outcome(report, lines, tuple(folder.files))


def solve_self(recording: Recording, options: SelfOptions) -> SelfResult:
    """Return the lens; raises DataError that names what the motion lacks."""
    what = f"the camera of {options.source}"
    start = _guess(recording.rig.cameras[0], options)
    samples: list[ImuSample] = []
    segments = follow_segments(_frames(recording, options.max_s, samples), start.width, options.max_stretches)
    refuse(what, [_too_few(len(segments))] if len(segments) < _LEAST_SEGMENTS else [])
    solution = find_lens(segments, start, lambda pieces, shared: _rematched(recording, options, pieces, shared))
    count = 0 if solution is None else len(solution.pieces)
    if solution is None or count < _LEAST_SEGMENTS:
        raise DataError(
            f"{what} cannot be determined: only {count} of {len(segments)} stretches can be reconstructed with any "
            f"focal length near {start.fx:.0f} px; move sideways as well as turn, keep to a scene that stands still, "
            "and check --fov-deg"
        )
    first = next(_frames(recording, options.max_s, []), None)
    widened = 1.0 if first is not None and first.tracks is not None else _IMAGES_WIDER
    known = certainty(solution, widened)
    by_depth = focal_by_depth(options.source, solution.shared.camera) if recorded_path(options.source) else ""
    if isinstance(by_depth, FocalFit) and np.isfinite(known.wider[0]):
        solution = with_focal(solution, known, by_depth)
        known = certainty(solution, widened)
    result = SelfResult(solution, known, len(segments), recording.rig, "", widened, by_depth)
    result = _with_imu(result, recording, samples)
    refuse(what, _doubts(result))
    return result


def _with_imu(result: SelfResult, recording: Recording, samples: list[ImuSample]) -> SelfResult:
    """Return the result with rotation and offset against the IMU, or why there are none."""
    if recording.imu_noise is None or len(samples) < 2:
        return replace(result, without_imu="the recording has no IMU")
    zero_ns, noise = samples[0].t_ns, recording.imu_noise
    gyro = Gyro(
        zero_ns,
        np.array([(sample.t_ns - zero_ns) * 1e-9 for sample in samples]),
        np.array([sample.gyro_rad_s for sample in samples]),
        noise.gyroscope_noise_density,
        noise.gyroscope_scale_sigma or _GYRO_SCALE,
    )
    joint = with_gyro(result.solution, gyro)
    if isinstance(joint, str):
        return replace(result, without_imu=joint)
    known = certainty(joint, result.widened)
    turn_deg, offset_s = np.rad2deg(known.sigmas[GYRO : GYRO + 3].max()), known.sigmas[GYRO + OFFSET]
    if not (turn_deg < _MAX_TURN_SIGMA_DEG and offset_s < _MAX_OFFSET_SIGMA_S):
        return replace(
            result,
            without_imu=f"rotation and time offset would be known to {turn_deg:.1f} deg and {1e3 * offset_s:.1f} ms "
            "only; turn to and fro more briskly, about all axes",
        )
    lever = find_lever_arm(joint.pieces, joint.shared, samples, noise, result.widened)
    return replace(result, solution=joint, known=known, lever=lever)


def _chain(result: SelfResult) -> list[CameraCalibration]:
    """Return the chain: translation against the IMU, and the second camera, as the recording has them."""
    shared, rig = result.solution.shared, result.given
    alone = shared.gyro is None
    T_body_cam0 = rig.T_body_cams[0] if alone else _pose(result)
    offset_s, sigma_s = (None, None) if alone else (shared.time_offset_s, float(result.known.sigmas[GYRO + OFFSET]))
    first = CameraCalibration(result.camera, None if alone and not rig.is_stereo else T_body_cam0, offset_s, sigma_s)
    moved = T_body_cam0 @ invert(rig.T_body_cams[0])
    rest = zip(rig.cameras[1:], rig.T_body_cams[1:], strict=True)
    return [first, *(CameraCalibration(camera, moved @ T, offset_s, sigma_s) for camera, T in rest)]


def _pose(result: SelfResult) -> Array:
    R_body_cam = np.ascontiguousarray(result.solution.shared.R_cam_body.T)
    given_m = result.given.T_body_cams[0][:3, 3].copy()
    return transform(R_body_cam, given_m if result.arm_m is None else result.arm_m)


def _guess(given: Camera, options: SelfOptions) -> Camera:
    """Return the camera to begin with: of the recording's own only the size is used."""
    model: Model = "equidistant" if options.fov_deg > _WIDE_DEG else "radtan5"
    if options.model != "auto":
        model = options.model
    wide = model == "equidistant"
    half = 0.5 * np.deg2rad(options.fov_deg)
    focal = 0.5 * given.width / (half if wide else np.tan(half))
    return Camera(
        given.width, given.height, focal, focal, 0.5 * (given.width - 1), 0.5 * (given.height - 1), 0.0,
        "equidistant" if wide else "radtan", (0.0,) * COEFFICIENTS[model],
    )  # fmt: skip


def _frames(recording: Recording, max_s: float, samples: list[ImuSample]) -> Iterator[Frame]:
    """Yield the frames, and keep the inertial samples between them."""
    begin: int | None = None
    for value in recording.events():
        if isinstance(value, ImuSample):
            samples.append(value)
        if isinstance(value, Frame):
            begin = value.t_ns if begin is None else begin
            if value.t_ns - begin > max_s * 1e9:
                return
            yield value


def _rematched(recording: Recording, options: SelfOptions, pieces: Sequence[Piece], shared: Shared) -> list[Segment]:
    """Read the images again, those of one stretch at a time, and match its observations again."""
    frames = _frames(recording, options.max_s, [])
    out = []
    for piece in pieces:
        wanted = set(piece.segment.t_ns.tolist())
        images = []
        for frame in frames:
            if frame.t_ns in wanted and frame.images:
                images.append(frame.images[0])
            if frame.t_ns >= piece.segment.t_ns[-1]:
                break
        out.append(found_again(piece, shared, images) if len(images) == len(wanted) else piece.segment)
    return out


def _too_few(count: int) -> str:
    return (
        f"only {count} stretches of it show the same points from several sides, {_LEAST_SEGMENTS} are needed; wave the "
        "camera about for 60 s before something with texture, without blur"
    )


def _doubts(result: SelfResult) -> list[str]:
    doubts = []
    if result.solution.sigma_px > _MAX_SIGMA_PX:
        doubts.append(
            f"points are {result.solution.sigma_px:.1f} px from where a rigid scene has them; film what stands still, "
            "slowly enough for sharp images"
        )
    turned, travelled = _motion(result)
    moved = (
        f"in a stretch it turns by {turned[0]:.0f}, {turned[1]:.0f} and {turned[2]:.0f} deg about its x, y and z and "
        f"travels {travelled:.0%} of the distance of what it sees"
    )
    if not result.focal_sigma < _MAX_FOCAL_SIGMA:
        doubts.append(
            f"the focal length would be known to {result.focal_sigma:.1%} only: {moved}; turn it by 30 deg and more "
            "up and down and to both sides while it moves: straight motion alone never shows a focal length"
        )
    centre = float(np.max(result.known.sigmas[2:4]))
    if not centre < _MAX_CENTRE_SIGMA * result.camera.width:
        doubts.append(
            f"the principal point would be known to {centre:.0f} px only: {moved}; roll it about its optical axis by "
            "30 deg and more"
        )
    return doubts


def _motion(result: SelfResult) -> tuple[Array, float]:
    """Return by how much a usual stretch turns about the camera's axes [3] in degrees, and travels over distance."""
    turns, ways = [], []
    for piece in result.solution.pieces:
        middle = piece.at.R[len(piece.at.R) // 2]
        vectors = np.array([so3_log(np.ascontiguousarray(middle.T @ R)) for R in piece.at.R])
        turns.append(np.ptp(vectors, axis=0))
        ways.append(float(np.linalg.norm(np.ptp(piece.at.centre, axis=0))))
    return np.rad2deg(np.median(turns, axis=0)), float(np.median(ways))


def _statements(result: SelfResult) -> list[str]:
    said = []
    if result.widened > 1.0:
        said.append(
            f"sigmas are {result.widened:.0f} times what the stretches show: real images mislead all of them alike"
        )
    if result.known.grouping > 2.0:
        said.append(
            f"stretches contradict each other {np.sqrt(result.known.grouping):.1f} times as much as single pixels "
            "scatter; sigmas are widened by that"
        )
    readout_s, sigma_s = result.solution.shared.readout_s, float(result.known.sigmas[READOUT])
    if readout_s > max(_GLOBAL_S, _SAME * sigma_s):
        said.append(f"the shutter rolls: {1e3 * readout_s:.1f} ± {1e3 * sigma_s:.1f} ms from the first to the last row")
    fit = result.by_depth
    if isinstance(fit, str):
        said += [f"depth images say nothing of the focal length: {fit}"] if fit else []
    else:
        said.append(
            f"depth images say that the focal length is {fit.factor - 1.0:+.1%} ± {fit.sigma:.1%} of what tracks do"
        )
    if result.given.is_stereo:
        said.append("of two cameras the first was calibrated; the second stands as the recording has it")
    lost = result.segments - len(result.solution.pieces)
    if lost:
        said.append(f"{lost} of {result.segments} stretches could not be reconstructed")
    return said


def _named(camera: Camera, numbers: Array) -> dict[str, float]:
    """Return what stands for the lens and the readout among the unknowns, or among their sigmas, by name."""
    lens = dict(zip(parameter_names(camera), numbers.tolist(), strict=False))
    return lens | {"readout_s": float(numbers[READOUT])}


def _report(result: SelfResult, options: SelfOptions) -> dict[str, Any]:
    pieces = result.solution.pieces
    turned, travelled = _motion(result)
    return {
        "kind": "self",
        "model": result.camera.distortion,
        "size": [result.camera.width, result.camera.height],
        "fov_deg_told": options.fov_deg,
        "parameters": _named(result.camera, result.solution.shared.values),
        "sigmas": _named(result.camera, result.known.sigmas),
        "camera_imu": _imu_report(result),
        "sigma_px": result.solution.sigma_px,
        "grouping": result.known.grouping,
        "widened": result.widened,
        "stretches": len(pieces),
        "stretches_followed": result.segments,
        "keyframes": sum(len(piece.at.R) for piece in pieces),
        "points": sum(int(piece.kept.any(axis=0).sum()) for piece in pieces),
        "observations": sum(int(piece.kept.sum()) for piece in pieces),
        "turned_deg": turned.tolist(),
        "travelled": travelled,
        "focal_by_depth": _focal_report(result.by_depth),
        "statements": _statements(result),
    }


def _focal_report(fit: FocalFit | str) -> dict[str, Any] | None:
    if isinstance(fit, str):
        return {"reason_without": fit} if fit else None
    return {"factor": fit.factor, "sigma": fit.sigma}


def _imu_report(result: SelfResult) -> dict[str, Any]:
    shared, sigmas = result.solution.shared, result.known.sigmas[GYRO:]
    if shared.gyro is None:
        return {"reason_without": result.without_imu}
    return {
        "R_body_cam": shared.R_cam_body.T.tolist(),
        "rotation_sigma_deg": np.rad2deg(sigmas[:3]).tolist(),  # about the camera's axes
        "from_recording_deg": _difference_deg(result),
        "time_offset_s": shared.time_offset_s,
        "time_offset_sigma_s": float(sigmas[OFFSET]),
        "gyro_bias_rad_s": shared.gyro_bias_rad_s.tolist(),
        "gyro_bias_sigma_rad_s": sigmas[BIAS].tolist(),
        "gyro_scale": shared.gyro_scale,
        "gyro_scale_sigma": float(sigmas[SCALE]),
        "translation_m": _pose(result)[:3, 3].tolist(),
        "translation_determined": result.arm_m is not None,
        "accelerometer": None
        if result.lever is None
        else {
            "translation_m": result.lever.arm_m.tolist(),
            "translation_sigma_m": result.lever.known.sigmas[:3].tolist(),
            "bias_m_s2": result.lever.accel_bias_m_s2.tolist(),
            "bias_sigma_m_s2": result.lever.known.sigmas[3:].tolist(),
            "noise_of_places_m": result.lever.centre_sigma_m,
        },
    }


def _difference_deg(result: SelfResult) -> float:
    """Return by how much the rotation against the IMU differs from what the recording states."""
    turn = so3_log(np.ascontiguousarray(result.solution.shared.R_cam_body @ result.given.T_body_cams[0][:3, :3]))
    return float(np.rad2deg(np.linalg.norm(turn)))


def _lines(result: SelfResult) -> list[str]:
    values = _named(result.camera, result.solution.shared.values)
    sigmas = _named(result.camera, result.known.sigmas)
    pieces = result.solution.pieces
    numbers = [
        f"{name} {value:.2f} ± {sigma:.2f} px" if name[0] in "fc" else f"{name} {value:+.5f} ± {sigma:.5f}"
        for (name, value), sigma in zip(values.items(), sigmas.values(), strict=True)
    ]
    turned, travelled = _motion(result)
    return [
        f"{len(pieces)} stretches, {sum(len(p.at.R) for p in pieces)} keyframes, "
        f"{sum(int(p.kept.sum()) for p in pieces)} observations, {result.solution.sigma_px:.2f} px noise; turned by "
        f"{turned[0]:.0f}, {turned[1]:.0f}, {turned[2]:.0f} deg in each, travelled {travelled:.0%} of the distance",
        ", ".join(numbers[:4]),
        ", ".join(numbers[4:]),
        *_imu_lines(result),
        *_statements(result),
    ]


def _imu_lines(result: SelfResult) -> list[str]:
    shared, sigmas = result.solution.shared, result.known.sigmas[GYRO:]
    if shared.gyro is None:
        return [f"nothing of the IMU: {result.without_imu}"]
    rows = "; ".join(", ".join(f"{x:+.5f}" for x in row) for row in shared.R_cam_body.T)
    return [
        f"R_body_cam [{rows}], sigma about the camera's axes "
        f"{', '.join(f'{x:.2f}' for x in np.rad2deg(sigmas[:3]))} deg; {_difference_deg(result):.2f} deg from what the "
        "recording states",
        _arm_line(result),
        f"time offset {1e3 * shared.time_offset_s:+.2f} ± {1e3 * sigmas[OFFSET]:.2f} ms, to be added to the stamps of "
        "the camera",
    ]


def _arm_line(result: SelfResult) -> str:
    lever = result.lever
    if lever is None:
        return "translation: the accelerometer does not show it; the recording's own is written"
    numbers = ", ".join(
        f"{x:+.1f} ± {s:.1f}" for x, s in zip(1e2 * lever.arm_m, 1e2 * lever.known.sigmas[:3], strict=True)
    )
    if result.arm_m is not None:
        return f"translation {numbers} cm, by the accelerometer"
    return (
        f"translation {numbers} cm by the accelerometer, worse than {1e2 * _MAX_ARM_SIGMA_M:.0f} cm: the recording's "
        "own is written; measure it with a ruler, or turn briskly to and fro while the camera sees things nearby"
    )


def draw(figure: Figure, colors: Mapping[str, str], result: SelfResult) -> None:
    """Draw where points were seen, how leaving out a stretch moves the focal length, and the sigmas."""
    camera, known = result.camera, result.known
    seen, move, sure = figure.subplots(1, 3)
    for piece in result.solution.pieces:
        pixels = piece.segment.pixels[piece.kept]
        seen.plot(pixels[:, 0], pixels[:, 1], ".", markersize=0.8)
    seen.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal", title="where points were seen")
    moves = 100.0 * known.moves[:, :2] / [camera.fx, camera.fy]
    places = np.arange(1, len(moves) + 1)
    move.bar(places - 0.2, moves[:, 0], 0.4, color=colors["graph"], label="fx")
    move.bar(places + 0.2, moves[:, 1], 0.4, color=colors["ekf"], label="fy")
    move.legend()
    move.set(xlabel="stretch left out", title="moves the focal length by [%]")
    sure.barh(["fx", "fy", "cx", "cy"], known.sigmas[:4], color=colors["graph"])
    sure.set(title="sigma [px]")
    sure.invert_yaxis()
