"""`vislam simulate`: a recording of a simulated world, or a pose graph, with exact truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from vislam.config import GraphWorldConfig
from vislam.verbs.arguments import parse
from vislam.verbs.terminal import progress_bar


@dataclass(frozen=True)
class SimulateOptions:
    """Options of `vislam simulate`."""

    world: Positional[str]
    """Name of a simulated world; a wrong one lists them"""
    out: Path
    """Folder to make for the recording (ASL layout, with truth)"""
    rig: Literal["rgbd", "stereo", "mono"] | None = None
    """Cameras; None: what the world has"""
    duration_s: float | None = None
    """Only the first so many seconds"""
    camera_hz: float | None = None
    """Frames per second; None: what the world has"""
    image_width_px: int = 640
    """Width of the 4:3 images"""
    exposure_s: float | None = None
    """Motion blur of this exposure; 0: none, None: what the world has"""
    readout_s: float = 0.0
    """Rolling shutter: time from the first to the last row"""
    workers: int = 2
    """Threads that render; they change nothing but the time"""
    seed: int = 0
    """Of motion and sensors; same seed, same bytes"""
    world_seed: int = 0
    """Of the place: its textures, and where things stand"""


@dataclass(frozen=True)
class SimulateGraphOptions:
    """Options of `vislam simulate --graph SHAPE`: a pose graph with known truth, for `vislam optimize`."""

    graph: Literal["grid3d", "torus", "sphere", "manhattan"]
    """Shape of the path: in space, manhattan in the plane; steps of 1 m"""
    out: Path
    """g2o file to write; it starts from odometry"""
    settings: Annotated[GraphWorldConfig, tyro.conf.arg(name="")] = field(default_factory=GraphWorldConfig)
    truth: Path | None = None
    """Write the true poses here (TUM; the id as seconds)"""
    outliers: Path | None = None
    """Write which loops are false here (CSV: from_id, to_id)"""


def main(arguments: list[str]) -> int:
    """Record a simulated world, or with --graph make a pose graph."""
    if any(argument.partition("=")[0] == "--graph" for argument in arguments):
        return _simulate_graph(parse(SimulateGraphOptions, arguments, "simulate"))
    return _simulate_recording(parse(SimulateOptions, arguments, "simulate"))


def _simulate_recording(options: SimulateOptions) -> int:
    from vislam.datasets.recorder import record
    from vislam.sim import open_world

    choices = {name: value for name, value in asdict(options).items() if name not in ("world", "out")}
    world = open_world(options.world, **choices)
    with progress_bar(options.world) as progress:

        def on_frame(done: int) -> None:
            if progress is not None:
                progress(done, world.frame_count, "")

        recorder = record(world, options.out, on_frame=on_frame)
    frames = recorder.counts["frames"]
    print(f"{frames} frames in {options.out}; next: vislam run {options.out} --out RUN")
    return 0


def _simulate_graph(options: SimulateGraphOptions) -> int:
    from vislam.batch.graph_worlds import simulate_graph, write_simulated

    graph = simulate_graph(options.graph, options.settings)
    write_simulated(graph, options.out, options.truth, options.outliers)
    edges, false = len(graph.problem.edges), int(graph.outlier.sum())
    print(f"{len(graph.truth)} poses and {edges} edges ({false} false loops) in {options.out}")
    print(f"next: vislam optimize {options.out}")
    return 0
