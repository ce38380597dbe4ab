"""The world `handheld-room`: a camera carried by hand, in all six degrees of freedom, through a furnished room."""

import numpy as np

from vislam.core.messages import Array
from vislam.sim.motion.path import smoothstep, wander
from vislam.sim.motion.spline import BodySpline
from vislam.sim.scene import Hung, SceneBuilder, furniture, paint, signs

_X, _Y, _Z = 3.0, 2.3, 2.6
_DURATION_S = 34.0
_REST_S = 1.75
_TURNS = 1.6  # around the room, looking outwards: the last part sees the first again
_KNOTS_S = 0.08


def motion(rng: np.random.Generator) -> BodySpline:
    """Return a walk around the middle of the room, looking outwards, with swings and the tremble of a hand."""
    seeds = rng.integers(0, 2**32, 4)

    def design(t_s: Array) -> tuple[Array, Array]:
        moving = smoothstep(t_s, _REST_S, _REST_S + 2.0) * (1.0 - smoothstep(t_s, _DURATION_S - 2.5, _DURATION_S - 1.0))
        swing, sway, tremble, twitch = (np.random.default_rng(seed) for seed in seeds)
        angle = 2.0 * np.pi * _TURNS * _progress(t_s)
        x, y = 0.95 * np.cos(angle - 2.4), 0.6 * np.sin(angle - 2.4)
        ease = moving[:, None]
        position = np.column_stack([x, y, np.full_like(t_s, 1.35)]) + ease * wander(t_s, sway, 0.09, (0.12, 0.5), 3)
        position += ease * wander(t_s, tremble, 0.002, (1.5, 4.0), 3)
        angles = np.column_stack([np.zeros_like(t_s), np.full_like(t_s, 0.16), angle - 2.4])
        angles += ease * wander(t_s, swing, 1.0, (0.1, 0.4), 3) * np.array([0.07, 0.12, 0.19])
        angles += ease * wander(t_s, twitch, 0.005, (1.5, 4.0), 3)
        return position, angles

    return BodySpline.from_design(design, _DURATION_S, _KNOTS_S)


def _progress(t_s: Array) -> Array:
    """Return progress 0..1 that is even in the middle of the recording and rests at both ends."""
    begin, end, ramp = _REST_S, _DURATION_S - 1.0, 2.5
    grid = np.linspace(begin, end, 2000)
    speed = smoothstep(grid, begin, begin + ramp) * (1.0 - smoothstep(grid, end - ramp, end))
    way = np.cumsum(speed) - speed[0]
    return np.interp(t_s, grid, way / way[-1])


def build(rng: np.random.Generator) -> SceneBuilder:
    """Return a living and working room: desk, shelves with books, bed, sofa, table, rug, posters, a window."""
    world = SceneBuilder(ambient=0.38)
    _shell(world, rng)
    furniture.shelf(world, rng, (-1.9, 2.1), -np.pi / 2, (0.34, 1.3, 2.1), 5, (60, 75, 95), "books")
    furniture.shelf(world, rng, (-0.5, 2.1), -np.pi / 2, (0.34, 1.2, 1.7), 4, (60, 75, 95), "books")
    furniture.table(world, rng, (1.5, 1.9), -np.pi / 2, (0.7, 1.7, 0.75), 5)
    furniture.table(world, rng, (2.6, -0.2), np.pi, (0.65, 1.4, 0.75), 4)
    furniture.cupboard(world, (2.75, 1.2), np.pi, (0.45, 0.9, 1.2), (95, 130, 165))
    world.box((2.2, -1.75), 0.0, (1.4, 0.95, 0.42), 0.0, paint.wood((70, 100, 150)), signs.rug((150, 90, 60)))
    world.box((2.7, -1.75), 0.42, (0.35, 0.75, 0.13), 0.1, signs.rug((200, 200, 205)), texels_per_m=280.0)
    world.box((-0.2, -1.95), 0.0, (1.9, 0.65, 0.4), 0.0, signs.rug((60, 75, 130)))
    world.box((-0.2, -2.2), 0.4, (1.9, 0.18, 0.42), 0.0, signs.rug((60, 75, 130)))
    for x, color in ((-0.8, (60, 170, 210)), (0.3, (170, 120, 60))):
        world.box(
            (x, -2.0), 0.4, (0.42, 0.16, 0.36), 0.15, signs.rug((float(color[0]), float(color[1]), float(color[2])))
        )
    furniture.plant(world, rng, (-2.6, -1.95))
    furniture.plant(world, rng, (0.42, 2.0))
    furniture.cupboard(world, (-2.75, -0.9), 0.0, (0.45, 1.2, 0.85), (140, 150, 160))
    furniture.shelf(world, rng, (-2.8, 0.75), 0.0, (0.32, 1.4, 1.9), 5, (90, 90, 95), "boxes")
    world.box((-2.75, -1.1), 0.85, (0.3, 0.4, 0.28), 0.2, signs.carton(), texels_per_m=280.0)
    world.cylinder((-2.72, -0.62), 0.85, 0.1, 0.24, paint.tiles((70, 120, 190), 0.04, 0.5), texels_per_m=300.0)
    furniture.ceiling_lamp(world, (0.3, 0.1, _Z), (0.9, 0.4), 1.9)
    world.lamp((1.3, 1.6, 1.6), 0.25, (0.75, 0.95, 1.1))
    world.lamp((2.6, -1.5, 1.9), 0.9, (1.2, 1.05, 0.9))
    return world


def _shell(world: SceneBuilder, rng: np.random.Generator) -> None:
    carpet: list[Hung] = [(1.6, 3.3, 2.4, 1.7, signs.rug((70, 80, 140)))]
    furniture.floor(world, (-_X, -_Y), (_X, _Y), signs.carrying(paint.wood((75, 120, 170), 0.12), carpet), 260.0)
    furniture.ceiling(world, (-_X, -_Y), (_X, _Y), _Z, paint.tiles((205, 208, 210), 0.5, 0.08), 150.0)
    corners = ((-_X, _Y), (_X, _Y), (_X, -_Y), (-_X, -_Y))
    bases = (
        paint.plaster((175, 200, 210)),
        paint.plaster((200, 185, 160)),
        paint.brick((150, 165, 185), (0.2, 0.07), 0.16),
        paint.plaster((165, 190, 175)),
    )
    for index, base in enumerate(bases):
        left, right = corners[index], corners[(index + 1) % 4]
        length = float(np.hypot(right[0] - left[0], right[1] - left[1]))
        hung = furniture.hangings(rng, length, _Z, crowd=2.0, doors=index == 3)
        furniture.wall(world, left, right, _Z, signs.carrying(base, hung), 260.0)
    world.rectangle((_X - 0.02, -1.0, 2.25), (0.0, -1.2, 0.0), (0.0, 0.0, -1.2), signs.window(), 220.0, glow=0.85)
