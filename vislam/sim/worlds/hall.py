"""The world `workshop-cart`: a cart drives two laps through a furnished hall of 13 x 9 m."""

import numpy as np

from vislam.core.messages import Array
from vislam.sim.motion.path import Travel, rounded_path, smoothstep, wander
from vislam.sim.motion.spline import BodySpline
from vislam.sim.scene import Hung, SceneBuilder, furniture, paint, signs

_X, _Y, _Z = 6.5, 4.5, 3.8  # half length, half width, height
_BODY_HEIGHT_M = 0.3
_REST_S = 2.5
_SPEED_M_S = 0.85
_KNOTS_S = 0.15
_CART_REST_S = 4.0  # before it drives: gravity and gyro bias are found
_SQUAT_RAD_S2_M = 0.004  # pitch of a cart by its acceleration: stiff springs, 0.2 degrees at 0.85 m/s^2
_LAPS: list[tuple[float, float]] = [
    (4.55, -2.65), (4.6, 2.6), (-0.4, 2.75), (-4.6, 2.55), (-4.55, -2.6), (0.5, -2.75),
    (4.4, -2.5), (4.45, 2.45), (0.4, 2.7), (-4.4, 2.7), (-4.65, -2.5), (0.6, -2.6),
    (4.6, -2.75), (4.5, 2.7), (-0.2, 2.5), (-4.5, 2.6), (-4.5, -2.7), (0.4, -2.55),
    (4.45, -2.6), (4.6, 2.5), (0.2, 2.75), (-4.65, 2.65), (-4.4, -2.6),
]  # fmt: skip


def motion(rng: np.random.Generator) -> BodySpline:
    """Return two laps, the second a little beside the first, with one pause between; small shaking while it drives."""
    first = [(4.55, -2.65), (4.6, 2.6), (-0.4, 2.75), (-1.5, 2.45), (-4.6, 2.55), (-4.55, -2.6)]
    second = [(4.4, -2.5), (4.45, 2.45), (1.2, 2.6), (0.1, 2.85), (-4.4, 2.7), (-4.65, -2.5)]
    path = rounded_path([(-1.2, -2.6), (2.5, -2.7), *first, (-0.5, -2.75), (1.5, -2.55), *second, (0.2, -2.65)], 1.05)
    lap_m = 0.5 * path.length_m
    travel = Travel(path.length_m, _SPEED_M_S, 1.5, _REST_S, 1.5, stops_m=(1.05 * lap_m,), pause_s=1.5)

    def design(t_s: Array) -> tuple[Array, Array]:
        arc = travel.arc_m(t_s)
        arc = arc + 0.2 * np.sin(2.0 * np.pi * 9.0 * arc / path.length_m) * np.clip(
            arc * (path.length_m - arc), 0.0, 1.0
        )
        xy, heading = path.at(arc)
        # The floor shakes the cart only while it moves, and the same way at the same place.
        shaking = wander(arc, np.random.default_rng(shake_seed), 1.0, (0.4, 2.5), 3)
        rolling = smoothstep(arc, 0.05, 0.5) * smoothstep(path.length_m - arc, 0.05, 0.5)
        shaking *= rolling[:, None] * np.array([0.003, 0.003, 0.0008])
        z = _BODY_HEIGHT_M + shaking[:, 2]
        return np.column_stack([xy, z]), np.column_stack([shaking[:, 0], shaking[:, 1], heading])

    shake_seed = int(rng.integers(0, 2**32))
    return BodySpline.from_design(design, travel.duration_s, _KNOTS_S)


