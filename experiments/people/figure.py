"""A walking person as depth cameras see one: a trunk and two legs that swing, all upright cylinders."""

import numpy as np

from vislam.core.messages import Array, ImageF32

_HIP_M, _HEIGHT_M = 0.85, 1.75
_TRUNK_RADIUS_M, _LEG_RADIUS_M = 0.2, 0.08
_STRIDE_M = 0.35  # of a leg, forwards and backwards of the hip
_STEPS_PER_M = 0.75  # whole swings to and fro per metre walked


def figure_depth(rays: Array, T_world_cam: Array, feet_m: Array, heading_rad: float, walked_m: float) -> ImageF32:
    """Return the z-depth [H, W] of a person along rays [H, W, 3] of z-depth 1 in the camera frame; inf beside them.

    The person stands at `feet_m` [3] in the world, whose z is up, and has walked so far: that gives the legs' swing.
    """
    directions, eye = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    swing = _STRIDE_M * np.sin(2.0 * np.pi * _STEPS_PER_M * walked_m)
    along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    side = np.array([-along[1], along[0]])
    out = _cylinder(directions, eye, feet_m[:2], feet_m[2] + _HIP_M, feet_m[2] + _HEIGHT_M, _TRUNK_RADIUS_M)
    for sign in (-1.0, 1.0):
        foot = feet_m[:2] + sign * (swing * along + 0.5 * _TRUNK_RADIUS_M * side)
        out = np.minimum(out, _cylinder(directions, eye, foot, feet_m[2], feet_m[2] + _HIP_M, _LEG_RADIUS_M))
    return np.asarray(out, np.float32)


def _cylinder(directions: Array, eye: Array, centre: Array, low_m: float, high_m: float, radius_m: float) -> Array:
    """Return where rays enter the side of an upright cylinder, in lengths of the direction; inf where they miss."""
    dx, dy = directions[..., 0], directions[..., 1]
    ex, ey = eye[:2] - centre
    square, linear = dx * dx + dy * dy, dx * ex + dy * ey
    root = linear * linear - square * (ex * ex + ey * ey - radius_m * radius_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-linear - np.sqrt(root)) / square
        height = eye[2] + t * directions[..., 2]
        met = (root > 0.0) & (t > 0.0) & (height >= low_m) & (height <= high_m)
    return np.asarray(np.where(met, t, np.inf))
