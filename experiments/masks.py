"""What masks are worth: the error of a run with a person before the camera, over that of the same room without.

    .venv/bin/python experiments/masks.py
    .venv/bin/python experiments/masks.py --rig stereo --shares 0.4 0.7 --seeds 0 1 2

A person in patterned clothes walks to and fro before a hand-held camera, two seconds after it begins, and fills a share
of its image. Once the frames come with masks that leave the person out, once without. The error is the rms of what was
known of the place at the time of each frame, with yaw and position aligned. Lost frames and submaps come beside it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402

from vislam import Slam, open_source  # noqa: E402
from vislam.config import load  # noqa: E402
from vislam.trajectory import Trajectory, evaluate  # noqa: E402


def error_m(source: str, seed: int) -> tuple[float, int, int]:
    """Return the rms error of a source in metres, lost frames and submaps."""
    world = open_source(source, seed)
    slam = Slam(load(overrides={"map.enabled": False, "seed": seed}), world.rig, world.imu_noise)
    steps = [step for value in world.events() for step in slam.feed(value)]
    placed = [step for step in [*steps, *slam.finish().steps] if step.T_map_body is not None]
    path = Trajectory(
        np.array([s.front.frame.t_ns for s in placed], dtype=np.int64),
        np.array([s.T_map_body for s in placed]).reshape(-1, 4, 4),
    )
    counted = slam.front.report().counters["front"]
    error = evaluate(path, world.truth(), "yaw")["ate_rmse_m"] if len(path) > 2 else float("nan")
    return error, counted["frames_lost"], counted["submaps"]


def main() -> None:
    """Print what each run came to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", default="rgbd", choices=["rgbd", "stereo"])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.4, 0.7])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--width", type=int, default=320)
    options = parser.parse_args()
    world = f"sim:handheld-room,rig={options.rig},duration_s={options.seconds},image_width_px={options.width}"
    world += ",camera_hz=15,moving_begin_s=2"
    for seed in options.seeds:
        empty, *_ = error_m(world, seed)
        print(f"seed {seed}: the empty room {100.0 * empty:.2f} cm", flush=True)
        for share in options.shares:
            for masks in (True, False):
                error, lost, submaps = error_m(f"{world},moving_share={share},moving_masks={masks}", seed)
                how = f"{share:.0%} {'with' if masks else 'without'} masks"
                text = f"{100.0 * error:.2f} cm, {error / empty:.2f} times; {lost} frames lost, {submaps} submaps"
                print(f"  {how}: {text}", flush=True)


if __name__ == "__main__":
    main()
