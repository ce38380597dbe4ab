"""What apps on phones write: rates, forces and frames as tables beside a film.

Four descriptions are read, each recognised by the names of its files and columns:

- Sensor Logger (tszheichoi.com): `Gyroscope.csv`, `TotalAcceleration.csv` or `Accelerometer.csv` with `Gravity.csv`;
- the Mobile AR Sensor (MARS) logger: `gyro_accel.csv`, `frame_timestamps.txt` or `movie_metadata.csv`, `movie.mp4`;
- ADVIO (Cortés et al., ECCV 2018): `gyro.csv`, `accelerometer.csv`, `frames.csv`, `frames.mov`;
- any other pair of tables of rates and forces, with a film or without.

The camera's calibration is `camera.yaml` in the folder, the IMU's noise `imu.yaml`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.geometry import invert
from vislam.core.reading import read_text
from vislam.core.recording import Problems, noted
from vislam.datasets.calibration import CAMERA_EXAMPLE, read_camera, read_imu
from vislam.datasets.images import ImageList
from vislam.datasets.imu_pairs import ImuRows
from vislam.datasets.imu_tables import (
    STANDARD_GRAVITY_M_S2,
    Pair,
    Table,
    holds_pair,
    pair_in,
)
from vislam.datasets.loaders import check_film
from vislam.datasets.stream import Survey, image_list
from vislam.datasets.tables import Row, film_stamps, header, parse_ns, parse_seconds, read_frame_stamps
from vislam.trajectory.formats import is_number

LOOKS_FOR = (
    "Gyroscope.csv of Sensor Logger, gyro_accel.csv of the MARS logger, gyro.csv, accelerometer.csv and frames.mov, or "
    "gyro.csv and accel.csv"
)
_MOST_METADATA_BYTES = 2**16
_LOOKED_AT = 500  # forces, to distinguish g from m/s^2
_AXES = ("x", "y", "z")
_RATES = ("gx[rad/s]", "gy[rad/s]", "gz[rad/s]")
_FORCES = ("ax[m/s^2]", "ay[m/s^2]", "az[m/s^2]")
Logger = Literal["Sensor Logger", "MARS logger", "ADVIO", "two tables"]


def recognises(path: Path) -> bool:
    """Return whether a folder holds the tables of a logger that is known."""
    return path.is_dir() and _logger(path) is not None


def survey(path: Path) -> Survey:
    """Return what a folder of a phone's recording holds; what is wrong with it is in `errors`."""
    problems, errors = Problems(), list[DataError]()
    samples: ImuRows | None = None
    findings: list[Finding] = []
    imu_noise, T_body_imu, rig, video = None, np.eye(4), None, None
    cameras: tuple[ImageList, ...] = ()
    logger = _logger(path)
    with noted(errors):
        samples, findings = _samples(path, logger)
        imu_noise, T_body_imu = read_imu(_asked(path / "imu.yaml", "write the noise of the IMU into it"))
    if logger == "two tables" and not _films(path):
        return Survey("phone", path, samples=samples, imu_noise=imu_noise, findings=tuple(findings),
                      problems=problems, errors=tuple(errors))  # fmt: skip
    with noted(errors):
        file = read_camera(_asked(path / "camera.yaml", f"write the calibration into it: {CAMERA_EXAMPLE}"))
        rig = Rig((file.camera,), (invert(T_body_imu) @ file.T_body_cam,))
    with noted(errors):
        images, video = _frames(path, logger, problems)
        cameras = (images,)
        if video is not None:
            check_film(video, images, rig, problems)
    return Survey(
        format="phone", root=path, cameras=cameras, video=video, rig=rig, samples=samples, imu_noise=imu_noise,
        findings=tuple(findings), problems=problems, errors=tuple(errors),
    )  # fmt: skip


def _logger(path: Path) -> Logger | None:
    """Return which logger wrote a folder."""
    if {"time", "seconds_elapsed", *_AXES} <= {*header(path / "Gyroscope.csv")}:
        return "Sensor Logger"
    if {*_RATES, *_FORCES} <= {*header(path / "gyro_accel.csv")}:
        return "MARS logger"
    if all((path / name).is_file() for name in ("frames.mov", "frames.csv", "accelerometer.csv")) and _advio_rates(
        path
    ):
        return "ADVIO"
    return "two tables" if holds_pair(path) else None


