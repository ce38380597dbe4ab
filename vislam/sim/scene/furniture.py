"""Furniture of the simulated worlds and their shell, composed of boxes, cylinders and painted plates."""

import numpy as np

from vislam.sim.scene import paint, signs
from vislam.sim.scene.names import Hung, named
from vislam.sim.scene.paint import VIVID, Color
from vislam.sim.scene.scene import Lamp, Painter, SceneBuilder

Point = tuple[float, float]
_METAL: Color = (105, 100, 96)


@named("wall")
def wall(
    world: SceneBuilder, left: Point, right: Point, height_m: float, painter: Painter, texels_per_m: float = 200.0
) -> None:
    """Add a wall from its left to its right end as seen by who looks at it."""
    world.rectangle(
        (left[0], left[1], height_m),
        (right[0] - left[0], right[1] - left[1], 0.0),
        (0.0, 0.0, -height_m),
        painter,
        texels_per_m,
    )


@named("floor")
def floor(world: SceneBuilder, low: Point, high: Point, painter: Painter, texels_per_m: float = 200.0) -> None:
    """Add a floor at height zero between two corners."""
    length, width = high[0] - low[0], high[1] - low[1]
    world.rectangle((low[0], high[1], 0.0), (length, 0.0, 0.0), (0.0, -width, 0.0), painter, texels_per_m)


@named("ceiling")
def ceiling(
    world: SceneBuilder, low: Point, high: Point, height_m: float, painter: Painter, texels_per_m: float = 80.0
) -> None:
    """Add a ceiling between two corners."""
    length, width = high[0] - low[0], high[1] - low[1]
    world.rectangle((low[0], low[1], height_m), (length, 0.0, 0.0), (0.0, width, 0.0), painter, texels_per_m)


def hangings(
    rng: np.random.Generator, length_m: float, height_m: float, crowd: float = 1.0, doors: bool = True
) -> list[Hung]:
    """Return doors, posters, boards and signs along a wall, without overlaps; `crowd` above 1 packs them closer."""
    hung: list[Hung] = []
    left = float(rng.uniform(0.15, 0.5))
    while left < length_m - 0.5:
        choice = rng.random()
        room = length_m - 0.15 - left
        if doors and choice < 0.16 and room > 1.0:
            color = paint.shade(rng, VIVID[int(rng.integers(0, len(VIVID)))], 0.4)
            hung.append((left, 2.08, 0.95, 2.08, signs.door(color)))
            width = 0.95
        elif choice < 0.28 and room > 1.7:
            width = float(rng.uniform(1.1, 1.7))
            hung.append((left, 2.0, width, float(rng.uniform(0.8, 1.1)), signs.whiteboard()))
        elif choice < 0.42:
            width = float(rng.uniform(0.3, 0.7))
            color = VIVID[int(rng.integers(0, len(VIVID)))]
            hung.append((left, float(rng.uniform(1.0, 2.1)), width, float(rng.uniform(0.2, 0.4)), signs.sign(color)))
        else:
            width = min(room, float(rng.uniform(0.4, 1.0)))
            tall = float(width * rng.uniform(0.7, 1.4))
            top = float(rng.uniform(min(1.35, tall + 0.2), min(height_m - 0.15, 2.15)))
            hung.append((left, max(top, tall + 0.1), width, tall, signs.poster()))
            if rng.random() < 0.35 and top - tall > 0.55:
                hung.append((left + 0.1, 0.45, float(rng.uniform(0.15, 0.3)), 0.14, signs.sign((200, 205, 208))))
        left += width + float(rng.uniform(0.08, 0.55)) / crowd
    return hung


