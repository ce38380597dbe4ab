"""A short simulated run of `vislam run` with further sensors, for tests of what is made of a finished run."""

from __future__ import annotations

from pathlib import Path

from vislam.cli import run_verb

SOURCE = "points:workshop-cart,rig=stereo,duration_s=16,camera_hz=10,tracks=100"


def drive(folder: Path, sensors: str) -> Path:
    """Write the sensors' tables to cart.toml in a folder, run into its folder `run`, and return the first."""
    file = folder / "cart.toml"
    file.write_text(sensors)
    quiet = ["--map.no-enabled", "--view.no-enabled"]
    assert run_verb(["run", SOURCE, "--out", str(folder / "run"), "--sensors.file", str(file), *quiet]) == 0
    return folder
