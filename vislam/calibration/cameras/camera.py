"""`vislam calibrate camera`: intrinsics from views of a printed board, with residuals, coverage and sigmas.

Each model is judged by Schwarz's criterion (Annals of Statistics 1978) on one noise, that of the model which fits best.
A corner that a model cannot explain, or cannot image at all, costs a fixed amount, so that models which see less of the
field of view are not better for it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vislam.calibration.cameras.board import View, board_of
from vislam.calibration.cameras.lens import WIDE, LensFit, Model, direction_sigma_px, fit_lens
from vislam.calibration.cameras.views import Found, choose, find_views, images_of, live_images
from vislam.calibration.options import CameraOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.config import WebcamConfig
from vislam.core.angles import angle_deg
from vislam.core.camera import CameraSigmas
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.datasets.calibration_text import camera_text
from vislam.datasets.camera_files import camchain_text, camera_info_text
from vislam.datasets.foreign_cameras import CameraCalibration

_FILES = ("camchain.yaml", "camera.yaml", "camera_info.yaml", "camera.png", "camera.json")
_MIN_VIEWS = 6
_CELLS = (6, 4)  # columns, rows of the image that are to be covered
_MIN_COVERED = 0.6
_MIN_TILT_DEG = 15.0  # of the board against the image, in the most slanted views: facing boards hide the focal length
_MAX_FOCAL_SIGMA = 0.005  # relative
_MAX_CENTRE_SIGMA_PX = 5.0
_MAX_RMS_PX = 2.0  # worse, it is another board, or blur
_CANDIDATES: tuple[Model, ...] = ("radtan", "equidistant", "radtan5", "ucm", "eucm", "ds", "omni")  # the usual first
_DECISIVE = 10.0  # of the criterion: very strong evidence (Kass and Raftery 1995)
_LOST = 25.0  # squared sigmas at most that a corner costs


def choose_lens(
    views: list[View], size: tuple[int, int], with_skew: bool = False
) -> tuple[Model, LensFit, dict[Model, float]]:
    """Return the model to use, its fit, and the criterion of each that can be fitted, beyond the best's.

    The first of the candidates is taken to which no other is decisively better. Raises DataError when none fits.
    """
    fits: dict[Model, LensFit] = {}
    refusals: list[str] = []
    for model in _CANDIDATES:
        try:
            fits[model] = fit_lens(views, size, model, with_skew)
        except (DataError, np.linalg.LinAlgError) as error:
            refusals.append(str(error))
    if not fits:
        raise DataError(refusals[0])
    variance = min(_variance(fit) for fit in fits.values())
    count = sum(2 * len(view.points_m) for view in views)
    criterion = {
        model: sum(_cost(r, variance) for r in fit.residuals_px) + len(fit.values) * float(np.log(count))
        for model, fit in fits.items()
    }
    least = min(criterion.values())
    beyond = {model: value - least for model, value in criterion.items()}
    model = next(model for model in fits if beyond[model] < _DECISIVE)
    return model, fits[model], beyond


def _variance(fit: LensFit) -> float:
    """Return the variance of a coordinate [px^2], where at most as many corners are left out as count in it."""
    every = np.concatenate(fit.residuals_px)
    lost = np.isnan(every).mean()
    return float("inf") if lost > 0.5 else float(np.nanmean(every**2)) / (1.0 - lost) ** 2


def _cost(residuals_px: Array, variance: float) -> float:
    squares = np.nan_to_num(np.sum(residuals_px**2, axis=1) / variance, nan=_LOST)
    return float(np.minimum(squares, _LOST).sum())


@dataclass(frozen=True, slots=True, eq=False)
class CameraResult:
    """The fit, what it rests on and how much of the image that covers."""

    found: Found
    views: list[View]
    model: Model
    fit: LensFit
    covered: Array  # [rows, columns] corners seen in each cell
    tilts_deg: Array  # [V] of the board against the image
    criterion: Mapping[Model, float]  # of each model that was tried, beyond the best's


def calibrate_camera(options: CameraOptions) -> Outcome:
    """Calibrate and write; raises DataError when the views do not determine the camera."""
    folder = Folder(options.out, _FILES, options.overwrite)
    found = _look(options)
    result = solve_camera(found, options)
    sigmas = replace(CameraSigmas(), focal=_focal_sigma(result.fit))
    camera, report = replace(result.fit.camera, sigmas=sigmas), _report(result, options)
    comment = (
        f"{len(result.views)} views, rms {result.fit.rms_px:.2f} px, "
        f"focal length to {_focal_sigma(result.fit):.2%} (1 sigma)"
    )
    path = folder.write_text("camchain.yaml", camchain_text([CameraCalibration(camera)], comment))
    folder.write_text("camera.yaml", camera_text(camera, None, comment))
    if not camera.model.is_spherical:
        folder.write_text("camera_info.yaml", camera_info_text(camera, "cam0"))
    else:
        (options.out / "camera_info.yaml").unlink(missing_ok=True)  # of an earlier calibration
    folder.write_picture("camera.png", (11.0, 7.4), lambda figure, colors: draw(figure, colors, result))
    folder.write_report("camera.json", report)
    lines = (*_lines(result), f"next: vislam run ... --calibration.camera {path}")
    return Outcome(report, lines, tuple(folder.files))


def solve_camera(found: Found, options: CameraOptions) -> CameraResult:
    """Return the camera; raises DataError that names the views that lack."""
    views = choose(found.views, found.size, options.max_views)
    what = f"the camera in {options.source}"
    if len(views) < _MIN_VIEWS:
        board = options.board
        refuse(
            what,
            [f"{len(found.views)} of {found.searched} images show the board, {len(views)} of them differ; {_MIN_VIEWS} "
             f"views are the least and 20 are good. The board that was looked for: {board.kind}, {board.columns} x "
             f"{board.rows} squares, {board.dictionary}"],
        )  # fmt: skip
    covered = coverage(views, found.size)
    share = float(np.mean(covered > 0))
    refuse(what, [] if share >= _MIN_COVERED else [f"only {share:.0%} of the image has seen corners of the board; "
                                                  f"show it {_empty_parts(covered)}"])  # fmt: skip
    if options.model == "auto":
        model, fit, criterion = choose_lens(views, found.size, options.skew)
    else:
        model, criterion = options.model, {}
        fit = fit_lens(views, found.size, model, options.skew)
    tilts = np.array([_tilt_deg(T) for T in fit.T_cam_board])
    result = CameraResult(found, views, model, fit, covered, tilts, criterion)
    refuse(what, _doubts(result))
    return result


def coverage(views: list[View], size: tuple[int, int]) -> Array:
    """Return how many corners were seen in each cell [rows, columns] of the image."""
    pixels = np.concatenate([view.pixels for view in views])
    columns, rows = _CELLS
    edges = (np.linspace(0, size[1], rows + 1), np.linspace(0, size[0], columns + 1))
    return np.histogram2d(pixels[:, 1], pixels[:, 0], bins=edges)[0]


def _look(options: CameraOptions) -> Found:
    board = board_of(options.board)
    scheme, _, device = options.source.partition(":")
    if scheme != "webcam":
        return find_views(images_of(options.source, options.max_images), board)
    from vislam.hw.cameras.webcam import Webcam

    webcam = Webcam(replace(WebcamConfig(), device=device or "0"))
    try:
        return find_views(live_images(webcam, options.live_s), board)
    finally:
        webcam.close()


def _doubts(result: CameraResult) -> list[str]:
    fit = result.fit
    doubts = []
    if fit.rms_px > _MAX_RMS_PX:
        doubts.append(
            f"corners are {fit.rms_px:.1f} px off on average; check that the board is flat and that columns, rows and "
            "dictionary are those of the print, or try another --model"
        )
    if float(np.quantile(result.tilts_deg, 0.8)) < _MIN_TILT_DEG:
        doubts.append(
            f"the board nearly always faces the camera ({np.max(result.tilts_deg):.0f} deg of slant at most); "
            "tilt it by 30 to 45 deg to all sides"
        )
    if not _focal_sigma(fit) < _MAX_FOCAL_SIGMA:
        doubts.append(
            f"the focal length would be known to {_focal_sigma(fit):.1%} only; tilt the board, and come closer"
        )
    centre = float(np.max(fit.sigmas[2:4]))
    if not centre < _MAX_CENTRE_SIGMA_PX:
        doubts.append(f"the principal point would be known to {centre:.1f} px only; tilt the board to all four sides")
    return doubts


def _focal_sigma(fit: LensFit) -> float:
    return float(max(fit.sigmas[0] / fit.camera.fx, fit.sigmas[1] / fit.camera.fy))


def _tilt_deg(T_cam_board: Array) -> float:
    """Return the angle between the board's normal and the ray to its middle."""
    tilt_deg = angle_deg(T_cam_board[:3, 2], T_cam_board[:3, 3])
    return min(tilt_deg, 180.0 - tilt_deg)  # whichever side of the board its normal points to


