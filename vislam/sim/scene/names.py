"""What things in simulated worlds are called, down to what hangs on a wall: exact labels for every pixel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImageU8
from vislam.sim.scene.scene import Painter, SceneBuilder, Surface

NAMES = (
    "thing", "floor", "ceiling", "wall", "door", "poster", "sign", "whiteboard", "window", "shelf", "table", "pallet",
    "barrel", "pillar", "cupboard", "bench", "plant", "lamp",
)  # fmt: skip
_IDS = {name: number for number, name in enumerate(NAMES, start=1)}  # 0 is unlabelled

Hung = tuple[float, float, float, float, Painter]
"""Something flat on a surface: left, top from the surface's bottom, width, height in metres, and its painter."""
_More = ParamSpec("_More")


@dataclass(frozen=True, slots=True)
class Named:
    """A painter of something that has a name."""

    name: str
    paint: Painter

    def __call__(self, rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        """Paint it."""
        return self.paint(rng, height, width, ppm)


@dataclass(frozen=True, slots=True)
class Carrying:
    """A painter of a surface with things on it."""

    things: Sequence[Hung]
    paint: Painter

    def __call__(self, rng: np.random.Generator, height: int, width: int, ppm: float) -> ImageU8:
        """Paint it."""
        return self.paint(rng, height, width, ppm)


def named(name: str) -> Callable[
    [Callable[Concatenate[SceneBuilder, _More], None]], Callable[Concatenate[SceneBuilder, _More], None]
]:  # fmt: skip
    """Let all that a function adds to a world have a name."""

    def wrap(add: Callable[Concatenate[SceneBuilder, _More], None]) -> Callable[Concatenate[SceneBuilder, _More], None]:
        @wraps(add)
        def inner(world: SceneBuilder, /, *args: _More.args, **kwargs: _More.kwargs) -> None:
            outer, world.name = world.name, name
            try:
                add(world, *args, **kwargs)
            finally:
                world.name = outer

        return inner

    return wrap


def labels_of(surfaces: Sequence[Surface]) -> tuple[NDArray[np.uint8], Array]:
    """Return the label [P] of surfaces, and what hangs on them [M, 6]: surface, low and high u and v in m, label."""
    labels = [_IDS[s.painter.name if isinstance(s.painter, Named) else s.name] for s in surfaces]
    hung = [
        (p, left, s.size_m[1] - top, left + width, s.size_m[1] - top + height, _IDS[painter.name])
        for p, s in enumerate(surfaces)
        if isinstance(s.painter, Carrying)
        for left, top, width, height, painter in s.painter.things
        if isinstance(painter, Named)
    ]
    return np.array(labels, np.uint8), np.array(hung, np.float64).reshape(-1, 6)