def cart_drive(rng: np.random.Generator) -> BodySpline:
    """Return four laps and a bit, 105 m with stops: what a transport cart does, its nose down when it brakes."""
    path = rounded_path([(-1.2, -2.6), *_LAPS, (0.2, -2.65)], 0.9)
    stops = tuple(np.cumsum(rng.uniform(7.0, 13.0, 10)).tolist())
    travel = Travel(path.length_m, _SPEED_M_S, 1.5, _CART_REST_S, 2.0, tuple(s for s in stops if s < 98.0), 1.6)
    shake_seed = int(rng.integers(0, 2**32))

    def design(t_s: Array) -> tuple[Array, Array]:
        arc = travel.arc_m(t_s)
        xy, heading = path.at(arc)
        shaking = wander(arc, np.random.default_rng(shake_seed), 1.0, (0.4, 2.5), 3)
        rolling = smoothstep(arc, 0.05, 0.5) * smoothstep(path.length_m - arc, 0.05, 0.5)
        shaking *= rolling[:, None] * np.array([0.003, 0.003, 0.0008])
        step_s = 0.05
        ahead, behind = travel.arc_m(t_s + step_s), travel.arc_m(t_s - step_s)
        pitch = shaking[:, 1] - _SQUAT_RAD_S2_M * (ahead - 2.0 * arc + behind) / step_s**2
        z = _BODY_HEIGHT_M + shaking[:, 2]
        return np.column_stack([xy, z]), np.column_stack([shaking[:, 0], pitch, heading])

    return BodySpline.from_design(design, travel.duration_s, _KNOTS_S)


def build(rng: np.random.Generator) -> SceneBuilder:
    """Return the hall: shelves in the middle, work places, pallets, lockers and barrels along the walls."""
    world = SceneBuilder(ambient=0.3)
    _shell(world, rng)
    for x, load in ((-2.35, "boxes"), (-0.45, "boxes"), (1.45, "boxes")):
        color = paint.shade(rng, (160, 90, 30), 0.3)
        furniture.shelf(world, rng, (x, 0.36), np.pi / 2, (0.6, 1.8, 2.1), 4, color, load)
        furniture.shelf(world, rng, (x, -0.36), -np.pi / 2, (0.6, 1.8, 2.1), 4, color, load)
    furniture.pallet(world, rng, (2.95, 0.25), 0.1)
    furniture.barrel(world, rng, (2.9, -0.75))
    furniture.barrel(world, rng, (-3.55, 0.5))
    world.box((-3.5, -0.35), 0.0, (0.5, 0.7, 0.62), 0.25, signs.crate((60, 140, 60)), signs.carton())
    for x in (-3.25, 3.6):
        furniture.pillar(world, rng, (x, 1.25 if x < 0 else -1.35), 0.32, _Z)
    _along_walls(world, rng)
    for x in (-4.4, 0.0, 4.4):
        for y in (-2.2, 2.2):
            furniture.ceiling_lamp(world, (x, y, _Z), (1.5, 0.35), float(rng.uniform(2.2, 4.2)))
    world.lamp((-6.1, 1.0, 2.3), 2.0, (1.15, 1.0, 0.85))
    world.lamp((-6.1, -1.8, 2.3), 2.0, (1.15, 1.0, 0.85))
    return world


