"""Motions for simulated vision that no rendered world has: those in which estimators go wrong, and one without end."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.camera import EXACT, Camera, Rig
from vislam.core.messages import Array
from vislam.sim.motion.path import Travel, rounded_path, smoothstep, wander
from vislam.sim.motion.spline import BodySpline
from vislam.sim.worlds.table import WORLDS

_SPACING_S = 0.05  # of control points: designed motion is smoothed over about three
_REST_S = 3.0  # before anything moves
_SPEED_M_S = 1.0
_RAMP_S = 2.0
_SLOW_START_M_S2 = 0.05
_TURN_RAD_S = np.deg2rad(40.0)
_TURN_S = 9.0  # one way: a whole circle
_LAP_HEIGHT_M = 1.4
_START_BLEND_S = 2.0
_ROUND_S = 12.0  # from stop to stop
_GO_SHARE = 2.0 / 3.0  # of it is motion
_ROUND_M = 5.0
_CART_HEIGHT_M = 0.3
_CART_LEG_M = 25.0  # from stop to stop


def still(_rng: np.random.Generator, duration_s: float) -> BodySpline:
    """Return a body that never moves, slightly tilted."""
    return BodySpline.from_design(
        lambda t: (np.tile([0.0, 0.0, 1.0], (len(t), 1)), np.tile([0.02, -0.03, 0.4], (len(t), 1))),
        duration_s, _SPACING_S,
    )  # fmt: skip


def turn_in_place(_rng: np.random.Generator, duration_s: float) -> BodySpline:
    """Return a body that rests, then turns about its own vertical by whole circles, to and fro, without moving."""

    def design(t: Array) -> tuple[Array, Array]:
        along = np.maximum(t - _REST_S, 0.0) / _TURN_S
        part = along - np.floor(along)
        there = smoothstep(part, 0.0, 1.0)
        yaw = _TURN_RAD_S * _TURN_S * np.where(np.floor(along) % 2 == 0, there, 1.0 - there)
        return np.tile([0.0, 0.0, 1.0], (len(t), 1)), np.column_stack([np.zeros(len(t)), np.zeros(len(t)), yaw])

    return BodySpline.from_design(design, duration_s, _SPACING_S)


def straight(_rng: np.random.Generator, duration_s: float) -> BodySpline:
    """Return a body that rests, speeds up along x to 1 m/s, and keeps that velocity to the end."""

    def design(t: Array) -> tuple[Array, Array]:
        u = np.clip((t - _REST_S) / _RAMP_S, 0.0, 1.0)
        ramp = _RAMP_S * (u**6 - 3.0 * u**5 + 2.5 * u**4)  # the integral of the smoothstep
        x = _SPEED_M_S * (ramp + np.maximum(t - _REST_S - _RAMP_S, 0.0))
        return np.column_stack([x, np.zeros(len(t)), np.ones(len(t))]), np.zeros((len(t), 3))

    return BodySpline.from_design(design, duration_s, _SPACING_S)


def slow_start(_rng: np.random.Generator, duration_s: float) -> BodySpline:
    """Return a body that rests, then goes along x, faster by 0.05 m/s every second: its start is hard to see."""

    def design(t: Array) -> tuple[Array, Array]:
        x = 0.5 * _SLOW_START_M_S2 * np.maximum(t - _REST_S, 0.0) ** 2
        return np.column_stack([x, np.zeros(len(t)), np.ones(len(t))]), np.zeros((len(t), 3))

    return BodySpline.from_design(design, duration_s, _SPACING_S)


def laps(rng: np.random.Generator, duration_s: float) -> BodySpline:
    """Return a body carried by hand, lap after lap around a block of 12 x 7 m, for as long as is asked."""
    path = rounded_path([(4.0, 0.0), (12.0, 0.0), (12.0, 7.0), (0.0, 7.0), (0.0, 0.0), (4.0, 0.0)], 1.5)
    lap_m = path.length_m

    def design(t: Array) -> tuple[Array, Array]:
        moving = smoothstep(t, _REST_S, _REST_S + _START_BLEND_S)
        arc = _SPEED_M_S * np.maximum(t - _REST_S - 0.5 * _START_BLEND_S, 0.0) * moving
        turns = np.floor(arc / lap_m)
        xy, heading = path.at(arc - turns * lap_m)
        sway = wander(t, rng, 1.0, (0.15, 1.2), 6) * moving[:, None]
        positions = np.column_stack([xy, np.full(len(t), _LAP_HEIGHT_M)]) + sway[:, :3] * [0.04, 0.04, 0.03]
        angles = sway[:, 3:] * [0.04, 0.05, 0.08]
        angles[:, 2] += heading + 2.0 * np.pi * turns
        return positions, angles

    return BodySpline.from_design(design, duration_s, _SPACING_S)


def stop_and_go(rng: np.random.Generator, duration_s: float) -> BodySpline:
    """Return a body carried by hand around the block of `laps`, which stands quite still for 4 s of every 12."""
    path = rounded_path([(4.0, 0.0), (12.0, 0.0), (12.0, 7.0), (0.0, 7.0), (0.0, 0.0), (4.0, 0.0)], 1.5)
    lap_m = path.length_m

    def design(t: Array) -> tuple[Array, Array]:
        along = np.maximum(t - _REST_S, 0.0) / _ROUND_S
        rounds = np.floor(along)
        there = smoothstep(along - rounds, 0.0, _GO_SHARE)  # 0 to 1 while it goes
        arc = (rounds + there) * _ROUND_M
        turns = np.floor(arc / lap_m)
        xy, heading = path.at(arc - turns * lap_m)
        # hands sway as the body goes: along the way, not in time, so that they rest with it
        sway = wander((rounds + there) * _ROUND_S * _GO_SHARE, rng, 1.0, (0.15, 1.2), 6)
        positions = np.column_stack([xy, np.full(len(t), _LAP_HEIGHT_M)]) + sway[:, :3] * [0.08, 0.08, 0.06]
        angles = sway[:, 3:] * [0.06, 0.08, 0.1]
        angles[:, 2] += heading + 2.0 * np.pi * turns
        return positions, angles

    return BodySpline.from_design(design, duration_s, _SPACING_S)


def cart_laps(rng: np.random.Generator, duration_s: float) -> BodySpline:
    """Return a body on wheels, lap after lap around a block of 30 x 18 m, which stands for 2 s every 25 m."""
    path = rounded_path([(8.0, 0.0), (30.0, 0.0), (30.0, 18.0), (0.0, 18.0), (0.0, 0.0), (8.0, 0.0)], 1.5)
    farthest_m = _SPEED_M_S * duration_s
    stops = tuple(np.arange(_CART_LEG_M, farthest_m, _CART_LEG_M).tolist())
    travel = Travel(farthest_m + _CART_LEG_M, _SPEED_M_S, 1.5, _REST_S, 0.0, stops, 2.0)
    shake_seed = int(rng.integers(0, 2**32))

    def design(t: Array) -> tuple[Array, Array]:
        arc = travel.arc_m(t)
        turns = np.floor(arc / path.length_m)
        xy, heading = path.at(arc - turns * path.length_m)
        # a floor shakes a cart while it moves: along the way, not in time
        shaking = wander(arc, np.random.default_rng(shake_seed), 1.0, (0.4, 2.5), 3) * [0.003, 0.003, 0.0008]
        shaking *= smoothstep(arc, 0.05, 0.5)[:, None]
        z = _CART_HEIGHT_M + shaking[:, 2]
        angles = np.column_stack([shaking[:, 0], shaking[:, 1], heading + 2.0 * np.pi * turns])
        return np.column_stack([xy, z]), angles

    return BodySpline.from_design(design, duration_s, _SPACING_S)


@dataclass(frozen=True, slots=True)
class PointWorld:
    """A motion through a cloud of landmarks."""

    description: str
    motion: Callable[[np.random.Generator, float], BodySpline]
    usual_s: float  # duration when none is asked for
    longest_s: float
    camera_offset_m: tuple[float, float, float]


_HOURS_S = 4 * 3600.0

POINT_WORLDS: dict[str, PointWorld] = {
    "still": PointWorld("a body that never moves", still, 60.0, _HOURS_S, (0.05, 0.02, 0.03)),
    "turn-in-place": PointWorld(
        "3 s of rest, then whole circles to and fro about the camera itself", turn_in_place, 60.0, _HOURS_S, (0.0,) * 3
    ),
    "straight": PointWorld(
        "3 s of rest, then straight ahead at a constant 1 m/s", straight, 60.0, _HOURS_S, (0.05, 0.02, 0.03)
    ),
    "slow-start": PointWorld(
        "3 s of rest, then straight ahead, faster by 0.05 m/s every second", slow_start, 20.0, 60.0, (0.05, 0.02, 0.03)
    ),
    "laps": PointWorld(
        "3 s of rest, then laps of 36 m, carried by hand", laps, 120.0, _HOURS_S, (0.05, 0.02, 0.03)
    ),
    "stop-and-go": PointWorld(
        "3 s of rest, then 5 m by hand and 4 s of rest, again and again", stop_and_go, 60.0, _HOURS_S,
        (0.05, 0.02, 0.03),
    ),
    "cart-laps": PointWorld(
        "3 s of rest, then on wheels in laps of 93 m, with a stop every 25 m", cart_laps, 120.0, _HOURS_S,
        (0.2, 0.02, 0.3),
    ),
}  # fmt: skip


def world_motion(name: str, rng: np.random.Generator, duration_s: float | None) -> BodySpline:
    """Return the motion of a point world, or of a rendered world (whole: those have an end)."""
    if name in POINT_WORLDS:
        world = POINT_WORLDS[name]
        return world.motion(rng, min(world.usual_s if duration_s is None else duration_s, world.longest_s))
    return WORLDS[name].motion(rng)


def world_rig(name: str) -> Rig:
    """Return a stereo rig of the VI-Sensor's cameras, looking along the body's x."""
    offset = POINT_WORLDS[name].camera_offset_m if name in POINT_WORLDS else WORLDS[name].camera_offset_m
    T_body_cam0 = np.eye(4)
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down, z forward
    T_body_cam0[:3, :3] = level @ Rotation.from_rotvec([0.008, -0.006, 0.011]).as_matrix()
    T_body_cam0[:3, 3] = offset
    reference = vi_sensor_rig()
    return Rig(reference.cameras, (T_body_cam0, T_body_cam0 @ reference.T_cam0_cam1))


def vi_sensor_rig() -> Rig:
    """Return the stereo rig of EuRoC's VI-Sensor (Burri et al., IJRR 2016): 752x480, 80 degrees wide, 11 cm apart."""
    left = Camera(
        width=752, height=480, fx=458.654, fy=457.296, cx=367.215, cy=248.375, distortion="radtan",
        coefficients=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05), sigmas=EXACT,
    )  # fmt: skip
    right = Camera(
        width=752, height=480, fx=457.587, fy=456.134, cx=379.999, cy=255.238, distortion="radtan",
        coefficients=(-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05), sigmas=EXACT,
    )  # fmt: skip
    T_body_left = np.array(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
            [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
            [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    T_body_right = np.array(
        [
            [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
            [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
            [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return Rig((left, right), (T_body_left, T_body_right))
