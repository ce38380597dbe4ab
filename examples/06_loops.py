"""6. Loop detection on images: which old image looks like this one, and where was the camera then?

    python examples/06_loops.py

Two questions, two answers. Appearance (a bag of words over ORB features) ranks old keyframes by likeness: quick, and
sometimes fooled. Geometry then has to measure the relative pose from matched features, or the loop is refused.
"""

import numpy as np

from vislam import LoopDetector
from vislam.core import invert, se3_log
from vislam.sim import open_world

FIRST_LAP, SECOND_LAP = range(0, 240, 15), (300, 315, 330)  # frames

# a camera with depth, carried around a furnished room; only the frames asked for are drawn
world = open_world("handheld-room", camera_hz=10.0, image_width_px=480)
truth = world.truth().T_world_body

errors_m = []
with LoopDetector(world.rig.cameras[0], world.rig.T_body_cams[0]) as detector:
    for index in FIRST_LAP:
        frame = world.render(index)
        detector.add(frame.images[0], frame.depth_m)
    print(detector)
    for index in SECOND_LAP:
        frame = world.render(index)
        for loop in detector.query(frame.images[0], frame.depth_m):
            print(f"frame {index}: {loop}")
            if loop.T_old_new is not None:
                old = FIRST_LAP[loop.id]
                off = se3_log(invert(loop.T_old_new) @ invert(truth[old]) @ truth[index])
                errors_m.append(float(np.linalg.norm(off[3:])))

assert errors_m, "no loop was found"
assert max(errors_m) < 0.1
print(f"{len(errors_m)} loops, off by {max(errors_m):.3f} m at most")
