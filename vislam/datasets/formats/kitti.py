"""KITTI odometry: rectified stereo (or mono) images, `times.txt`, `calib.txt`, truth in `poses/XX.txt`; no IMU.

The body is the rectified camera 0, as in the benchmark's poses (Geiger et al., CVPR 2012).
"""

from __future__ import annotations

from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.core.reading import open_file, read_bytes
from vislam.core.recording import Problems, noted
from vislam.datasets.formats.truth import Truth, kitti_truth
from vislam.datasets.images import ImageList, UnreadableImageError, probe
from vislam.datasets.stream import Survey
from vislam.datasets.tables import MAX_FILE_BYTES, check_size, parse_seconds

LOOKS_FOR = "calib.txt and times.txt"
_PAIRS = ((0, 1), (2, 3))  # grey, colour
_MAX_CALIB_BYTES = 2**16


def recognises(path: Path) -> bool:
    """Return whether a folder is a sequence of KITTI's odometry benchmark."""
    return (path / "calib.txt").is_file() and (path / "times.txt").is_file()


def survey(path: Path) -> Survey:
    """Return what a KITTI sequence holds; what is wrong with it is in `errors`."""
    problems = Problems()
    errors: list[DataError] = []
    numbers = _camera_numbers(path)
    cameras: tuple[ImageList, ...] = ()
    rig, truth = None, None
    with noted(errors):
        if not numbers:
            raise DataError(f"{path} holds no images: looked for image_0 or image_2")
        t_ns = _times(path / "times.txt")
        cameras = tuple(_images(path / f"image_{number}", f"cam{i}", t_ns) for i, number in enumerate(numbers))
        truth = _truth(path, t_ns)
        rig = _rig(path / "calib.txt", numbers, _first_size(cameras[0]))
    return Survey(
        format="kitti", root=path, cameras=cameras, rig=rig, truth=truth, problems=problems, errors=tuple(errors)
    )


def _camera_numbers(path: Path) -> tuple[int, ...]:
    for pair in _PAIRS:
        if (path / f"image_{pair[0]}").is_dir():
            return tuple(number for number in pair if (path / f"image_{number}").is_dir())
    return ()


def _times(path: Path) -> NDArray[np.int64]:
    """Return the stamps [N]; row n belongs to image n, so a row that cannot be read makes the file unusable."""
    check_size(path, MAX_FILE_BYTES)
    stamps: list[int] = []
    with open_file(path) as file:
        for number in count(1):
            line = file.readline(256)
            if not line:
                break
            try:
                stamps.append(parse_seconds(line.decode("ascii")))
            except (ValueError, UnicodeDecodeError) as error:
                raise DataError(f"{path}:{number}: not a time in seconds: {line[:40]!r}") from error
            if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
                raise DataError(
                    f"{path}:{number}: time {line.decode('ascii').strip()} s does not rise; repair the list"
                )
    if not stamps:
        raise DataError(f"{path} holds no times; restore the benchmark's file")
    return np.array(stamps, dtype=np.int64)


def _images(folder: Path, name: str, t_ns: NDArray[np.int64]) -> ImageList:
    return ImageList(name, folder, t_ns, tuple(f"{i:06d}.png" for i in range(len(t_ns))))


def _first_size(images: ImageList) -> tuple[int, int]:
    for i in range(min(len(images.files), 100)):
        try:
            return probe(images.path(i))
        except UnreadableImageError:
            continue
    raise DataError(f"{images.folder} has no readable image among its first 100: looked for {images.path(0)}")


def _rig(path: Path, numbers: tuple[int, ...], size: tuple[int, int]) -> Rig:
    """Return cameras and their places from the projections `Pn: 12 numbers`: K [R | t] with R = I for all."""
    check_size(path, _MAX_CALIB_BYTES)
    projections: dict[str, Array] = {}
    for line in read_bytes(path, _MAX_CALIB_BYTES).decode("utf-8", errors="replace").splitlines():
        key, _, rest = line.partition(":")
        try:
            values = np.array([float(x) for x in rest.split()])
        except ValueError:
            continue
        if len(values) == 12 and np.all(np.isfinite(values)):
            projections[key.strip()] = values.reshape(3, 4)
    cameras, poses = [], []
    for number in numbers:
        P = projections.get(f"P{number}")
        if P is None or P[0, 0] <= 0.0 or P[1, 1] <= 0.0:
            raise DataError(f"{path} has no usable line `P{number}: 12 numbers`; restore the benchmark's file")
        cameras.append(Camera(*size, fx=P[0, 0], fy=P[1, 1], cx=P[0, 2], cy=P[1, 2]))
        T_body_cam = np.eye(4)
        T_body_cam[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
        poses.append(T_body_cam)
    return Rig(tuple(cameras), tuple(poses))


def _truth(path: Path, t_ns: NDArray[np.int64]) -> Truth | None:
    root = path.resolve()
    for poses in (root.parent / "poses", root.parent.parent / "poses"):
        if (poses / f"{root.name}.txt").is_file():
            return kitti_truth(poses / f"{root.name}.txt", t_ns)
    return None
