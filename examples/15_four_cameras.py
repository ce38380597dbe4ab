"""15. A rig of four cameras that share nothing of what they see, and what happens while the first is covered.

    python examples/15_four_cameras.py

One camera looks ahead, the others to the sides and back; an IMU ties them together. For three seconds the first one
sees nothing. Alone, its run goes on by the IMU; with three more cameras it hardly matters. Your own rig needs nothing
but the place of each camera: folders cam0, cam1, ... with a sensor.yaml, see docs/rig.md.
"""

import numpy as np

from vislam import Config, Slam, open_source

WORLD = "points:laps,rig=mono,duration_s=13,camera_hz=5,tracks=100,outage_begin_s=9,outage_length_s=3"


def off_m(further_cameras: int) -> float:
    """Return how far the live pose is off when the darkness ends, in metres."""
    recording = open_source(f"{WORLD},further_cameras={further_cameras}")
    slam = Slam(Config(), recording.rig, recording.imu_noise)
    steps = [step for value in recording.events() for step in slam.feed(value) if step.T_map_body is not None]
    ends = [step for step in steps if not step.front.track.vo.tracking.sees][-1]
    truth = recording.true_states(np.array([steps[0].front.frame.t_ns, ends.front.frame.t_ns])).T_world_body
    travelled, true = np.linalg.solve(steps[0].T_map_body, ends.T_map_body), np.linalg.solve(*truth)
    return float(np.linalg.norm(travelled[:3, 3] - true[:3, 3]))


alone, four = off_m(0), off_m(3)
print(f"after three seconds of darkness: {100 * alone:.1f} cm off with one camera, {100 * four:.1f} cm with four")
assert four < 0.5 * alone
