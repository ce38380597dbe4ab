"""Where measurements come from: a recording on disk in one of several formats, or a simulated world."""

from __future__ import annotations

from vislam.recording import Recording


def open_source(uri: str, seed: int = 0) -> Recording:
    """Open `euroc:PATH`, `tum:PATH`, `kitti:PATH`, `video:PATH`, `sim:WORLD`, or a bare path.

    Raises UsageError for an unknown format or world, DataError when the recording cannot be used.
    """
    if uri.startswith("sim:"):
        from vislam.sim import open_world

        return open_world(uri.removeprefix("sim:"), seed=seed)
    from vislam.datasets import open_dataset

    return open_dataset(uri)
