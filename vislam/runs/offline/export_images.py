"""Keyframes with their cameras, poses and points as other programs read them: COLMAP's text model, nerfstudio's JSON.

Both count pixels from the corner of the first one, where ours count from its centre: half a pixel is added. World axes
are those of `map`, in metres.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.core.files import partial_folder, storage, write_json, write_text
from vislam.core.geometry import invert, quaternion_wxyz
from vislam.core.messages import Array, Frame
from vislam.core.progress import Progress, silent
from vislam.frontend.masks import Masks
from vislam.mapping.formats.ply import write_ply
from vislam.runs.folder import read_setup
from vislam.runs.offline.posed_images import PosedImages, posed_images
from vislam.runs.sources import open_source

_DEPTH_UNIT_M = 0.001  # of depth images, as nerfstudio takes them
_HALF_PX = 0.5
_GREY = 128
_CAMERA_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])  # nerfstudio's cameras look along -z, y is up


@dataclass(frozen=True, slots=True)
class ExportedImages:
    """What was written: images, points, observations, their mean error, and what was left out."""

    folders: tuple[Path, ...]
    images: int
    points: int
    observations: int
    mean_error_px: float  # over points, each the mean of its observations
    apart: int  # keyframes of submaps that no loop has joined


def export_images(
    run: Path,
    colmap: Path | None = None,
    nerfstudio: Path | None = None,
    poses: str = "graph",
    undistort: bool = False,
    progress: Progress = silent,
) -> ExportedImages:
    """Write the keyframes' images, depth, cameras, poses and triangulated points of a run.

    Args:
        run: the folder of the run; its recording is read again.
        colmap: new folder for COLMAP: `images/`, `depth/`, `masks/`, and `sparse/0` as text.
        nerfstudio: new folder for nerfstudio: `images/`, `depth/`, `masks/`, `transforms.json`, `points.ply`.
        poses: "graph", or NAME of a `trajectory_NAME.tum` of the run.
        undistort: resample images for pinhole cameras; depth as well.
        progress: takes what is done, of how much, and a note.

    Raises:
        UsageError: a folder exists, there is no such trajectory, or the format lacks the lens.
        DataError: the session or the recording cannot be used.
        StorageError: a folder cannot be written.
    """
    given = [folder for folder in (colmap, nerfstudio) if folder is not None]
    for folder in given:
        if folder.exists():
            raise UsageError(f"{folder} exists; choose another name, or remove it")
    found = posed_images(run, poses)
    shown = found.undistorted() if undistort else found
    if colmap is not None:
        cameras = "".join(colmap_camera(i + 1, camera) for i, camera in enumerate(shown.cameras))
    if nerfstudio is not None:
        model = _nerfstudio_model(shown)
    with _new_folders(given) as folders:
        writer = _ImageWriter(folders, found, shown if undistort else None)
        writer.read(run, progress)
        if colmap is not None:
            _write_colmap(folders[0], shown, cameras, writer)
        if nerfstudio is not None:
            _write_nerfstudio(folders[-1], shown, model, writer)
    mean = float(shown.mean_errors_px().mean()) if len(shown.points_m) else float("nan")
    return ExportedImages(tuple(given), len(shown.keyframe), len(shown.points_m), len(shown.image), mean, shown.apart)


@contextmanager
def _new_folders(paths: list[Path]) -> Iterator[list[Path]]:
    """Make folders that appear under their names when the block ends well, and not at all when it does not."""
    for path in paths:
        with storage(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        made = [stack.enter_context(partial_folder(path)) for path in paths]
        yield made
        for folder, path in zip(made, paths, strict=True):
            folder.chmod(0o755)
            folder.rename(path)


class _ImageWriter:
    """Writes the images of a recording that a run's keyframes saw, and gathers what colours its points have."""

    def __init__(self, folders: list[Path], found: PosedImages, shown: PosedImages | None) -> None:
        """`shown` has the cameras to resample for, None to leave images as they are."""
        self.colors: NDArray[np.uint8] = np.full((len(found.points_m), 3), _GREY, np.uint8)
        self.has_depth, self.has_mask = np.zeros((2, len(found.keyframe)), dtype=bool)
        self._folders, self._found = folders, found
        self._bounds = np.searchsorted(found.image, np.arange(len(found.keyframe) + 1))
        self._coloured = np.zeros(len(found.points_m), dtype=bool)
        self._maps = [] if shown is None else [
            camera.resampling_maps(np.asarray(np.linalg.inv(plain.K)), np.eye(3), (plain.width, plain.height))
            for camera, plain in zip(found.cameras, shown.cameras, strict=True)
        ]  # fmt: skip

    def read(self, run: Path, progress: Progress) -> None:
        """Take every image from the recording. Raises DataError where one is missing."""
        source, ran, _ = read_setup(run)
        try:
            recording = open_source(source, ran.seed, ran.calibration)
        except DataError as error:
            raise DataError(f"{error}; images are read from the recording again, and a live run keeps none") from error
        masks = Masks(ran.frontend.masks, recording.rig)
        waiting: dict[int, list[int]] = {}
        for i, t_ns in enumerate(self._found.camera_t_ns.tolist()):
            waiting.setdefault(t_ns, []).append(i)
        total = len(waiting)
        for value in recording.events():
            if not waiting:
                return
            if isinstance(value, Frame) and (images := waiting.pop(value.t_ns, None)) is not None:
                if not value.images:
                    raise DataError(f"{source} has points and no images: there is nothing to export")
                masked = masks.onto(value)
                for i in images:
                    self._take(i, masked)
                progress(total - len(waiting), total, "images")
        if waiting:
            raise DataError(
                f"{source} has no image at {min(waiting)} ns, nor at {len(waiting) - 1} other stamps of keyframes; "
                "give the recording that the run began with"
            )

    def _take(self, i: int, frame: Frame) -> None:
        side = int(self._found.camera[i])
        image = frame.color if side == 0 and frame.color is not None else frame.images[side]
        if not image.size:  # of a further camera
            image = np.zeros((self._found.cameras[side].height, self._found.cameras[side].width), np.uint8)
        self._colour(i, image)
        depth, mask = None, frame.mask(side)
        if side == 0 and frame.depth_m is not None:
            units = np.nan_to_num(frame.depth_m, nan=0.0, posinf=0.0, neginf=0.0) / _DEPTH_UNIT_M
            depth = np.where(units < 2**16 - 0.5, np.rint(np.maximum(units, 0.0)), 0.0).astype(np.uint16)
            self.has_depth[i] = True
        if self._maps:
            image = np.asarray(cv2.remap(image, *self._maps[side], cv2.INTER_LINEAR))
            depth, mask = (
                None if one is None else np.asarray(cv2.remap(one, *self._maps[side], cv2.INTER_NEAREST))
                for one in (depth, mask)
            )
        self._write("images", i, image)
        if depth is not None:
            self._write("depth", i, depth)
        if mask is not None:
            self.has_mask[i] = True
            self._write("masks", i, mask, ".png")  # after the image's own ending, where COLMAP looks for it

    def _colour(self, i: int, image: NDArray[np.uint8]) -> None:
        """Give points the colour of the first image that saw them."""
        rows = np.arange(self._bounds[i], self._bounds[i + 1])
        rows = rows[~self._coloured[self._found.point[rows]]]
        x, y = np.rint(self._found.pixels_px[rows]).astype(int).T
        seen = image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
        points = self._found.point[rows]
        self.colors[points] = seen[:, ::-1] if seen.ndim == 2 else seen[:, None]
        self._coloured[points] = True

    def _write(self, kind: str, i: int, image: NDArray[np.generic], ending: str = "") -> None:
        done, png = cv2.imencode(".png", image)
        if not done:
            raise DataError(f"the image of keyframe {self._found.keyframe[i]} cannot be written as PNG")
        for folder in self._folders:
            path = folder / kind / f"{image_name(self._found, i)}{ending}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(png.tobytes())


