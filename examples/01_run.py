"""1. A run: measurements go in one at a time, a pose comes out for every frame, and at the end a trajectory.

    python examples/01_run.py

The recording is made here: an IMU and a stereo camera carried along a known path. Nothing below knows that; put
`open_source("euroc:PATH")` in its place and the same ten lines work on your own.
"""

import numpy as np

from vislam import Config, Slam, open_source
from vislam.trajectory import Trajectory, evaluate

# "points" simulates vision as tracks of landmarks, without drawing images, so that this takes seconds
recording = open_source("points:laps,duration_s=9,rig=stereo")

# every setting has a default, a unit and a reason; a recording brings its cameras and the noise of its IMU
slam = Slam(Config(), recording.rig, recording.imu_noise)

stamps_ns, poses = [], []
for value in recording.events():  # inertial samples and frames, in the order of time
    for step in slam.feed(value):  # a frame is answered once a newer inertial sample has come
        if step.T_map_body is None:
            continue  # gravity is not known yet: no pose is better than a wrong one
        stamps_ns.append(step.front.frame.t_ns)
        poses.append(step.T_map_body)
slam.finish()  # the graph converges

# what a controller would have seen while it went, against the truth; heading and place of the start are ours to choose
live = Trajectory(np.array(stamps_ns), np.array(poses))
accuracy = evaluate(live, recording.truth(), "yaw")
print(f"{len(live)} poses over {live.path_m:.1f} m, off by {100 * accuracy['ate_rmse_m']:.1f} cm (rms)")

# the graph keeps keyframes only: a few per second, corrected by whatever was learned later
keyframes = slam.back.graph.poses()
print(f"{len(keyframes)} keyframes of {recording.frame_count} frames carry the map")

assert accuracy["ate_rmse_m"] < 0.1
assert len(keyframes) < len(live)
