"""13. What things are: label images fused into a map, and the way to the nearest door.

    python examples/13_labels.py

A simulated room tells what each pixel shows, as a network would; here one image in five is wrong altogether. Every
keyframe has a vote per voxel, so the map is right where several saw the same place.
"""

import numpy as np

from vislam import Config, Slam, open_source
from vislam.core import Array, Frame
from vislam.mapping import LabelClasses, label_at, nearest, things_of
from vislam.sim.scene import NAMES

WORLD = "sim:handheld-room,duration_s=8,camera_hz=5,image_width_px=320"
WRONG = 0.2  # share of images


class MadeUpNetwork:
    """Stands for any network: it gets a keyframe's images, and returns an id for each pixel."""

    classes = LabelClasses.of({str(i): name for i, name in enumerate(NAMES, start=1)}, "the simulator")

    def __init__(self, world) -> None:
        self.world = world
        self.rng = np.random.default_rng(0)

    def __call__(self, frame: Frame, camera_t_ns: int) -> Array:
        _, labels = self.world.labels(frame.index)
        if self.rng.random() < WRONG:
            return np.r_[0, 1 + self.rng.permutation(len(NAMES))][labels]
        return labels


def main() -> None:
    world = open_source(WORLD)
    slam = Slam(Config(), world.rig, world.imu_noise, labeller=MadeUpNetwork(world))
    for value in world.events():
        slam.feed(value)
    slam.finish()
    layer = slam.back.mapper.labels()
    print(f"{len(layer)} voxels have a label, {len(layer.things)} things")
    for name in ("door", "cupboard", "poster"):
        largest = things_of(layer, name)[0]
        size = (largest.to_m - largest.from_m).round(2).tolist()
        print(f"  {name}: {largest.voxels} voxels in a box of {size} m, {largest.share:.0%} of the votes")
    here = np.zeros((1, 3))  # where it began
    found = nearest(layer, here, "door")
    where = found.voxel_m[0].round(2).tolist()
    print(f"nearest door: {found.distance_m[0]:.2f} m away at {where}, seen by {found.votes[0]} keyframes")
    assert label_at(layer, found.voxel_m) == ["door"]
    assert found.distance_m[0] < 4.0


if __name__ == "__main__":
    main()
