"""3. A factor graph by hand: poses are unknowns, measurements are factors, and a loop pulls a drifted path straight.

    python examples/03_factor_graph.py

A square of four sides, driven by an odometry that turns a little too far at each corner. One loop edge brings the end
back to the start; a second one is false, as an alike-looking corridor makes it, and must not be believed.
"""

import gtsam
import numpy as np

from vislam.core.geometry import invert, se3_exp
from vislam.factors.keys import X, poses_of
from vislam.factors.noise_models import cauchy, sigmas
from vislam.factors.solvers import optimize
from vislam.factors.visual import pose_factor

SIDE_M, STEPS = 8.0, 8  # per side

forward = se3_exp(np.array([0, 0, 0, SIDE_M / STEPS, 0, 0]))  # tangents: rotation first, then translation
corner = se3_exp(np.array([0, 0, np.pi / 2, 0, 0, 0]))
motions = [forward @ corner if k % STEPS == STEPS - 1 else forward for k in range(4 * STEPS)]

truth = [np.eye(4)]
for T_before_after in motions:
    truth.append(truth[-1] @ T_before_after)

# what odometry says: each step turned by 0.6 degrees too much
too_far = se3_exp(np.array([0, 0, np.deg2rad(0.6), 0, 0, 0]))
measured = [motion @ too_far for motion in motions]

odometry = sigmas(np.repeat([np.deg2rad(1.0), 0.02], 3))  # what it claims of itself: rad, then m
loop = sigmas(np.repeat([np.deg2rad(0.5), 0.02], 3))

graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), sigmas(np.repeat(1e-6, 6))))  # somewhere the map has to begin
T = np.eye(4)
start.insert(X(0), gtsam.Pose3(T))
for k, motion in enumerate(measured):
    graph.add(pose_factor(X(k), X(k + 1), motion, odometry))
    T = T @ motion
    start.insert(X(k + 1), gtsam.Pose3(T))


def closing_error_m(values: gtsam.Values) -> float:
    """Return how far the last pose is from where it truly is."""
    return float(np.linalg.norm(poses_of(values)[-1][:3, 3] - truth[-1][:3, 3]))


drifted = closing_error_m(start)

# the true loop: the end is where the start was
graph.add(pose_factor(X(0), X(4 * STEPS), invert(truth[0]) @ truth[-1], loop))
closed = closing_error_m(optimize(graph, start, 50))

# a false one: pose 20 is said to be pose 4. Least squares believes it; a Cauchy kernel lets it go
believed, doubted = graph.clone(), graph.clone()
believed.add(pose_factor(X(4), X(20), np.eye(4), loop))
doubted.add(pose_factor(X(4), X(20), np.eye(4), cauchy(loop, 0.5)))
errors = [
    np.linalg.norm(poses_of(optimize(g, start, 100))[:, :3, 3] - np.array(truth)[:, :3, 3], axis=1).max()
    for g in (graph, believed, doubted)
]
print(f"the end is off by {drifted:.2f} m without the loop, {closed:.3f} m with it")
print(f"worst pose: {errors[0]:.2f} m; with a false loop {errors[1]:.2f} m; with it under a kernel {errors[2]:.2f} m")

assert closed < 0.05 < drifted
assert errors[2] < errors[1]
