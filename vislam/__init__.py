"""vislam: SLAM from a camera and a cheap IMU.

import vislam

run = vislam.run("tum:PATH", out="runs/desk", graph={"coupling": "tight"})
print(run)

or value by value, in a program of one's own:

recording = vislam.open_source("tum:PATH")
slam = vislam.Slam(vislam.Config(), recording.rig, recording.imu_noise)
for value in recording.events():
    for step in slam.feed(value):
        print(step.front.frame.t_ns, step.T_map_body)
slam.finish()

What a program may use stands in `__all__` here and in the rooms (`vislam.ekf`, `vislam.graph` ...).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.kernel_cache import choose_kernel_cache
from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.batch import PoseGraphFile
    from vislam.config import Config
    from vislam.core.camera import Camera, Rig
    from vislam.core.errors import VislamError
    from vislam.core.imu_noise import ImuNoise
    from vislam.core.messages import Frame, ImuSample, MagSample, NavState, Observations
    from vislam.core.readings import Reading
    from vislam.core.recording import Recording
    from vislam.core.trajectory import Trajectory
    from vislam.datasets import open_dataset
    from vislam.ekf import Ekf
    from vislam.graph import Graph
    from vislam.loop import LoopDetector
    from vislam.mapping.octree import Octree
    from vislam.runs.loaded import LoadedRun, load_run
    from vislam.runs.run import run
    from vislam.runs.sources import open_source
    from vislam.slam import Slam
    from vislam.trajectory import evaluate
    from vislam.window import Window

__all__ = [
    "Camera",
    "Config",
    "Ekf",
    "Frame",
    "Graph",
    "ImuNoise",
    "ImuSample",
    "LoadedRun",
    "LoopDetector",
    "MagSample",
    "NavState",
    "Observations",
    "Octree",
    "PoseGraphFile",
    "Reading",
    "Recording",
    "Rig",
    "Slam",
    "Trajectory",
    "VislamError",
    "Window",
    "evaluate",
    "load_run",
    "open_dataset",
    "open_source",
    "run",
]

choose_kernel_cache()

__getattr__ = late(
    __name__,
    {
        "Camera": "vislam.core.camera",
        "Config": "vislam.config",
        "Ekf": "vislam.ekf",
        "Frame": "vislam.core.messages",
        "Graph": "vislam.graph",
        "ImuNoise": "vislam.core.imu_noise",
        "ImuSample": "vislam.core.messages",
        "LoadedRun": "vislam.runs.loaded",
        "LoopDetector": "vislam.loop",
        "MagSample": "vislam.core.messages",
        "NavState": "vislam.core.messages",
        "Observations": "vislam.core.messages",
        "Octree": "vislam.mapping.octree",
        "PoseGraphFile": "vislam.batch",
        "Reading": "vislam.core.readings",
        "Recording": "vislam.core.recording",
        "Rig": "vislam.core.camera",
        "Slam": "vislam.slam",
        "Trajectory": "vislam.core.trajectory",
        "VislamError": "vislam.core.errors",
        "Window": "vislam.window",
        "evaluate": "vislam.trajectory",
        "load_run": "vislam.runs.loaded",
        "open_dataset": "vislam.datasets",
        "open_source": "vislam.runs.sources",
        "run": "vislam.runs.run",
    },
)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