def _shell(world: SceneBuilder, rng: np.random.Generator) -> None:
    tape = (35.0, 190.0, 225.0)
    marks: list[Hung] = [
        (1.15, 7.65, 10.7, 0.07, paint.plain(tape)), (1.15, 1.42, 10.7, 0.07, paint.plain(tape)),
        (1.15, 7.65, 0.07, 6.3, paint.plain(tape)), (11.8, 7.65, 0.07, 6.3, paint.plain(tape)),
        (3.2, 5.95, 6.7, 0.07, paint.plain(tape)), (3.2, 3.1, 6.7, 0.07, paint.plain(tape)),
        (3.0, 3.0, 0.9, 0.5, signs.sign((225, 225, 225))), (9.0, 2.7, 0.9, 0.5, signs.sign((60, 60, 190))),
        (2.0, 6.6, 1.1, 0.7, signs.sign((160, 110, 40))), (6.2, 7.3, 1.6, 0.5, signs.stripes()),
        (9.6, 6.9, 0.9, 0.6, signs.sign((225, 225, 225))), (10.6, 4.9, 1.0, 1.0, signs.stripes()),
        (5.7, 2.5, 1.3, 0.4, signs.stripes()), (1.5, 4.8, 0.9, 0.9, signs.sign((70, 150, 70))),
    ]  # fmt: skip
    furniture.floor(world, (-_X, -_Y), (_X, _Y), signs.carrying(paint.concrete(), marks))
    furniture.ceiling(world, (-_X, -_Y), (_X, _Y), _Z, paint.tiles((170, 175, 178), 0.6, 0.1))
    cream, blue, green = (165.0, 190.0, 200.0), (150.0, 125.0, 90.0), (120.0, 145.0, 105.0)
    corners = ((-_X, _Y), (_X, _Y), (_X, -_Y), (-_X, -_Y))
    bases = (
        paint.plaster(cream, green),
        paint.brick(),
        paint.plaster(cream, blue),
        paint.plaster(cream, (120, 130, 160)),
    )
    for index, base in enumerate(bases):
        left, right = corners[index], corners[(index + 1) % 4]
        length = float(np.hypot(right[0] - left[0], right[1] - left[1]))
        hung = furniture.hangings(rng, length, _Z, crowd=1.3)
        hung += [
            (
                float(x),
                float(rng.uniform(2.75, 3.5)),
                float(rng.uniform(0.5, 1.3)),
                0.45,
                signs.sign(paint.VIVID[int(k)]),
            )
            for x, k in zip(np.arange(0.6, length - 1.4, 2.1), rng.integers(0, 10, 40), strict=False)
        ]
        furniture.wall(world, left, right, _Z, signs.carrying(base, hung))
    for y in (2.1, -0.6):
        corner = (-_X + 0.02, y - 1.6, 3.0)
        world.rectangle(corner, (0.0, 1.6, 0.0), (0.0, 0.0, -1.3), signs.window(), 150.0, glow=0.8)


def _along_walls(world: SceneBuilder, rng: np.random.Generator) -> None:
    north, south, west, east = -np.pi / 2, np.pi / 2, 0.0, np.pi
    furniture.table(world, rng, (-4.6, 4.0), north, (0.75, 1.9, 0.9), 5)
    furniture.shelf(world, rng, (-2.2, 4.15), north, (0.5, 1.7, 1.9), 4, (60, 70, 170))
    furniture.cupboard(world, (-0.2, 4.15), north, (0.5, 1.5, 1.85), (120, 110, 70))
    furniture.table(world, rng, (2.1, 4.0), north, (0.75, 1.9, 0.9), 5)
    furniture.pallet(world, rng, (4.5, 3.9), north, 3)
    furniture.barrel(world, rng, (5.9, 3.85))
    furniture.shelf(world, rng, (6.1, 1.6), east, (0.5, 2.0, 2.0), 4, (50, 120, 60))
    furniture.cupboard(world, (6.15, -0.5), east, (0.5, 1.2, 1.9), (90, 90, 160))
    furniture.table(world, rng, (6.0, -2.3), east, (0.75, 1.5, 0.85), 4)
    furniture.barrel(world, rng, (5.9, -3.85))
    furniture.pallet(world, rng, (3.9, -3.95), south, 2)
    furniture.shelf(world, rng, (1.8, -4.15), south, (0.5, 2.0, 1.9), 4, (40, 130, 200))
    furniture.bench(world, (-0.2, -4.1), south, 1.4, (90, 120, 170))
    furniture.cupboard(world, (-2.0, -4.2), south, (0.45, 1.2, 1.8), (110, 140, 90))
    furniture.shelf(world, rng, (-4.0, -4.15), south, (0.45, 1.6, 1.7), 4, (80, 80, 80), "books")
    furniture.plant(world, rng, (-5.9, -3.9))
    furniture.table(world, rng, (-6.0, -1.6), west, (0.7, 1.6, 0.85), 4)
    furniture.pallet(world, rng, (-5.95, 0.6), west, 1)
    furniture.bench(world, (-6.15, 2.4), west, 1.3, (70, 100, 150))
