"""How a person who carries the camera walks along a path: with bob, sway and a wandering gaze."""

import numpy as np

from vislam.core.messages import Array
from vislam.sim.motion.path import PlanarPath, Travel, smoothstep, wander
from vislam.sim.motion.spline import BodySpline

_EYE_M = 1.25
_STEP_HZ = 1.8
_KNOTS_S = 0.1


def walk(path: PlanarPath, travel: Travel, seed: int) -> BodySpline:
    """Return a walk along a path at the height of the chest, looking ahead; `seed` is that of the wandering gaze."""

    def design(t_s: Array) -> tuple[Array, Array]:
        arc = travel.arc_m(t_s)
        xy, heading = path.at(arc)
        walking = smoothstep(arc, 0.1, 1.5) * smoothstep(path.length_m - arc, 0.1, 1.5)
        step = 2.0 * np.pi * _STEP_HZ * t_s
        slow = wander(t_s, np.random.default_rng(seed), 1.0, (0.08, 0.35), 4) * walking[:, None]
        side = walking * 0.018 * np.sin(0.5 * step) + 0.04 * slow[:, 0]
        xy = xy + side[:, None] * np.column_stack([-np.sin(heading), np.cos(heading)])
        z = _EYE_M + walking * 0.014 * np.sin(step)
        roll = walking * 0.009 * np.sin(0.5 * step + 0.4) + 0.015 * slow[:, 1]
        pitch = 0.06 + walking * 0.007 * np.sin(step + 0.8) + 0.03 * slow[:, 2]
        return np.column_stack([xy, z]), np.column_stack([roll, pitch, heading + 0.07 * slow[:, 3]])

    return BodySpline.from_design(design, travel.duration_s, _KNOTS_S)
