"""`vislam map`: the maps of a run made again, or questions to an OctoMap file."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.brief import Brief
from vislam.cli.verbs.terminal import progress_bar
from vislam.config import MapConfig
from vislam.config.ranges import Finite, Positive, Range
from vislam.core.errors import printable
from vislam.core.log import log_in_run


@dataclass(frozen=True)
class MapOptions:
    """Options of `vislam map`."""

    source: Positional[Path]
    """Run folder, to make its maps again with these settings, or to ask its labels; or OctoMap file (.bt, .ot), to ask
    it"""
    settings: Annotated[MapConfig, tyro.conf.arg(name="")] = field(default_factory=MapConfig)
    out: Path | None = None
    """Folder for the maps of a run; None: in the place of those it has"""
    poses: str = "graph"
    """Where the keyframes of a run are: graph, or the NAME of a trajectory_NAME.tum in it, such as batch"""
    info: bool = False
    """Say how large the map is and what it holds; done too when nothing else is asked"""
    query: tuple[Finite, Finite, Finite] | None = None
    """Say what is at X Y Z (metres, map frame): occupied, free or unknown, and what is nearest"""
    nearest: str | None = None
    """Say where the nearest thing with this label is in the map of a run, which needs labels"""
    from_m: Annotated[tuple[Finite, Finite, Finite], tyro.conf.arg(name="from")] = (0.0, 0.0, 0.0)
    """Place X Y Z (metres, map frame) that is asked from; 0 0 0 is where a run began"""
    level: Annotated[int, Range(0, 16)] = 0
    """Query cubes of 2**level voxels"""
    window_m: Positive = 5.0
    """Look so far for the nearest obstacle and frontier"""
    json: bool = False
    """Print JSON instead of lines"""


OPTIONS = (MapOptions,)
BRIEF = Brief(
    "RUN|FILE.bt [options]",
    (
        "vislam map runs/desk --resolution-m 0.02 --products cloud octomap mesh",
        "vislam map runs/desk --poses batch --out maps/desk",
        "vislam map runs/desk/map/octomap.bt --query 1.0 2.0 0.5",
        "vislam map runs/desk --nearest chair",
    ),
    (
        "products", "resolution_m", "max_range_m", "cloud_voxel_m", "mesh_voxel_m", "surfel_m", "grid_low_m",
        "grid_high_m", "labels.folder",
    ),
    {},
)  # fmt: skip


def main(arguments: list[str]) -> int:
    """Make the maps of a run again, or describe an OctoMap file; settings that are not given are those of the run."""
    run = next((Path(argument) for argument in arguments if Path(argument).is_dir()), None)
    settings = MapConfig() if run is None or {"-h", "--help", "--help-all"} & {*arguments} else _settings_of(run)
    options = parse(MapOptions, arguments, "map", MapOptions(source=tyro.MISSING, settings=settings), BRIEF)
    if options.nearest is not None:
        return _nearest(options, options.nearest)
    if not options.source.is_dir():
        return _describe(options)
    with log_in_run(options.source, ["vislam", "map", *arguments]):
        return _rebuild(options)


def _settings_of(run: Path) -> MapConfig:
    from vislam.runs.offline.rebuild import map_settings

    return map_settings(run).map


def _describe(options: MapOptions) -> int:
    from vislam.mapping.octree import describe_octree, describe_place, read_octree

    octree = read_octree(options.source)
    answer: dict[str, Any] = {}
    if options.info or options.query is None:
        answer |= describe_octree(octree)
    if options.query is not None:
        answer |= describe_place(octree, options.query, options.level, options.window_m)
    print(json.dumps(answer) if options.json else "\n".join(f"{name}: {value}" for name, value in answer.items()))
    return 0


def _nearest(options: MapOptions, name: str) -> int:
    from vislam.mapping.semantic.layer_files import read_layer
    from vislam.mapping.semantic.query import describe_nearest

    folder = options.source / "map"
    answer = describe_nearest(read_layer(folder if folder.is_dir() else options.source), options.from_m, name)
    print(json.dumps(answer) if options.json else "\n".join(f"{key}: {value}" for key, value in answer.items()))
    return 0


def _rebuild(options: MapOptions) -> int:
    from vislam.runs.offline.rebuild import rebuild
    from vislam.runs.report import write_report

    with progress_bar(options.source.name, "steps") as progress:
        answer = rebuild(options.source, options.settings, options.out, options.poses, progress)
    if options.out is None:
        write_report(options.source)
    if options.json:
        print(json.dumps(answer))
        return 0
    print(f"{answer['keyframes']} keyframes, depth from the {answer['depth']}, poses of {answer['poses']}")
    for name, path in answer["written"].items():
        print(f"{name}: {path}")
    for name, count in answer.get("labels", {}).items():
        print(f"{name}: {count}")
    for name, reason in answer["left_out"].items():
        print(f"warning: no {name}: {printable(reason)}")
    return 0
