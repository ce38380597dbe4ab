"""Label images of a simulated recording, exact to the pixel, as `map.labels.folder` takes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2

from vislam.core.files import replacing, write_text
from vislam.sim.scene import NAMES
from vislam.sim.worlds.simulation import Simulation


def write_labels(world: Simulation, folder: Path, on_frame: Callable[[int], None] | None = None) -> None:
    """Write a PNG of labels for every frame of a world, named by its stamp, and `labels.toml`.

    `on_frame` is told how many are written. Raises StorageError when one cannot be.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "labels.toml", "".join(f'{i} = "{name}"\n' for i, name in enumerate(NAMES, start=1)))
    for index in range(world.frame_count):
        t_ns, labels = world.labels(index)
        with replacing(folder / f"{t_ns}.png") as file:
            file.write(bytes(cv2.imencode(".png", labels)[1]))
        if on_frame is not None:
            on_frame(index + 1)
