"""How far off the truth's vertical a map stands whose run had no IMU, by each that says which way is up.

    .venv/bin/python experiments/up_without_imu.py [--recording SOURCE[@X,Y,Z] ...] [--out FILE]

SOURCE is anything that `vislam run` takes, with ground truth; X,Y,Z is up in the truth's frame (0,0,1 unless told).
Each is run without its IMU, with a map; the truth is aligned to the final trajectory and to the causal one (SE(3)).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import Config, ImuConfig, MapConfig, ViewConfig
from vislam.core import Array
from vislam.core.angles import angle_deg
from vislam.core.files import write_json
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import open_source
from vislam.trajectory import align, associate, read_tum

RECORDINGS = (
    "sim:handheld-room,duration_s=12,camera_hz=10",
    "sim:workshop-cart,duration_s=20,camera_hz=10",
    "sim:aliased-halls,duration_s=20,camera_hz=10",
    "sim:corridor-loop,duration_s=20,camera_hz=10",
)
CONFIG = Config(imu=ImuConfig(enabled=False), map=MapConfig(products=("cloud",)), view=ViewConfig(enabled=False))


def up_in(folder: Path, name: str, up_truth: Array) -> Array:
    """Return the truth's up [3] in the frame of a trajectory of a run folder."""
    truth = read_tum(folder / "trajectory_truth.tum")
    R_truth_map = align(associate(read_tum(folder / f"trajectory_{name}.tum"), truth), "se3")[:3, :3]
    return np.asarray(R_truth_map.T @ up_truth)


def measure(source: str, folder: Path) -> dict[str, Any]:
    """Run a recording without its IMU and return degrees off up, by who says it, with the sigma that was told."""
    source, _, told = source.partition("@")
    up_truth = np.array([float(x) for x in told.split(",")] if told else [0.0, 0.0, 1.0])
    prepare(folder, overwrite=False)
    metrics = execute(open_source(source), CONFIG, folder, source, ["experiments/up_without_imu.py"])
    up = metrics["up"]
    z = np.array([0.0, 0.0, 1.0])
    row: dict[str, Any] = {"source": source, "first_image": angle_deg(up_in(folder, "live", up_truth), z)}
    row["map"] = angle_deg(up_in(folder, "graph", up_truth), z)
    row["map_sigma"] = up["sigma_deg"]
    # what was asked is told in the frame of the estimate, which the final one is turned from
    R_map_odom = np.array(up["R_map_odom"])
    for name, entry in up["asked"].items():
        row[name] = angle_deg(up_in(folder, "graph", up_truth), R_map_odom @ np.array(entry["direction"]))
        row[f"{name}_sigma"] = entry["sigma_deg"]
    return row


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", nargs="+", default=RECORDINGS, metavar="SOURCE")
    parser.add_argument("--out", type=Path, help="JSON file to write the rows to")
    asked = parser.parse_args()
    rows = []
    for source in asked.recording:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(source, Path(folder) / "run"))
        print(", ".join(f"{k} {v:.2f}" if isinstance(v, float) else str(v) for k, v in rows[-1].items()), flush=True)
    if asked.out is not None:
        write_json(asked.out, {"rows": rows})


if __name__ == "__main__":
    main()
