"""The shell of indoor worlds: walls, floor, ceiling, and what hangs on long walls."""

import numpy as np

from vislam.sim.scene import paint, signs
from vislam.sim.scene.names import Hung, named
from vislam.sim.scene.paint import VIVID
from vislam.sim.scene.scene import Painter, SceneBuilder

Point = tuple[float, float]


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
