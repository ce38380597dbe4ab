"""Where measurements come from: a recording on disk in one of several formats, or a simulated world."""

from __future__ import annotations

from vislam.errors import UsageError
from vislam.recording import Recording


def open_source(uri: str, seed: int = 0) -> Recording:
    """Open `euroc:PATH`, `tum:PATH`, `kitti:PATH`, `video:PATH`, `sim:WORLD[,option=value...]`, or a bare path.

    Raises UsageError for an unknown format or world, DataError when the recording cannot be used.
    """
    if uri.startswith("sim:"):
        from vislam.sim import open_world

        name, *parts = uri.removeprefix("sim:").split(",")
        for part in parts:
            if "=" not in part:
                raise UsageError(f"'{part}' in {uri} is no option; write sim:WORLD,option=value")
        return open_world(name, seed=seed, **dict(part.split("=", 1) for part in parts))
    from vislam.datasets import open_dataset

    return open_dataset(uri)
