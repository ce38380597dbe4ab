"""14. What is not to be used: a person before the camera, left out by masks.

    python examples/14_masks.py

A person in patterned clothes walks to and fro before a camera with depth and fills 60 % of its image. With masks, as a
network gives them, neither the motion nor the map follows the person. Zero stands for what is not used, 255 for the
rest.
"""

from collections.abc import Sequence

import numpy as np

from vislam import Config, Slam, open_source
from vislam.core import Array, Frame, MaskedRecording, Recording
from vislam.trajectory import Trajectory, evaluate

WORLD = "sim:handheld-room,duration_s=6,camera_hz=10,image_width_px=160,moving_share=0.6,moving_begin_s=1.5"
PERSON_M = 2.0  # away from the camera, nearer than most of the room


def network(frame: Frame) -> Sequence[Array | None]:
    """Stand for any network: return a mask for each image of a frame, None where all of it may be used."""
    person = np.abs(frame.depth_m - PERSON_M) < 0.1
    columns = np.flatnonzero(person.mean(axis=0) > 0.9)  # the person fills the whole height
    mask = np.full(person.shape, 255, np.uint8)
    if len(columns):
        mask[:, columns[0] : columns[-1] + 1] = 0
    return [mask]


def travelled(recording: Recording) -> float:
    """Return the error of a run over a recording: rms in metres."""
    slam = Slam(Config(), recording.rig, recording.imu_noise)
    steps = [step for value in recording.events() for step in slam.feed(value)]
    placed = [step for step in [*steps, *slam.finish().steps] if step.T_map_body is not None]
    path = Trajectory(np.array([s.front.frame.t_ns for s in placed]), np.array([s.T_map_body for s in placed]))
    return evaluate(path, recording.truth(), "yaw")["ate_rmse_m"]


def main() -> None:
    world = open_source(WORLD)
    without, masked = travelled(world), travelled(MaskedRecording(world, network))
    print(f"without masks {100 * without:.1f} cm off, with masks {100 * masked:.1f} cm")
    assert masked < 0.5 * without


if __name__ == "__main__":
    main()
