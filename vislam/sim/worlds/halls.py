"""The world `aliased-halls`: four halls around a block that look alike, made to fool what trusts appearance.

A quarter of the world is one hall and the corridor that leads to it; the other three are the same quarter turned about
the middle, painted with the same pixels. Only a number on the wall distinguishes the first three halls; the fourth has
the same furniture in other places. The walk enters every hall the same way, so that not only single views agree with
the wrong hall but whole sequences of them. It passes its start again and goes on for half a round: true revisits.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vislam.core.messages import ImageU8
from vislam.sim.motion.path import Travel, rounded_path, walk
from vislam.sim.motion.spline import BodySpline
from vislam.sim.scene import Painter, SceneBuilder, furniture, paint, signs

_CENTRE_M = 5.6  # of the halls and of the corridors, from the middle of the block along x and y
_HALL_M = 2.6  # half the side of a hall
_HALF_WIDTH_M = 1.0  # of a corridor
_HEIGHT_M = 2.7
_SPEED_M_S = 1.15
_TURN_RADIUS_M = 1.3
_TEXELS_PER_M = 190.0


def motion(rng: np.random.Generator) -> BodySpline:
    """Return a walk of 1.6 rounds, every round on a slightly different line."""
    c = _CENTRE_M
    first = [(c, -c), (c + 0.1, c), (-c, c - 0.1), (-c - 0.05, -c)]
    second = [(c - 0.15, -c + 0.12), (c - 0.1, c - 0.1)]
    points = [(-1.6, -c), *first, *second, (-1.0, c - 0.05)]
    jitter = rng.uniform(-0.08, 0.08, (len(points), 2))
    path = rounded_path(
        [(x + float(dx), y + float(dy)) for (x, y), (dx, dy) in zip(points, jitter, strict=True)], _TURN_RADIUS_M
    )
    travel = Travel(path.length_m, _SPEED_M_S, 1.2, 2.3, 1.0)
    return walk(path, travel, int(rng.integers(0, 2**32)))


def build(rng: np.random.Generator) -> SceneBuilder:
    """Return the four quarters; which number hangs where is all that differs between the first three."""
    layout, pixels = (int(seed) for seed in rng.integers(0, 2**31, 2))
    world = SceneBuilder(ambient=0.32)
    for quarter in range(4):
        part = _quarter(layout, _usual if quarter < 3 else _rearranged)
        for index, one in enumerate(part.surfaces):
            part.surfaces[index] = replace(one, painter=_always(one.painter, pixels + index))
        _number(part, quarter)
        world.add_turned(part, quarter * np.pi / 2.0)
    inside, across = _CENTRE_M - _HALL_M - 0.02, _CENTRE_M - _HALF_WIDTH_M - 0.02
    for x, y in ((inside, across), (across, inside)):
        world.solids.append((np.array([0.0, 0.0, _HEIGHT_M / 2]), np.diag([x, y, _HEIGHT_M / 2])))
    return world


def _always(painter: Painter, seed: int) -> Painter:
    """Return a painter that paints the same pixels whatever generator it is given."""

    def paint_again(_rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        return painter(np.random.default_rng(seed), height, width, ppm)

    return paint_again


def _quarter(layout: int, furnish: Callable[[SceneBuilder, np.random.Generator], None]) -> SceneBuilder:
    """Return the hall in the south-east, entered from the west and left to the north, and the corridor before it."""
    rng = np.random.default_rng(layout)
    part = SceneBuilder()
    c, h, w = _CENTRE_M, _HALL_M, _HALF_WIDTH_M
    north, door = -c + h, (c - w, c + w)
    cream, blue, brick = (165.0, 190.0, 200.0), (150.0, 125.0, 90.0), paint.brick((95, 115, 165))
    plaster = paint.plaster(cream, blue, 0.95)
    runs = (
        ((-(c - h), -c + w), (c - h, -c + w), plaster),  # corridor, the side towards the middle
        ((c - h, -c - w), (-(c - h), -c - w), plaster),
        ((c - h, -c + w), (c - h, north), plaster),  # hall, beside the door that is entered by
        ((c - h, -c - h), (c - h, -c - w), plaster),
        ((c + h, -c - h), (c - h, -c - h), brick),
        ((c + h, north), (c + h, -c - h), plaster),
        ((c - h, north), (door[0], north), plaster),  # beside the door that is left by
        ((door[1], north), (c + h, north), plaster),
    )
    for left, right, base in runs:
        length = float(np.hypot(right[0] - left[0], right[1] - left[1]))
        hung = furniture.hangings(rng, length, _HEIGHT_M, crowd=1.3, doors=length > 5.0)
        furniture.wall(part, left, right, _HEIGHT_M, signs.carrying(base, hung), _TEXELS_PER_M)
    ceiling = paint.tiles((185, 190, 190), 0.6, 0.1)
    for low, high, painter in (
        ((-(c - h), -c - w), (c - h, -c + w), paint.tiles((135, 150, 160), 0.3, 0.12)),
        ((c - h, -c - h), (c + h, -c + h), paint.concrete((125, 130, 125), 60.0)),
    ):
        furniture.floor(part, low, high, painter, _TEXELS_PER_M)
        furniture.ceiling(part, low, high, _HEIGHT_M, ceiling, 90.0)
    for x, y in ((-1.8, -c), (1.8, -c), (c - 1.2, -c + 1.2), (c + 1.2, -c - 1.2)):
        furniture.ceiling_lamp(part, (x, y, _HEIGHT_M), (0.9, 0.3), float(rng.uniform(1.0, 1.6)))
    furnish(part, rng)
    return part


def _usual(part: SceneBuilder, rng: np.random.Generator) -> None:
    """Furnish the hall as in the first three quarters."""
    c, h = _CENTRE_M, _HALL_M
    furniture.shelf(part, rng, (c + h - 0.3, -c - 0.6), np.pi, (0.5, 1.7, 1.9), 4, (60, 70, 170))
    furniture.table(part, rng, (c - 1.2, -c - h + 0.45), np.pi / 2, (0.7, 1.5, 0.85), 4)
    furniture.pallet(part, rng, (c + 1.5, -c - 1.75), 0.1)
    furniture.cupboard(part, (c - h + 0.9, -c + h - 0.25), -np.pi / 2, (0.45, 1.0, 1.7), (110, 140, 90))
    furniture.barrel(part, rng, (c + 2.05, -c + 2.05))
    furniture.bench(part, (c + h - 0.3, -c + 1.1), np.pi, 1.2, (90, 120, 170))


def _rearranged(part: SceneBuilder, rng: np.random.Generator) -> None:
    """Furnish it with the same pieces, in the same order (so with the same pixels), at other places."""
    c, h = _CENTRE_M, _HALL_M
    furniture.shelf(part, rng, (c - 0.9, -c - h + 0.3), np.pi / 2, (0.5, 1.7, 1.9), 4, (60, 70, 170))
    furniture.table(part, rng, (c + h - 0.45, -c + 1.1), np.pi, (0.7, 1.5, 0.85), 4)
    furniture.pallet(part, rng, (c + 1.85, -c - 0.7), 1.5)
    furniture.cupboard(part, (c + 1.2, -c - h + 0.25), np.pi / 2, (0.45, 1.0, 1.7), (110, 140, 90))
    furniture.barrel(part, rng, (c - 2.05, -c + 2.05))
    furniture.bench(part, (c - 1.75, -c + h - 0.3), -np.pi / 2, 1.2, (90, 120, 170))


def _number(part: SceneBuilder, quarter: int) -> None:
    """Hang the number of the hall where one who looks for it sees it."""
    corner = (_CENTRE_M + _HALL_M - 0.01, -_CENTRE_M + 0.25, 2.35)
    plate = signs.sign((225, 225, 225), f"H{quarter + 1}")
    part.rectangle(corner, (0.0, -0.5, 0.0), (0.0, 0.0, -0.3), plate, 260.0)
