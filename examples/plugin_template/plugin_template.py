"""Kinds that a package brings to vislam: copy this folder, keep what you need, `pip install` it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import vislam
from vislam.cli.verbs import Verb
from vislam.mapping.octree import Occupancy
from vislam.sensors import BodyState, Configured


@dataclass(frozen=True)
class SonarSettings:
    """Keys of its table in the file of sensors."""

    sigma_m: float = 0.1


class Sonar(Configured):
    """A sensor: the height above a floor at z = 0."""

    Settings, columns, touches = SonarSettings, ("height_m",), ("position",)

    def __init__(self, settings: SonarSettings | None = None) -> None:
        self.settings = settings or SonarSettings()

    def residual(self, values: np.ndarray, body: BodyState, own: np.ndarray) -> np.ndarray:
        return values - body.position_m[2:]

    def noise(self, values: np.ndarray) -> np.ndarray:
        return np.array([[self.settings.sigma_m**2]])


class Volume:
    """A map product: how much is occupied, in cubic metres."""

    FILE = "volume.txt"

    @staticmethod
    def write(path: Path, source) -> str | None:
        leaves = source.occupancy.leaves()
        voxels = np.sum(8.0 ** leaves.levels[leaves.log_odds >= Occupancy.FREE])
        path.write_text(f"{voxels * leaves.resolution_m**3:.3f}\n")
        return None


class First:
    """A loop proposer: always the oldest keyframe."""

    def __init__(self, config, rig: vislam.Rig) -> None: ...

    def __call__(self, view, known) -> list[int]:
        return sorted(known)[:1]


def hello(arguments: list[str]) -> int:
    """Print what a run is worth; return the exit code."""
    print(vislam.load_run(arguments[0]) if arguments else "hello from a package")
    return 0


HELLO = Verb("say what a run left", "vislam hello runs/desk", main=hello)
