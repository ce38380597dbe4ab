"""The options of every kind of `vislam calibrate`; their comments and docstrings are its --help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