def _advio_rates(path: Path) -> Path | None:
    """Return the table of rates: `gyro.csv` in the archives, `gyroscope.csv` in their description."""
    return next((path / name for name in ("gyro.csv", "gyroscope.csv") if (path / name).is_file()), None)


def _asked(path: Path, what: str) -> Path:
    if not path.is_file():
        raise DataError(f"{path} is missing; {what}, see docs/formats.md")
    return path


def _samples(path: Path, logger: Logger | None) -> tuple[ImuRows, list[Finding]]:
    """Return the inertial samples and what doctor reports of them; raises DataError where a table is missing."""
    if logger == "Sensor Logger":
        return _of_sensor_logger(path)
    if logger == "MARS logger":
        table = path / "gyro_accel.csv"
        names = header(table)
        columns = tuple(names.index(name) for name in (*_RATES, *_FORCES))
        parse = _stamp_parser(names[0], table)
        what = "MARS logger: forces were interpolated at the stamps of the rates by the app"
        return Table(table, columns, 0, parse), [Finding("ok", what, path.name)]
    if logger == "two tables" and (found := pair_in(path)) is not None:
        return found[0], [found[1]]
    return _of_advio(path)


def _of_sensor_logger(path: Path) -> tuple[ImuRows, list[Finding]]:
    platform, standardised = _platform(path)
    app = f"Sensor Logger on {platform or 'a phone that it does not name'}"
    # Apple gives forces of inertia: at rest gravity points down. Android, and the app where it standardises, the other
    factor = -1.0 if platform == "ios" and not standardised else 1.0
    rates = _of_axes(path / "Gyroscope.csv", 1.0)
    if (path / "TotalAcceleration.csv").is_file():
        forces = _of_axes(path / "TotalAcceleration.csv", factor)
        what = f"{app}: TotalAcceleration.csv is interpolated at the stamps of Gyroscope.csv"
        return Pair(rates, forces), [Finding("ok", what, path.name)]
    if not (path / "Accelerometer.csv").is_file():
        raise DataError(
            f"{path} holds neither TotalAcceleration.csv nor Accelerometer.csv; record the accelerometer, too"
        )
    if not (path / "Gravity.csv").is_file():
        raise DataError(
            f"{path / 'Accelerometer.csv'} is without gravity, and there is no Gravity.csv to add; record the sensor "
            "Gravity, too"
        )
    if not platform:
        raise DataError(
            f"{path / 'Metadata.csv'} does not say the platform, on which the sign of Accelerometer.csv depends; copy "
            "it from the recording"
        )
    forces, gravity = (_of_axes(path / name, factor) for name in ("Accelerometer.csv", "Gravity.csv"))
    sign = ", negated as it is Apple's" if factor < 0.0 else ""
    what = f"{app}: Accelerometer.csv and Gravity.csv are added{sign} and interpolated at the stamps of Gyroscope.csv"
    return Pair(rates, forces, gravity), [Finding("ok", what, path.name)]


def _of_axes(path: Path, factor: float) -> Table:
    names = header(path)
    if not {"time", *_AXES} <= {*names}:
        raise DataError(f"{path} lacks the columns time, x, y, z; it has {', '.join(names) or 'no header'}")
    return Table(path, tuple(names.index(axis) for axis in _AXES), names.index("time"), parse_ns, factor)


def _platform(path: Path) -> tuple[str, bool]:
    """Return the platform in Metadata.csv, empty where it is not given, and whether the app standardised its frames."""
    file = path / "Metadata.csv"
    if not file.is_file():
        return "", False
    try:
        row = next(csv.DictReader(read_text(file, _MOST_METADATA_BYTES).splitlines()), {})
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{file} cannot be read: {error}; copy it again") from error
    platform = (row.get("platform") or "").strip().lower()
    return platform if platform in ("ios", "android") else "", (row.get("standardisation") or "").strip() == "true"


