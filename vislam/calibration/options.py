"""The options of every kind of `vislam calibrate`; their comments and docstrings are its --help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True)
class NoiseOptions:
    """Options of `vislam calibrate noise`."""

    source: Positional[Path]
    """Recording (folder, or csv like imu0/data.csv) of the sensor standing still, an hour or more"""
    out: Path = Path("calibration")
    """Folder for noise.yaml, noise.png and noise.json"""
    driving: Path | None = None
    """Recording of a usual drive: white noise is raised to what its quietest half second shows"""
    overwrite: bool = False
    """Replace what an earlier calibration wrote"""
    json: bool = False
    """Print JSON instead of lines"""


@dataclass(frozen=True)
class FloorOptions:
    """Options of `vislam calibrate floor`."""

    source: Positional[str]
    """Recording (or sim:WORLD) in which the cart drives 3 m or more over a level floor with texture"""
    distance_m: float | None = None
    """How far the cart is from where it began, by tape, at the end of the recording; driven straight"""
    distance_sigma_m: float = 0.005
    """How well that was measured: 5 mm for a tape between two marks under the cart"""
    height_m: float | None = None
    """Height of the lens above the floor, by tape, where no distance was measured"""
    height_sigma_m: float = 0.003
    """How well that was measured; the middle of a lens is hard to find"""
    begin_s: float = 0.0
    """Leave out so much of the recording at its beginning"""
    duration_s: float | None = None
    """Take so much of it; None: all"""
    out: Path = Path("calibration")
    """Folder for floor.toml, floor.png and floor.json"""
    overwrite: bool = False
    """Replace what an earlier calibration wrote"""
    json: bool = False
    """Print JSON instead of lines"""


@dataclass(frozen=True)
class ImuOptions:
    """Options of `vislam calibrate imu`."""

    source: Positional[Path]
    """Raw recording (folder, or csv like imu0/data.csv) in which the sensor is held still in twelve poses or more"""
    out: Path = Path("calibration")
    """Folder for imu.yaml, imu.png and imu.json"""
    model: Literal["full", "scale"] = "full"
    """full: scale, axes, bias; scale: axes as they are, for which seven poses do"""
    rest_s: float = 2.0
    """A pose counts when it was held so long"""
    gravity_m_s2: float = 9.81
    """Where it was recorded: 9.780 at the equator to 9.832 at the poles; as imu.gravity_m_s2 of the config"""
    overwrite: bool = False
    """Replace what an earlier calibration wrote"""
    json: bool = False
    """Print JSON instead of lines"""
