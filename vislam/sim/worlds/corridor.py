"""The world `corridor-loop`: a walk of 70 m around a block of corridors, closed once by passing its start again."""

import numpy as np

from vislam.sim.motion.path import Travel, rounded_path, walk
from vislam.sim.motion.spline import BodySpline
from vislam.sim.scene import SceneBuilder, furniture, paint, signs

_X, _Y, _Z = 10.5, 6.5, 2.6  # half sizes of the centre line, height
_HALF_WIDTH_M = 1.15
_SPEED_M_S = 1.25


def motion(rng: np.random.Generator) -> BodySpline:
    """Return one round and eight metres more, with the bob and sway of walking."""
    around = [(_X, -_Y + 0.1), (_X - 0.1, _Y), (-_X, _Y - 0.1), (-_X + 0.1, -_Y)]
    inner = [(2.0, -_Y - 0.15), (6.0, -_Y + 0.2)]
    path = rounded_path([(-4.0, -_Y), *inner, *around, (-4.5, -_Y + 0.05), (0.0, -_Y - 0.1), (4.0, -_Y)], 1.2)
    travel = Travel(path.length_m, _SPEED_M_S, 1.2, 2.3, 1.0)
    return walk(path, travel, int(rng.integers(0, 2**32)))


def build(rng: np.random.Generator) -> SceneBuilder:
    """Return four corridors; each has its own colours, floor, doors, posters and furniture."""
    world = SceneBuilder(ambient=0.3)
    outer = [(s * (_X + _HALF_WIDTH_M), t * (_Y + _HALF_WIDTH_M)) for s, t in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
    inner = [(s * (_X - _HALF_WIDTH_M), t * (_Y - _HALF_WIDTH_M)) for s, t in ((-1, 1), (-1, -1), (1, -1), (1, 1))]
    walls = [(150.0, 180.0, 195.0), (185.0, 180.0, 150.0), (160.0, 190.0, 165.0), (180.0, 165.0, 190.0)]
    skirts = [(90.0, 110.0, 150.0), (140.0, 110.0, 80.0), (100.0, 140.0, 90.0), (80.0, 90.0, 140.0)]
    for ring in (outer, inner):
        for index in range(4):
            left, right = ring[index], ring[(index + 1) % 4]
            length = float(np.hypot(right[0] - left[0], right[1] - left[1]))
            base = paint.plaster(walls[index], skirts[(index + (ring is inner)) % 4], 0.95)
            if ring is outer and index == 1:
                base = paint.brick((95, 115, 165))
            hung = furniture.hangings(rng, length, _Z, crowd=1.2)
            furniture.wall(world, left, right, _Z, signs.carrying(base, hung), 190.0)
    world.solids.append((np.array([0.0, 0.0, _Z / 2]), np.diag([inner[2][0] - 0.02, inner[0][1] - 0.02, _Z / 2])))
    _floors(world)
    _furniture(world, rng)
    _lamps(world, rng)
    return world


def _floors(world: SceneBuilder) -> None:
    w = _HALF_WIDTH_M
    strips = (
        ((-_X - w, -_Y - w), (_X + w, -_Y + w), paint.tiles((135, 150, 160), 0.3, 0.12)),
        ((-_X - w, _Y - w), (_X + w, _Y + w), paint.concrete((125, 130, 125), 60.0)),
        ((_X - w, -_Y + w), (_X + w, _Y - w), paint.wood((85, 120, 165), 0.14)),
        ((-_X - w, -_Y + w), (-_X + w, _Y - w), paint.tiles((110, 120, 150), 0.45, 0.15)),
    )
    for low, high, painter in strips:
        furniture.floor(world, low, high, painter, 190.0)
        furniture.ceiling(world, low, high, _Z, paint.tiles((185, 190, 190), 0.6, 0.1), 90.0)


def _furniture(world: SceneBuilder, rng: np.random.Generator) -> None:
    near, far = _HALF_WIDTH_M - 0.21, -_HALF_WIDTH_M + 0.21
    places = [(-7.5, near), (-5.0, far), (-1.0, near), (2.5, far), (5.5, near), (8.0, far)]
    for side, (turn, half) in enumerate(((0.0, _X), (np.pi / 2, _Y), (np.pi, _X), (3 * np.pi / 2, _Y))):
        for place, across in places:
            along = place + float(rng.uniform(-0.8, 0.8))
            if abs(along) > half - 2.2:
                continue
            offset = np.array([along, -(_Y if side % 2 == 0 else _X) + across])
            cosine, sine = np.cos(turn), np.sin(turn)
            centre = (float(cosine * offset[0] - sine * offset[1]), float(sine * offset[0] + cosine * offset[1]))
            facing = turn + (-np.pi / 2 if across > 0 else np.pi / 2)
            _piece(world, rng, centre, float(facing))


def _piece(world: SceneBuilder, rng: np.random.Generator, centre: tuple[float, float], facing: float) -> None:
    kind = int(rng.integers(0, 6))
    color = paint.shade(rng, paint.VIVID[int(rng.integers(0, len(paint.VIVID)))], 0.3)
    if kind == 0:
        furniture.bench(world, centre, facing, 1.3, color)
    elif kind == 1:
        furniture.cupboard(world, centre, facing, (0.4, 1.1, 1.7), color)
    elif kind == 2:
        furniture.plant(world, rng, centre)
    elif kind == 3:
        furniture.shelf(world, rng, centre, facing, (0.36, 1.2, 1.8), 4, color, "books")
    elif kind == 4:
        world.box(centre, 0.0, (0.4, 0.5, 0.45), facing, signs.carton())
        world.box(centre, 0.45, (0.33, 0.4, 0.3), facing + 0.15, signs.crate(color), signs.carton())
    else:
        world.cylinder(
            centre, 0.0, 0.16, 0.6, signs.carrying(paint.plain(color), [(0.3, 0.5, 0.4, 0.3, signs.poster())])
        )


def _lamps(world: SceneBuilder, rng: np.random.Generator) -> None:
    for y in (-_Y, _Y):
        for x in np.linspace(-_X, _X, 8):
            furniture.ceiling_lamp(world, (float(x), y, _Z), (0.9, 0.3), float(rng.uniform(0.8, 1.7)))
    for x in (-_X, _X):
        for y in np.linspace(-_Y + 3.0, _Y - 3.0, 3):
            furniture.ceiling_lamp(world, (x, float(y), _Z), (0.3, 0.9), float(rng.uniform(0.8, 1.7)))
