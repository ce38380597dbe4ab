"""`vislam simulate`: a recording of a simulated world, or a pose graph, with exact truth."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.terminal import progress_bar
from vislam.config import GraphWorldConfig
from vislam.config.ranges import Count, Few, NonNegative, Positive, Seed, Whole


@dataclass(frozen=True)
class SimulateOptions:
    """Options of `vislam simulate`."""

    world: Positional[str]
    """Name of a simulated world; a wrong one lists them"""
    out: Path
    """Folder to make for the recording (ASL layout, with truth)"""
    rig: Literal["rgbd", "stereo", "mono"] | None = None
    """Cameras; None: what the world has"""
    further_cameras: Whole = 0
    """Beside those, evenly around the vertical, at most 6"""
    duration_s: Positive | None = None
    """Length from the world's start in seconds; None: all of it"""
    camera_hz: Positive | None = None
    """Frames per second; None: what the world has"""
    image_width_px: Count = 640
    """Width of the 4:3 images"""
    exposure_s: NonNegative | None = None
    """Motion blur of this exposure; 0: none, None: what the world has"""
    readout_s: NonNegative = 0.0
    """Rolling shutter: time from the first to the last row"""
    labels: bool = False
    """Write what each pixel shows into OUT/labels, too, for --map.labels.folder of `run`"""
    workers: Few = 2
    """Threads that render; they change nothing but the time"""
    seed: Seed = 0
    """Of motion and sensors; same seed, same bytes"""
    world_seed: Seed = 0
    """Of the place: its textures, and where things stand"""


@dataclass(frozen=True)
class SimulateGraphOptions:
    """Options of `vislam simulate --graph SHAPE`: a pose graph with known truth, for `vislam posegraph`."""

    graph: Literal["grid3d", "torus", "sphere", "manhattan"]
    """Shape of the path: in space, manhattan in the plane; steps of 1 m"""
    out: Path
    """g2o file to write; it starts from odometry"""
    settings: Annotated[GraphWorldConfig, tyro.conf.arg(name="")] = field(default_factory=GraphWorldConfig)
    truth: Path | None = None
    """Write the true poses here (TUM; the id as seconds)"""
    outliers: Path | None = None
    """Write which loops are false here (CSV: from_id, to_id)"""


OPTIONS = (SimulateOptions, SimulateGraphOptions)


def main(arguments: list[str]) -> int:
    """Record a simulated world, or with --graph make a pose graph."""
    if any(argument.partition("=")[0] == "--graph" for argument in arguments):
        return _simulate_graph(parse(SimulateGraphOptions, arguments, "simulate"))
    return _simulate_recording(parse(SimulateOptions, arguments, "simulate"))


def _simulate_recording(options: SimulateOptions) -> int:
    from vislam.datasets.recorder import record
    from vislam.sim import open_world
    from vislam.sim.worlds.simulation import write_labels

    choices = {name: value for name, value in asdict(options).items() if name not in ("world", "out", "labels")}
    world = open_world(options.world, **choices)
    with progress_bar(options.world) as progress:
        recorder = record(world, options.out, on_frame=lambda done: progress(done, world.frame_count, ""))
        if options.labels:
            write_labels(world, options.out / "labels", lambda done: progress(done, world.frame_count, "labels"))
    frames = recorder.counts["frames"]
    further = f" --map.labels.folder {options.out / 'labels'}" if options.labels else ""
    print(f"{frames} frames in {options.out}; next: vislam run {options.out} --out RUN{further}")
    return 0


def _simulate_graph(options: SimulateGraphOptions) -> int:
    from vislam.batch.posegraph.worlds import simulate_graph, write_simulated

    graph = simulate_graph(options.graph, options.settings)
    write_simulated(graph, options.out, options.truth, options.outliers)
    edges, false = len(graph.problem.edges), int(graph.outlier.sum())
    print(f"{len(graph.truth)} poses and {edges} edges ({false} false loops) in {options.out}")
    print(f"next: vislam posegraph {options.out}")
    return 0
