"""What further cameras are worth: errors and costs of runs over one world, with one camera, a pair, and more around it.

    .venv/bin/python experiments/rigs.py
    .venv/bin/python experiments/rigs.py --world sim:handheld-room --seconds 20 --seeds 0 1

A rig is `mono`, `stereo` or `rgbd`, with `+N` for N cameras more, evenly around the vertical. Errors are rms, as known
at the time of each frame and at the end, with yaw and position aligned; costs are CPU of tracking, filter and graph.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402

import vislam  # noqa: E402

STAGES = ("track", "ekf", "ekf predict", "graph")


def one(world: str, rig: str, seed: int) -> tuple[float, float, float]:
    """Return the errors in mm, live and at the end, and the cost of a frame in ms."""
    first, _, further = rig.partition("+")
    source = f"{world},rig={first},further_cameras={further or 0}"
    with tempfile.TemporaryDirectory() as folder:
        run = vislam.run(source, out=Path(folder) / "run", seed=seed, map={"enabled": False})
    accuracy, stages = run.metrics["accuracy"], run.metrics["cost"]["stages_cpu_ms_per_frame"]
    errors = (1e3 * accuracy[name]["ate_rmse_m"] for name in ("live", "graph"))
    return *errors, sum(stages.get(stage, 0.0) for stage in STAGES)


def main() -> None:
    """Print a line for each rig."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="points:laps")
    parser.add_argument("--rigs", nargs="+", default=["mono", "mono+2", "mono+3", "stereo", "stereo+2", "stereo+4"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--seconds", type=float, default=40.0)
    options = parser.parse_args()
    print(
        f"{options.world}, {options.seconds:g} s, seeds {options.seeds}: mean of live mm, final mm, ms of CPU a frame"
    )
    for rig in options.rigs:
        all_seeds = np.array(
            [one(f"{options.world},duration_s={options.seconds}", rig, seed) for seed in options.seeds]
        )
        live, final, cost = all_seeds.mean(axis=0)
        print(f"{rig:10s} {live:7.1f} {final:7.1f} {cost:7.1f}", flush=True)


if __name__ == "__main__":
    main()
