"""vislam: SLAM from a camera and a cheap IMU.

from vislam import Config, Slam, open_source

recording = open_source("tum:PATH")
slam = Slam(Config(), recording.rig, recording.imu_noise)
for value in recording.events():
    for step in slam.feed(value):
        print(step.front.frame.t_ns, step.T_map_body)
slam.finish()
print(slam.back.graph.poses())
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vislam.config import Config
    from vislam.datasets import open_dataset
    from vislam.slam import Slam
    from vislam.sources import open_source

__all__ = ["Config", "Slam", "open_dataset", "open_source"]

_HOMES = {
    "Config": "vislam.config",
    "Slam": "vislam.slam",
    "open_dataset": "vislam.datasets",
    "open_source": "vislam.sources",
}


def __getattr__(name: str) -> Any:
    """Import late: `import vislam` must stay as light as what is used of it."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'vislam' has no attribute '{name}'")
