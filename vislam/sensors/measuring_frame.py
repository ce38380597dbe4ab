"""The frame that a sensor measures in: level as the world, but with a heading and an origin of its own.

`p_frame = Rz(yaw) @ p_world + (x, y, z)`: the own variables are `T_frame_world`, where the world's origin and x axis
lie in the sensor's frame. The estimate starts at the world's origin, so heading and place hang little on one another.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from vislam.config.sensors import Vector3
from vislam.core.geometry import skew
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.body import PARTS, BodyState
from vislam.sensors.sensor import Variable

FrameKind = Literal["own", "known"]
ANYWHERE_M = 1e4  # sigma of a place nothing is known of: beyond it a local frame is none; larger costs digits
ENOUGH_YAW_RAD = math.radians(5.0)  # sigma of a heading from which on a linear step is good
MOST_READINGS = 200  # that are compared at a start: more of the same path add little, and are compared again and again
UP: Array = np.array([0.0, 0.0, 1.0])
_T = TypeVar("_T")


def frame_variables(
    kind: FrameKind, walk_m: float = 0.0, walk_rad: float = 0.0, up: tuple[float, float] = (0.0, ANYWHERE_M)
) -> tuple[Variable, ...]:
    """Return the four variables of a measuring frame, none of one that is the world; `up` is start and sigma of z."""
    if kind == "known":
        return ()
    return (
        Variable("yaw_rad", math.pi, 0.0, walk_rad, of_machine=False),
        Variable("x_m", ANYWHERE_M, 0.0, walk_m, of_machine=False),
        Variable("y_m", ANYWHERE_M, 0.0, walk_m, of_machine=False),
        Variable("z_m", up[1], up[0], walk_m, of_machine=False),
    )


def vector_variables(name: str, start: Vector3, sigma: float) -> tuple[Variable, ...]:
    """Return the three variables of a vector in metres that is not known well, none where it is (sigma 0)."""
    if sigma == 0.0:
        return ()
    return tuple(Variable(f"{name}_{axis}_m", sigma, value) for axis, value in zip("xyz", start, strict=True))


def frame_pose(own: Array) -> tuple[Array, Array]:
    """Return R_frame_world [3, 3] and the world's origin in the frame [3] of frame variables [4], or of none [0]."""
    if not len(own):
        return np.eye(3), np.zeros(3)
    return about_up(float(own[0])), own[1:4]


def cross(a: Array, b: Array) -> Array:
    """Return a x b of vectors [3], in a tenth of the time that numpy's own takes for two."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def about_up(yaw_rad: float) -> Array:
    """Return the rotation [3, 3] by an angle about up."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class Placed(NamedTuple):
    """A point of the body in a measuring frame, and what it hangs on."""

    point_m: Array  # [3]
    H: Array  # [3, 15]
    by_frame: Array  # [3, 4], of a known frame [3, 0]
    by_lever: Array  # [3, 3]


def lever_point(body: BodyState, frame: Array, lever_m: Array) -> Array:
    """Return where a point [3] of the body is in a measuring frame with variables [4] or [0]."""
    R, t = frame_pose(frame)
    return R @ (body.position_m + body.R_world_body @ lever_m) + t


def placed(body: BodyState, frame: Array, lever_m: Array) -> Placed:
    """Return the same as `lever_point` with its derivatives."""
    R, t = frame_pose(frame)
    by_lever = R @ body.R_world_body
    turned = R @ (body.position_m + body.R_world_body @ lever_m)
    H = np.zeros((3, 15))
    H[:, PARTS["rotation"]] = -by_lever @ skew(lever_m)
    H[:, PARTS["position"]] = R
    by_frame = np.zeros((3, len(frame)))
    if len(frame):
        by_frame[:, 0] = cross(UP, turned)
        by_frame[:, 1:] = np.eye(3)
    return Placed(turned + t, H, by_frame, by_lever)


def is_heading_known(variables: Sequence[Variable], sigmas: Array) -> bool:
    """Return whether a linear step is good at a frame's heading with these sigmas [V], or there is no frame."""
    return all(s <= ENOUGH_YAW_RAD for v, s in zip(variables, sigmas, strict=True) if v.name == "yaw_rad")


def thinned(items: Sequence[_T]) -> list[_T]:
    """Return at most `MOST_READINGS` of them, evenly spread, the first and the last among them."""
    if len(items) <= MOST_READINGS:
        return list(items)
    chosen = np.linspace(0, len(items) - 1, MOST_READINGS).round().astype(int)
    return [items[i] for i in chosen]


def thinned_pairs(readings: Sequence[Reading], bodies: Sequence[BodyState]) -> tuple[list[Reading], list[BodyState]]:
    """Return readings and the body at each, both thinned alike."""
    return thinned(readings), thinned(bodies)