def _at(centre: tuple[float, float], yaw: float, forward: float, left: float) -> tuple[float, float]:
    """Return the world position of a point given in a piece's own frame (x to its front, y to its left)."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return (float(centre[0] + cosine * forward - sine * left), float(centre[1] + sine * forward + cosine * left))


@named("shelf")
def shelf(
    world: SceneBuilder,
    rng: np.random.Generator,
    centre: tuple[float, float],
    yaw: float,
    size_m: tuple[float, float, float],
    boards: int = 4,
    color: Color = (150, 95, 40),
    load: str = "boxes",
) -> None:
    """Add an open shelf with uprights, boards and goods ("boxes" or "books"); its front looks along `yaw`."""
    depth, width, height = size_m
    steel = paint.plain(color)
    for forward in (-0.5 * depth + 0.03, 0.5 * depth - 0.03):
        for left in (-0.5 * width + 0.03, 0.5 * width - 0.03):
            world.box(_at(centre, yaw, forward, left), 0.0, (0.05, 0.05, height), yaw, steel)
    gap = (height - 0.15) / boards
    for level in range(boards):
        bottom = 0.1 + level * gap
        world.box(
            centre, bottom, (depth - 0.02, width - 0.02, 0.035), yaw, paint.wood((110, 135, 160)), show_bottom=True
        )
        if load == "books":
            _fill_with_books(world, rng, centre, yaw, (depth, width, gap), bottom + 0.035)
        else:
            _fill_with_boxes(world, rng, centre, yaw, (depth, width, gap), bottom + 0.035)


def _goods(rng: np.random.Generator) -> Painter:
    choice = rng.random()
    if choice < 0.5:
        return signs.carton()
    return signs.crate(paint.VIVID[int(rng.integers(0, len(paint.VIVID)))])


def _fill_with_boxes(
    world: SceneBuilder,
    rng: np.random.Generator,
    centre: tuple[float, float],
    yaw: float,
    bay: tuple[float, float, float],
    bottom: float,
) -> None:
    depth, width, gap = bay
    left = -0.5 * width + 0.09
    while left < 0.5 * width - 0.3:
        box_width = min(float(rng.uniform(0.2, 0.5)), 0.5 * width - 0.09 - left)
        if rng.random() < 0.86:
            size = (float(depth * rng.uniform(0.55, 0.85)), box_width, float((gap - 0.06) * rng.uniform(0.45, 0.95)))
            position = _at(centre, yaw, float(rng.uniform(-0.05, 0.05)) * depth, left + 0.5 * box_width)
            painter = _goods(rng)
            world.box(position, bottom, size, yaw + float(rng.uniform(-0.06, 0.06)), painter, top=signs.carton())
        left += box_width + float(rng.uniform(0.03, 0.1))


def _fill_with_books(
    world: SceneBuilder,
    rng: np.random.Generator,
    centre: tuple[float, float],
    yaw: float,
    bay: tuple[float, float, float],
    bottom: float,
) -> None:
    depth, width, gap = bay
    left = -0.5 * width + 0.06
    while left < 0.5 * width - 0.2:
        row = min(float(rng.uniform(0.25, 0.6)), 0.5 * width - 0.06 - left)
        size = (0.7 * depth, row, float(gap * rng.uniform(0.6, 0.85)))
        position = _at(centre, yaw, float(rng.uniform(-0.1, 0.1)) * depth, left + 0.5 * row)
        world.box(position, bottom, size, yaw, paint.plain((60, 65, 70)), front=signs.books(), texels_per_m=300.0)
        left += row + float(rng.uniform(0.02, 0.12))


@named("table")
def table(
    world: SceneBuilder,
    rng: np.random.Generator,
    centre: tuple[float, float],
    yaw: float,
    size_m: tuple[float, float, float],
    things: int = 4,
) -> None:
    """Add a table on four legs with boxes, tins and a screen on it."""
    depth, width, height = size_m
    for forward in (-0.45, 0.45):
        for left in (-0.46, 0.46):
            world.box(
                _at(centre, yaw, forward * depth, left * width),
                0.0,
                (0.06, 0.06, height - 0.04),
                yaw,
                paint.plain(_METAL),
            )
    world.box(centre, height - 0.04, (depth, width, 0.04), yaw, paint.wood((95, 145, 190)), show_bottom=True)
    places = (np.arange(things) + 0.5) / things - 0.5
    for index, place in enumerate(rng.permutation(places)):
        left = float(place) * width * 0.88
        position = _at(centre, yaw, float(rng.uniform(-0.15, 0.2)) * depth, left)
        turn = yaw + float(rng.uniform(-0.3, 0.3))
        if index == 0:
            world.box(
                position, height + 0.08, (0.04, 0.55, 0.34), turn, paint.plain((45, 45, 48)), front=signs.screen()
            )
            world.box(position, height, (0.16, 0.2, 0.08), turn, paint.plain((50, 50, 52)))
        elif rng.random() < 0.35:
            tin = signs.carrying(
                paint.plain(paint.shade(rng, (170, 120, 60), 0.5)), [(0.02, 0.17, 0.3, 0.13, signs.poster())]
            )
            world.cylinder(position, height, 0.07, 0.2, tin, paint.plain((150, 150, 150)), 300.0)
        else:
            size = tuple(float(s) for s in rng.uniform((0.14, 0.18, 0.08), (0.28, 0.35, 0.3)))
            world.box(
                position, height, (size[0], size[1], size[2]), turn, _goods(rng), top=signs.carton(), texels_per_m=280.0
            )


@named("pallet")
def pallet(
    world: SceneBuilder, rng: np.random.Generator, centre: tuple[float, float], yaw: float, layers: int = 2
) -> None:
    """Add a wooden pallet with cartons stacked on it."""
    world.box(centre, 0.0, (0.8, 1.2, 0.14), yaw, paint.wood(plank_m=0.05))
    bottom = 0.14
    for layer in range(layers):
        height = float(rng.uniform(0.26, 0.42))
        for forward in (-0.19, 0.19):
            for left in (-0.38, 0.0, 0.38):
                if layer > 0 and rng.random() < 0.35:
                    continue
                size = (float(rng.uniform(0.33, 0.37)), float(rng.uniform(0.33, 0.37)), height)
                turn = yaw + float(rng.uniform(-0.05, 0.05))
                world.box(_at(centre, yaw, forward, left), bottom, size, turn, signs.carton(), texels_per_m=240.0)
        bottom += height


@named("barrel")
def barrel(world: SceneBuilder, rng: np.random.Generator, centre: tuple[float, float]) -> None:
    """Add a steel drum with a label."""
    color = paint.VIVID[int(rng.integers(0, 5))]
    rim = signs.stripes(paint.shade(rng, color, 0.3), (210, 210, 210), 0.04)
    hung = [
        (0.0, 0.62, 1.9, 0.03, rim),
        (float(rng.uniform(0.1, 0.6)), 0.55, 0.4, 0.34, signs.poster()),
        (float(rng.uniform(1.0, 1.3)), 0.5, 0.35, 0.25, signs.sign((220, 225, 228))),
    ]
    world.cylinder(centre, 0.0, 0.29, 0.86, signs.carrying(paint.plain(color), hung), paint.plain(color))


@named("pillar")
def pillar(
    world: SceneBuilder, rng: np.random.Generator, centre: tuple[float, float], side_m: float, height_m: float
) -> None:
    """Add a square concrete pillar with a striped foot and a number on every side."""

    def face() -> Painter:
        number = signs.sign(paint.shade(rng, (50, 160, 220), 0.4))
        hung = [(0.0, 1.0, side_m, 0.55, signs.stripes()), (0.1 * side_m, 1.75, 0.8 * side_m, 0.3, number)]
        return signs.carrying(paint.concrete((150, 155, 158), 90.0), hung)

    world.box(centre, 0.0, (side_m, side_m, height_m), 0.0, face())


@named("cupboard")
def cupboard(
    world: SceneBuilder, centre: tuple[float, float], yaw: float, size_m: tuple[float, float, float], color: Color
) -> None:
    """Add lockers or a cupboard against a wall."""
    world.box(centre, 0.0, size_m, yaw, paint.plain(color), front=signs.lockers(color), texels_per_m=240.0)


@named("bench")
def bench(world: SceneBuilder, centre: tuple[float, float], yaw: float, length_m: float, color: Color) -> None:
    """Add a wooden bench."""
    for left in (-0.42, 0.42):
        world.box(_at(centre, yaw, 0.0, left * length_m), 0.0, (0.3, 0.06, 0.4), yaw, paint.plain(_METAL))
    world.box(centre, 0.4, (0.38, length_m, 0.05), yaw, paint.wood(color), show_bottom=True)


@named("plant")
def plant(world: SceneBuilder, rng: np.random.Generator, centre: tuple[float, float]) -> None:
    """Add a pot with a plant of upright leaves."""
    world.cylinder(centre, 0.0, 0.17, 0.36, paint.tiles((70, 95, 165), 0.07, 0.25), paint.concrete((45, 60, 75), 300.0))
    for _ in range(9):
        turn, lean = float(rng.uniform(0.0, 2.0 * np.pi)), float(rng.uniform(0.02, 0.13))
        position = _at(centre, turn, lean, 0.0)
        height = float(rng.uniform(0.3, 0.85))
        world.box(
            position, 0.36, (0.012, float(rng.uniform(0.05, 0.1)), height), turn, paint.wood((50, 130, 60), 0.02, True)
        )


@named("lamp")
def ceiling_lamp(
    world: SceneBuilder, centre: tuple[float, float, float], size_m: tuple[float, float], power: float
) -> None:
    """Add a glowing panel at the ceiling and the light that it throws."""
    warm = (0.93, 0.98, 1.0)
    length, width = size_m
    x, y, z = centre
    corner = (x - 0.5 * length, y - 0.5 * width, z - 0.02)
    panel = paint.plain((245, 250, 250), 0.01, 0.02)
    world.rectangle(corner, (length, 0.0, 0.0), (0.0, width, 0.0), panel, 60.0, glow=0.95)
    world.lamps.append(Lamp((x, y, z - 0.1), power, warm, 0.5 * max(size_m)))