def image_name(found: PosedImages, i: int) -> str:
    """Return the name of an image below `images/` and `depth/`: camera and keyframe."""
    return f"cam{found.camera[i]}/{found.keyframe[i]:06d}.png"


def colmap_camera(number: int, camera: Camera) -> str:
    """Return a camera as a line of cameras.txt. Raises UsageError for a lens that COLMAP lacks."""
    k = camera.coefficients
    models = {"none": "PINHOLE", "equidistant": "OPENCV_FISHEYE", "rational": "FULL_OPENCV"}
    models["radtan"] = "OPENCV" if len(k) <= 4 else "FULL_OPENCV"
    model = models.get(camera.distortion)
    if model is None or camera.skew_px != 0.0:
        raise UsageError(f"COLMAP has no camera with {_lens(camera)}; add --undistort")
    numbers = [camera.fx, camera.fy, camera.cx + _HALF_PX, camera.cy + _HALF_PX, *k]
    numbers += [0.0] * ({"PINHOLE": 4, "OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12}[model] - len(numbers))
    return f"{number} {model} {camera.width} {camera.height} {' '.join(map(repr, map(float, numbers)))}\n"


def _lens(camera: Camera) -> str:
    return "skewed pixels" if camera.skew_px != 0.0 else f"{camera.distortion} distortion"


def _write_colmap(folder: Path, shown: PosedImages, cameras: str, writer: _ImageWriter) -> None:
    """Write cameras, images and points as https://colmap.github.io/format.html has them."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    write_text(sparse / "cameras.txt", cameras)
    bounds = np.searchsorted(shown.image, np.arange(len(shown.keyframe) + 1))
    lines = []
    for i, T in enumerate(shown.T_map_cam):
        T_cam_map = invert(T)
        pose = [*quaternion_wxyz(T_cam_map[:3, :3].copy()), *T_cam_map[:3, 3]]
        lines.append(f"{i + 1} {' '.join(_text(pose))} {shown.camera[i] + 1} {image_name(shown, i)}\n")
        rows = slice(bounds[i], bounds[i + 1])
        seen = zip(shown.pixels_px[rows] + _HALF_PX, shown.point[rows] + 1, strict=True)
        lines.append(" ".join(f"{x:.4f} {y:.4f} {point}" for (x, y), point in seen) + "\n")
    write_text(sparse / "images.txt", "".join(lines))
    tracks: list[list[str]] = [[] for _ in shown.points_m]
    for row, (image, point) in enumerate(zip(shown.image, shown.point, strict=True)):
        tracks[point].append(f"{image + 1} {row - bounds[image]}")
    error = shown.mean_errors_px()
    write_text(
        sparse / "points3D.txt",
        "".join(
            f"{p + 1} {' '.join(_text(xyz))} {' '.join(map(str, writer.colors[p]))} {error[p]:.4f} "
            f"{' '.join(tracks[p])}\n"
            for p, xyz in enumerate(shown.points_m)
        ),
    )


def _text(numbers: Any) -> list[str]:
    return [repr(float(number)) for number in numbers]


def _nerfstudio_model(shown: PosedImages) -> str:
    """Return nerfstudio's name of the cameras' model. Raises UsageError for a lens that it lacks."""
    models = {"none": "OPENCV", "radtan": "OPENCV", "equidistant": "OPENCV_FISHEYE"}
    found = {models.get(camera.distortion, "") for camera in shown.cameras}
    unfit = [camera for camera in shown.cameras if camera.skew_px != 0.0 or camera.distortion not in models]
    if unfit or len(found) > 1:
        what = _lens(unfit[0]) if unfit else "lenses of two kinds"
        raise UsageError(f"nerfstudio has no cameras with {what}; add --undistort")
    return found.pop()


def _write_nerfstudio(folder: Path, shown: PosedImages, model: str, writer: _ImageWriter) -> None:
    """Write transforms.json as https://docs.nerf.studio/quickstart/data_conventions.html has it, and the points."""
    frames = []
    for i, T in enumerate(shown.T_map_cam):
        name = image_name(shown, i)
        frame: dict[str, Any] = {"file_path": f"images/{name}"}
        if writer.has_depth[i]:
            frame["depth_file_path"] = f"depth/{name}"
        if writer.has_mask[i]:
            frame["mask_path"] = f"masks/{name}.png"
        frame |= _nerfstudio_lens(shown.cameras[shown.camera[i]])
        frames.append(frame | {"transform_matrix": (T @ _CAMERA_FROM_GL).tolist()})
    points: Array = shown.points_m
    write_ply(folder / "points.ply", points.astype(np.float32), writer.colors)
    whole = {"camera_model": model, "ply_file_path": "points.ply", "depth_unit_scale_factor": _DEPTH_UNIT_M}
    write_json(folder / "transforms.json", {**whole, "frames": frames})


def _nerfstudio_lens(camera: Camera) -> dict[str, Any]:
    names = ("k1", "k2", "k3", "k4") if camera.distortion == "equidistant" else ("k1", "k2", "p1", "p2", "k3")
    return {
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy,
        "cx": camera.cx + _HALF_PX, "cy": camera.cy + _HALF_PX,
        **dict(zip(names, camera.coefficients, strict=False)),
    }  # fmt: skip
