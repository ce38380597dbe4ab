"""8. Two estimators compared: the same measurements for both, several seeds, and no conclusion that they do not carry.

    python examples/08_compare.py

Loosely coupled, the filter takes the motions that visual odometry found; tightly coupled (MSCKF) it takes the tracks
themselves. Which is better, with one camera and a cheap IMU? `vislam compare PLAN` asks such questions at full size.
"""

import numpy as np

from vislam.config import Config, load
from vislam.core import StageClock, VislamError
from vislam.pipeline import Front, odometry
from vislam.sim import open_points
from vislam.trajectory import Trajectory, evaluate

SEEDS = range(3)


def error_m(seed: int, config: Config) -> float:
    """Return the ATE of the filter alone, without loops or graph, on one world: its seed is that of all noise."""
    world = open_points("laps", seed=seed, rig="stereo", duration_s=6.0, tracks=60, camera_hz=10.0)
    front = Front(config, world.rig, world.imu_noise, StageClock())
    stamps_ns, poses = [], []
    for step in odometry(front, world.events()):
        if step.T_odom_body is not None:
            stamps_ns.append(step.frame.t_ns)
            poses.append(step.T_odom_body)
    return evaluate(Trajectory(np.array(stamps_ns), np.array(poses)), world.truth(), "yaw")["ate_rmse_m"]


configs = {name: load(None, {"ekf.coupling": name}) for name in ("loose", "tight")}
errors = {name: [] for name in configs}
for seed in SEEDS:
    for name, config in configs.items():
        try:
            errors[name].append(error_m(seed, config))
        except VislamError:
            errors[name].append(np.inf)  # a failure is worse than any number, and must not vanish from the table

print("seed   loose [cm]   tight [cm]")
for seed, loose, tight in zip(SEEDS, errors["loose"], errors["tight"], strict=True):
    print(f"{seed:4d}   {100 * loose:10.2f}   {100 * tight:10.2f}")

# a pair is one world: only differences within it count, for worlds differ more than estimators do
better = sum(tight < loose for loose, tight in zip(errors["loose"], errors["tight"], strict=True))
print(f"tight is better in {better} of {len(SEEDS)}")
# with n pairs, even a clean sweep has the chance 2 / 2^n under "no difference" (sign test)
print(f"could a sweep of {len(SEEDS)} convince? p = {2 / 2 ** len(SEEDS):.2f}: no; run more seeds")

assert all(np.isfinite(values).all() for values in errors.values())