def _empty_parts(covered: Array) -> str:
    names = {"top": covered[0], "bottom": covered[-1], "left": covered[:, 0], "right": covered[:, -1]}
    empty = [name for name, cells in names.items() if np.mean(cells > 0) < 0.5]
    return f"at the {', '.join(empty)} as well" if empty else "nearer, so that it fills more of the image"


def _statements(result: CameraResult) -> list[str]:
    grid = direction_sigma_px(result.fit, 25, 19)
    said = [
        f"rays are right to {np.nanmedian(grid):.2f} px in the middle of all and {np.nanmax(grid):.2f} px in the worst "
        "corner (1 sigma, a common turn left away)"
    ]
    if result.criterion:
        others = ", ".join(f"{name} {beyond:+.0f}" for name, beyond in result.criterion.items() if name != result.model)
        said.append(
            f"the lens is {result.model}, by evidence; Schwarz's criterion of the others: {others or 'none fits'}"
        )
    if result.model in WIDE:
        said.append("ROS has no such lens: camera_info.yaml is not written; --model equidistant is one that it has")
    if result.fit.grouping > 2.0:
        said.append(
            f"views contradict each other {np.sqrt(result.fit.grouping):.1f} times as much as their corners scatter (a "
            "board that is not flat, blur, a lens that moves); sigmas are widened by that"
        )
    if result.fit.with_skew:
        skew, sigma = result.fit.values[4], result.fit.sigmas[4]
        known = "differs from zero" if abs(skew) > 3.0 * sigma else "may well be zero, as chips' is: leave --skew out"
        said.append(f"the skew, {skew:+.2f} ± {sigma:.2f} px, {known}")
    share = float(np.mean(result.covered > 0))
    if share < 0.95:
        said.append(f"{1.0 - share:.0%} of the image never saw the board; there the lens is extrapolated")
    return said


