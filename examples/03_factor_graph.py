"""3. A factor graph by hand: poses are unknowns, measurements are factors, and a loop pulls a drifted path straight.

    python examples/03_factor_graph.py

A square of four sides, driven by an odometry that turns a little too far at each corner. One loop edge brings the end
back to the start; a second one is false, as an alike-looking corridor makes it, and must not be believed.
"""

import numpy as np

from vislam.graph import Graph

SIDE_M, STEPS = 8.0, 8  # per side
NOISE = (np.deg2rad(1.0), 0.05)  # of a step of odometry: rad, m


def motion(way_m: float, turn_deg: float) -> np.ndarray:
    """Return a pose [4, 4] in the axes of the one before: so far ahead, then turned to the left."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return np.array([[c, -s, 0, way_m], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


turns_deg = [90.0 if k % STEPS == STEPS - 1 else 0.0 for k in range(4 * STEPS)]
truth = [np.eye(4)]
for turn_deg in turns_deg:
    truth.append(truth[-1] @ motion(SIDE_M / STEPS, turn_deg))

graph = Graph()
graph.prior(graph.add_pose(), np.eye(4), (1e-3, 1e-3))  # somewhere the map has to begin
for k, turn_deg in enumerate(turns_deg):  # odometry turns by 0.6 degrees too much at each step
    graph.between(k, graph.add_pose(), motion(SIDE_M / STEPS, turn_deg + 0.6), NOISE)


def worst_m() -> float:
    """Return how far the worst pose is from where it truly is."""
    return float(np.linalg.norm((graph.poses() - np.array(truth))[:, :3, 3], axis=1).max())


graph.optimise()
drifted_m, unsure = worst_m(), np.sqrt(np.diag(graph.covariance(4 * STEPS)))

true = graph.loop(0, 4 * STEPS, truth[-1], (np.deg2rad(0.5), 0.02))  # the end is where the start was
false = graph.loop(4, 20, np.eye(4), (np.deg2rad(0.5), 0.02))  # pose 20 is said to be pose 4
result = graph.optimise()
closed_m, sure = worst_m(), np.sqrt(np.diag(graph.covariance(4 * STEPS)))

print(graph)
for report in graph.loops():
    print(f"loop {report.loop_id} from {report.from_id} to {report.to_id}: {report.decision}, {report.reason}")
print(f"worst pose: {drifted_m:.2f} m without a loop, {closed_m:.2f} m with it")
print(f"sigma of the last pose: {unsure[3:].max():.2f} m without, {sure[3:].max():.2f} m with it")

assert result.accepted == (true,) and result.rejected == (false,)
assert closed_m < 0.5 * drifted_m
assert sure[3:].max() < 0.1 * unsure[3:].max()
