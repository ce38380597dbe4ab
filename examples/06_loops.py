"""6. Loop detection on images: which old image looks like this one, and where was the camera then?

    python examples/06_loops.py

Two questions, two answers. Appearance (a bag of words over ORB features) ranks old keyframes by likeness: quick, and
sometimes fooled. Geometry then has to measure the relative pose from matched features, or the loop is refused.
"""

import numpy as np

from vislam.config import LoopConfig
from vislam.core.geometry import invert, se3_log
from vislam.frontend.keyframes import Exposed, make_keyframe
from vislam.loop.verification.verifier import Verifier
from vislam.loop.view import View, make_view
from vislam.loop.words.database import PlaceDatabase
from vislam.sim import open_world

FIRST_LAP, SECOND_LAP = range(0, 240, 15), (300, 315, 330)  # frames

# a camera with depth, carried around a furnished room; only the frames asked for are drawn
world = open_world("handheld-room", camera_hz=10.0, image_width_px=480)
camera, T_body_cam = world.rig.cameras[0], world.rig.T_body_cams[0]
truth = world.truth().T_world_body


def view_of(index: int) -> View:
    """Return what loop closing keeps of a frame: described features, with a point in space where depth is known."""
    frame = world.render(index)

    def depth_m(pixels: np.ndarray, _: object) -> np.ndarray:
        x, y = np.round(pixels).astype(int).T
        z = frame.depth_m[y, x].astype(float)
        return np.where(z > 0.1, z, np.nan)  # 0: the sensor saw nothing there

    return make_view(make_keyframe(index, frame, camera, T_body_cam, 800, Exposed(depth_m)), world.rig)


places = PlaceDatabase(LoopConfig(), seed=0)  # comes with a small vocabulary; a run trains its own
seen = {index: view_of(index) for index in FIRST_LAP}
for view in seen.values():
    places.add(view)

verifier = Verifier(LoopConfig(), world.rig, seed=0)
errors_m, best_scores = [], []
for index in SECOND_LAP:
    new = view_of(index)
    ids, scores = places.query(new, k=3, excluded=np.empty(0, dtype=np.int64))
    for old, score in zip(ids, scores, strict=True):
        found = verifier.verify(seen[old], new)
        if found.T_a_b is None:
            print(f"frame {index} and {old:3d}: likeness {score:.2f}, refused: {found.reason}")
            continue
        off = se3_log(invert(found.T_a_b) @ invert(truth[old]) @ truth[index])
        errors_m.append(float(np.linalg.norm(off[3:])))
        print(f"frame {index} and {old:3d}: likeness {score:.2f}, {found.inliers} inliers, off by {errors_m[-1]:.3f} m")
places.close()

assert errors_m, "no loop was found"
assert max(errors_m) < 0.1