def _report(result: CameraResult, options: CameraOptions) -> dict[str, Any]:
    fit = result.fit
    views = {
        view.name: {
            "corners": len(view.points_m),
            "rms_px": float(np.sqrt(np.nanmean(np.sum(r**2, axis=1)))),
            "tilt_deg": float(tilt),
        }
        for view, r, tilt in zip(result.views, fit.residuals_px, result.tilts_deg, strict=True)
    }
    return {
        "kind": "camera",
        "model": result.model,
        "criterion": dict(result.criterion),
        "size": list(result.found.size),
        "parameters": dict(zip(fit.names, fit.values.tolist(), strict=True)),
        "sigmas": dict(zip(fit.names, fit.sigmas.tolist(), strict=True)),
        "rms_px": fit.rms_px,
        "grouping": fit.grouping,
        "outliers": fit.outliers,
        "images": result.found.searched,
        "unreadable": result.found.unreadable,
        "images_with_board": len(result.found.views),
        "coverage": float(np.mean(result.covered > 0)),
        "views": views,
        "statements": _statements(result),
    }


def _lines(result: CameraResult) -> list[str]:
    fit = result.fit
    rms = [float(np.sqrt(np.nanmean(np.sum(r**2, axis=1)))) for r in fit.residuals_px]
    worst = int(np.argmax(rms))
    numbers = [
        f"{name} {value:.2f} ± {sigma:.2f} px" if name[0] in "fcs" else f"{name} {value:+.5f} ± {sigma:.5f}"
        for name, value, sigma in zip(fit.names, fit.values, fit.sigmas, strict=True)
    ]
    return [
        f"{len(result.views)} views of {len(result.found.views)} images with the board ({result.found.searched} "
        f"searched), {np.mean(result.covered > 0):.0%} of the image covered",
        ", ".join(numbers[:4]),
        ", ".join(numbers[4:]),
        f"rms {fit.rms_px:.3f} px, {fit.outliers} corners left out; worst view {result.views[worst].name} with "
        f"{rms[worst]:.2f} px",
        *_statements(result),
    ]


def draw(figure: Figure, colors: Mapping[str, str], result: CameraResult) -> None:
    """Draw where corners were seen, how sure rays are, residuals, and each view's error and slant."""
    width, height = result.found.size
    (cover, sure), (residual, per_view) = figure.subplots(2, 2)
    for view in result.views:
        cover.plot(view.pixels[:, 0], view.pixels[:, 1], ".", markersize=2.5)
    cover.set_title("corners that were seen")
    grid = direction_sigma_px(result.fit, 61, 46)
    image = sure.imshow(grid, extent=(0, width, height, 0), cmap="viridis", interpolation="bilinear")
    figure.colorbar(image, ax=sure, shrink=0.85)
    sure.set_title("uncertainty of rays [px], 1 sigma")
    sure.grid(False)
    for axes in (cover, sure):
        axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
    every = np.concatenate(result.fit.residuals_px)
    residual.plot(every[:, 0], every[:, 1], ".", markersize=2, color=colors["graph"])
    residual.set(title=f"residuals [px], rms {result.fit.rms_px:.3f}", aspect="equal")
    rms = [np.sqrt(np.nanmean(np.sum(r**2, axis=1))) for r in result.fit.residuals_px]
    per_view.bar(np.arange(1, len(rms) + 1), rms, color=colors["graph"])
    per_view.set(xlabel="view", title="rms [px] (bars) and slant [deg] (dots)")
    slant = per_view.twinx()
    slant.plot(np.arange(1, len(rms) + 1), result.tilts_deg, "o", markersize=4, color=colors["ekf"])
    slant.grid(False)
