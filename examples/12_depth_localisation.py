"""12. Found again by depth alone: where is a depth camera in the map of an earlier run, when images tell nothing?

    python examples/12_depth_localisation.py

A run makes a map. Later the light is off: the depth camera still sees, and somebody knows about where it is ("near the
table"). Depth is aligned with the map from that guess, and either answers with a covariance or says why not. Without a
guess there is no answer: rooms are full of corners that look alike.
"""

import tempfile
from pathlib import Path

import numpy as np

from vislam import load_run, open_source
from vislam.config import load
from vislam.core import Frame, invert, se3_exp, se3_log
from vislam.mapping import Guess
from vislam.runs import depth_localiser, execute

recording = open_source("sim:handheld-room,camera_hz=5,image_width_px=320,duration_s=8")

with tempfile.TemporaryDirectory() as folder:
    run = Path(folder) / "run"
    run.mkdir()
    execute(recording, load(None, {"view.enabled": False}), run, "example", [])
    path = load_run(run).trajectories["graph"]  # T_map_body over time
    localiser = depth_localiser(run)

print(f"{len(localiser)} keyframes of the map have depth")
depths = {value.t_ns: value.depth_m for value in recording.events() if isinstance(value, Frame)}
rng = np.random.default_rng(0)
accepted, errors_m = 0, []
asked = path.t_ns[4::4]
for t_ns in asked:
    T_map_body = path.at(np.array([t_ns]))[0]
    off = np.concatenate([rng.normal(0.0, np.deg2rad(3.0), 3), rng.normal(0.0, 0.06, 3)])
    answer = localiser.localise(depths[int(t_ns)], Guess(T_map_body @ se3_exp(off), sigma_m=0.1, sigma_deg=5.0))
    if not answer.accepted:
        print(f"guess off by {np.linalg.norm(off[3:]):.2f} m: refused, {answer.reason}")
        continue
    accepted += 1
    error = se3_log(invert(answer.T_map_body) @ T_map_body)
    error -= answer.undetermined @ (answer.undetermined.T @ error)  # along these the guess is kept, and said so
    errors_m.append(float(np.linalg.norm(error[3:])))
    print(f"guess off by {np.linalg.norm(off[3:]):.2f} m: found, off by {errors_m[-1]:.3f} m; "
          f"depth tells {answer.determined} of 6 directions")  # fmt: skip

blocked = depths[int(asked[0])].copy()
blocked[:, blocked.shape[1] // 4 :] = 0.7  # somebody stands before the camera
refusal = localiser.localise(blocked, Guess(path.at(asked[:1])[0]))
print(f"somebody in the view: refused, {refusal.reason}")

assert accepted > 0
assert max(errors_m) < 0.05
assert not refusal.accepted