def _of_advio(path: Path) -> tuple[ImuRows, list[Finding]]:
    rates = _advio_rates(path)
    assert rates is not None
    forces = Table(path / "accelerometer.csv", (1, 2, 3), 0, parse_seconds)
    rows = forces.rows(Problems())
    norms = [math.hypot(*row[1]) for row, _ in zip(rows, range(_LOOKED_AT), strict=False)]
    usual = float(np.median(norms)) if norms else math.nan
    in_g = usual < 0.5 * STANDARD_GRAVITY_M_S2
    unit = "g, as its description states" if in_g else "m/s^2, though its description states g"
    what = (
        f"ADVIO: accelerometer.csv of usually {usual:.2f} is taken as {unit}; interpolated at the stamps of the rates"
    )
    factor = STANDARD_GRAVITY_M_S2 if in_g else 1.0
    forces = Table(forces.path, forces.columns, 0, parse_seconds, factor)
    return Pair(Table(rates, (1, 2, 3), 0, parse_seconds), forces), [Finding("ok", what, path.name)]


def _stamp_parser(name: str, path: Path) -> Callable[[str], int]:
    """Return what reads stamps by the unit in the name of their column."""
    if "[nanosec]" in name:
        return parse_ns
    if "[sec]" in name:
        return parse_seconds
    raise DataError(f"{path}: the unit of the stamps is not stated in '{name[:40]}'; [nanosec] or [sec] is read")


def _frames(path: Path, logger: Logger | None, problems: Problems) -> tuple[ImageList, Path | None]:
    """Return the frames and the film that they are in, None where they are images."""
    if logger == "Sensor Logger":
        return _sensor_logger_frames(path, problems)
    parse: Callable[[str], int] = parse_seconds
    video, stamps = path / "frames.mov", path / "frames.csv"
    if logger == "two tables":
        video, parse = _films(path)[0], parse_ns
        stamps = film_stamps(video)
        if len(_films(path)) > 1:
            raise DataError(f"{path} holds {len(_films(path))} films; keep one, or name one as video:FILE")
    if logger == "MARS logger":
        video = next(
            (v for v in sorted(path.glob("movie.*")) if v.suffix.lower() in (".mp4", ".mov")), path / "movie.mp4"
        )
        named = [path / name for name in ("frame_timestamps.txt", "movie_metadata.csv")]
        stamps = next((file for file in named if file.is_file()), named[0])
        names = header(_asked(stamps, "copy it from the phone"), fits=lambda names: not is_number(names[0]))
        parse = _stamp_parser(names[0], stamps) if names else parse_ns
    _asked(video, "copy it from the phone")
    return image_list(
        "cam0",
        path,
        read_frame_stamps(_asked(stamps, "write the time of each frame into it"), problems, parse),
        problems,
    ), video


def _films(path: Path) -> list[Path]:
    return sorted(file for file in path.iterdir() if file.suffix.lower() in (".mp4", ".mov"))


def _sensor_logger_frames(path: Path, problems: Problems) -> tuple[ImageList, Path | None]:
    """Return the frames in `Camera/`: images that are named by their time, or a film with its stamps beside it."""
    folder = path / "Camera"
    films = sorted(folder.glob("*.mp4")) if folder.is_dir() else []
    if len(films) == 1:
        stamps = films[0].with_suffix(".csv")
        what = "write one row a frame into it, its time in ns since 1970 as in Gyroscope.csv"
        return image_list("cam0", path, read_frame_stamps(_asked(stamps, what), problems), problems), films[0]
    if films:
        raise DataError(f"{folder} holds {len(films)} films; keep one, or name one as video:FILE")
    return image_list("cam0", folder, _named_by_time(folder), problems), None


def _named_by_time(folder: Path) -> Iterator[Row[str]]:
    """Yield the stamps and names of images that are named by milliseconds since 1970."""
    files = [file for file in folder.glob("*.jpg") if file.stem.isdecimal() and len(file.stem) < 16]
    if not files:
        raise DataError(f"{folder} holds no film and no image named by its time; record with the camera switched on")
    for file in sorted(files, key=lambda file: int(file.stem)):
        yield int(file.stem) * 1_000_000, file.name
