"""vislam: SLAM from a camera and a cheap IMU.

from vislam import Config, Slam, open_source

recording = open_source("tum:PATH")
slam = Slam(Config(), recording.rig, recording.imu_noise)
for value in recording.events():
    for step in slam.feed(value):
        print(step.front.frame.t_ns, step.T_map_body)
slam.finish()
print(slam.back.graph.poses())

`vislam run SOURCE --out RUN` keeps all of it in a folder; `load_run("RUN")` brings it back as numpy arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.kernel_cache import choose_kernel_cache
from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.config import Config
    from vislam.datasets import open_dataset
    from vislam.runs.loaded import LoadedRun, load_run
    from vislam.runs.sources import open_source
    from vislam.slam import Slam

__all__ = ["Config", "LoadedRun", "Slam", "load_run", "open_dataset", "open_source"]

choose_kernel_cache()

__getattr__ = late(
    __name__,
    {
        "Config": "vislam.config",
        "LoadedRun": "vislam.runs.loaded",
        "Slam": "vislam.slam",
        "load_run": "vislam.runs.loaded",
        "open_dataset": "vislam.datasets",
        "open_source": "vislam.runs.sources",
    },
)
