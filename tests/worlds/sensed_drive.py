"""Short simulated runs with further sensors, each made once, for tests of what a run makes of them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from vislam.config import load
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import open_source
from vislam.sensors.geodetic import Geodetic
from worlds.shared import shared

SOURCE = "points:workshop-cart,rig=stereo,duration_s=16,camera_hz=10,tracks=100"
DATUM = Geodetic(-36.8, 179.9999, 40.0)  # the drawn frame is some km off, so the path lies elsewhere
WHEELS = '[sensors.wheels]\nkind = "wheels"\n'
FIXES = (
    '[sensors.gnss]\nkind = "position"\nsigma_m = 0.02\nsigma_up_m = 0.05\n'
    f"gnss = {{datum = [{DATUM.latitude_deg}, {DATUM.longitude_deg}, {DATUM.height_m}]}}\n"
)
LEVERED = FIXES + "lever_sigma_m = 0.3\n"
HEIGHTS = '[sensors.height]\nkind = "height"\nsimulated_hz = 2.0\n'
OF = {
    "clean": f"{WHEELS}simulated_hz = 20.0\n{FIXES}simulated_hz = 5.0\n",
    "levered": f"{WHEELS}simulated_hz = 20.0\n{LEVERED}simulated_hz = 5.0\n{HEIGHTS}",
    "without": "",
}
FILES = ("trajectory_ekf.tum", "trajectory_graph.tum", "states_ekf.csv", "states_graph.csv")


@dataclass(frozen=True)
class Driven:
    """What a run left in `out`, and the file of its sensors."""

    out: Path
    sensors: Path

    @property
    def metrics(self) -> dict[str, Any]:
        return json.loads((self.out / "metrics.json").read_text())

    @property
    def ate_m(self) -> dict[str, float]:
        return {name: entry["ate_rmse_m"] for name, entry in self.metrics["accuracy"].items()}

    @property
    def bytes(self) -> list[bytes]:
        return [(self.out / name).read_bytes() for name in FILES]


def settings(sensors: Path) -> dict[str, object]:
    """The settings of a run with the sensors of a file, without map and viewer."""
    told = {"sensors.file": str(sensors)} if sensors.stat().st_size else {}
    return {"view.enabled": False, "map.enabled": False, **told}


def drive(folder: Path, sensors: str, source: str = SOURCE) -> Driven:
    """Write the sensors' tables to cart.toml in a folder and run, without a report, into its folder `run`."""
    file, out = folder / "cart.toml", folder / "run"
    file.write_text(sensors)
    prepare(out, overwrite=False)
    execute(open_source(source), load(None, settings(file)), out, source, [])
    return Driven(out, file)


def driven(tmp_path_factory: pytest.TempPathFactory, name: str) -> Driven:
    """One of the runs `OF`, made once in a session of tests."""
    folder = shared(tmp_path_factory, f"sensed-{name}", lambda folder: drive(folder, OF[name]))
    return Driven(folder / "run", folder / "cart.toml")
