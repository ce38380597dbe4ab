"""The TUM RGB-D benchmark: colour and depth images associated by time; the body is the colour camera.

Intrinsics are those that the benchmark publishes per camera (Sturm et al., "A benchmark for the evaluation of RGB-D
SLAM systems", IROS 2012, and the page "file formats" beside it), unless the folder brings its own calibration. Depth is
registered to colour, 5000 units per metre, unless `depth/sensor.yaml` states others; the page's depth correction is
already in the images. The accelerometer has no gyroscope beside it: it shows which way is up, and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.recording import Problems, noted
from vislam.datasets.calibration import CAMERA_EXAMPLE, CameraFile, depth_format, read_camera
from vislam.datasets.formats.truth import tum_truth
from vislam.datasets.images import DepthFormat, ImageList
from vislam.datasets.stream import ForceRows, Survey, image_list, with_depth_format
from vislam.datasets.tables import Row, parse_seconds, read_names, read_numbers

LOOKS_FOR = "rgb.txt"
_DEPTH_UNITS_PER_M = 5000.0
_FORCE_SIGNS = (-1.0, -1.0, 1.0)  # of the Kinect's accelerometer in camera axes, as freiburg1_desk's truth shows
_DEPTH_FILE = "depth/sensor.yaml"  # where depth has one of its own
_CALIBRATION_FILES = ("sensor.yaml", "calibration.yaml")
_FR1 = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
_FR2 = (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)
PUBLISHED = {
    "1": Camera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989, 0.0, "radtan", _FR1),
    "2": Camera(640, 480, 520.908620, 521.007327, 325.141442, 249.701764, 0.0, "radtan", _FR2),
    "3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),  # published as already undistorted
}


def recognises(path: Path) -> bool:
    """Return whether a folder has TUM's list of colour images."""
    return (path / "rgb.txt").is_file()


def survey(path: Path) -> Survey:
    """Return what a TUM folder holds; what is wrong with it is in `errors`."""
    problems = Problems()
    errors: list[DataError] = []
    how = DepthFormat(_DEPTH_UNITS_PER_M)
    calibration: CameraFile | None = None
    color = depth = None
    with noted(errors):
        calibration = _calibration(path)
        how = calibration.depth.over(how)
        if (path / _DEPTH_FILE).is_file():
            how = depth_format(path / _DEPTH_FILE, calibration.camera, how)
    with noted(errors):
        color = _images("cam0", path, "rgb.txt", problems)
        if (path / "depth.txt").is_file():
            depth = _images("depth0", path, "depth.txt", problems)
    rig = None
    if calibration is not None:
        rig = Rig((calibration.camera,), (np.eye(4),), has_depth=depth is not None)
    truth = path / "groundtruth.txt"
    found = Survey(
        format="tum",
        root=path,
        cameras=() if color is None else (color,),
        depth=depth,
        rig=rig,
        truth=tum_truth(truth) if truth.is_file() else None,
        forces=_forces(path / "accelerometer.txt") if (path / "accelerometer.txt").is_file() else None,
        problems=problems,
        errors=tuple(errors),
        depth_format=DepthFormat(_DEPTH_UNITS_PER_M),
    )
    return with_depth_format(found, how)


def _forces(path: Path) -> ForceRows:
    """Return what reads an accelerometer's file: seconds and three numbers, turned into the camera's axes."""

    def read(problems: Problems) -> Iterator[Row[list[float]]]:
        for t_ns, (x, y, z) in read_numbers(path, 3, problems, parse_seconds, separator=None):
            yield t_ns, [_FORCE_SIGNS[0] * x, _FORCE_SIGNS[1] * y, _FORCE_SIGNS[2] * z]

    return read


def _images(name: str, root: Path, list_name: str, problems: Problems) -> ImageList:
    rows = read_names(root / list_name, problems, parse_seconds, separator=None)
    return image_list(name, root, rows, problems)


def _calibration(path: Path) -> CameraFile:
    for name in _CALIBRATION_FILES:
        if (path / name).is_file():
            return read_camera(path / name)
    match = re.search(r"(?:freiburg|fr)([123])(?!\d)", path.resolve().name)
    if match is None:
        raise DataError(
            f"{path} names none of the benchmark's cameras (freiburg1, fr2, ...) and holds no calibration; "
            f"write {path / _CALIBRATION_FILES[0]} with {CAMERA_EXAMPLE}, depth_units_per_m: 5000"
        )
    return CameraFile(PUBLISHED[match.group(1)], np.eye(4))
