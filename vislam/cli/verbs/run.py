"""`vislam run`: the pipeline over a recording, from its start or from where a run of it ended."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse, take_option, take_path
from vislam.cli.verbs.brief import COMMON, Brief
from vislam.cli.verbs.results import print_metrics
from vislam.cli.verbs.terminal import progress_bar
from vislam.config import Config, dump, load
from vislam.core.errors import UsageError


@dataclass(frozen=True)
class RunOptions:
    """Options of `vislam run`."""

    source: Positional[str]
    """euroc:PATH, tum:PATH, kitti:PATH, video:PATH, phone:PATH, bag:PATH[,cam0=/topic,imu=/topic],
    sim:WORLD[,option=value], points:WORLD or points:PATH[,option=value], eqvio:FILE[,option=value], or a path,
    recognised by its contents"""
    out: Path
    """Folder to make for everything that the run leaves"""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    overwrite: bool = False
    """Replace the run that the folder holds"""
    map: Path | None = None
    """Session (RUN/session.db or RUN) of an earlier run in whose map this one begins; it is not written"""
    localize_only: bool = False
    """With --map: find the way in it, and leave its keyframes and clouds as they are"""
    dry_run: bool = False
    """Only print, as JSON, the configuration that config.json would hold"""
    json: bool = False
    """Print the metrics as JSON instead of the table"""


@dataclass(frozen=True)
class ResumeOptions:
    """Options of `vislam run --resume RUN`; source and settings are those that the run began with."""

    json: bool = False
    """Print the metrics as JSON instead of the table"""


OPTIONS = (RunOptions, ResumeOptions)
TAKEN = {
    "--config FILE": "TOML file of settings; options go before it",
    "--profile pi": "settings for a small computer; file and options go before it",
    "--resume RUN": "go on with that run",
}
BRIEF = Brief(
    "SOURCE --out RUN [options]",
    (
        "vislam run tum:PATH --out runs/desk",
        "vislam run euroc:PATH --out runs/hall --frontend.mode mono",
        "vislam run PATH --out runs/cart --calibration.camera camera.yaml --frontend.planar.height-m 0.3",
        "vislam run PATH --out runs/next --map runs/hall",
        "vislam run --resume runs/hall",
    ),
    (*COMMON, "ekf.graph_feedback", "graph.coupling", "loop.start_in_map", "init.time_offset_s"),
    TAKEN,
)


def main(arguments: list[str]) -> int:
    """Run a recording, or with --resume go on with a run."""
    command = ["vislam", "run", *arguments]
    resumed = take_option(arguments, "--resume")
    if resumed is not None:
        return _resume(Path(resumed), arguments, command)
    settings = load(take_path(arguments, "--config"), profile_name=take_option(arguments, "--profile"))
    base = RunOptions(source=tyro.MISSING, out=tyro.MISSING, settings=settings)
    options = parse(RunOptions, arguments, "run", base, BRIEF)
    if options.dry_run:
        from vislam.runs.run import resolved

        config = dump(resolved(options.source, options.settings))
        print(json.dumps({"source": options.source, "out": str(options.out), "config": config}))
        return 0
    print_metrics(run_options(options, command), options.out, options.json)
    return 0


def _resume(out: Path, arguments: list[str], command: list[str]) -> int:
    """Go on with the run in a folder, whatever ended it."""
    from vislam.runs import resume
    from vislam.runs.folder import read_setup
    from vislam.runs.run import written_up
    from vislam.runs.sources import open_source

    options = parse(ResumeOptions, arguments, "run")
    if (out / "sensors.json").is_file():
        raise UsageError(f"{out} is a live run; go on with it by vislam live --resume {out}")
    source, config, base = read_setup(out)
    if source.partition(",")[0] == "virtual-cart":
        raise UsageError(f"{out} was driven, and cannot be taken up again; begin in its map: vislam drive --map {out}")
    recording = open_source(source, config.seed, config.calibration)
    with written_up(out, command), progress_bar(recording.name) as progress:
        metrics = resume(recording, config, out, source, command, progress, base)
    print_metrics(metrics, out, options.json)
    return 0


def run_options(options: RunOptions, command: list[str]) -> dict[str, Any]:
    """Run what the options ask for, with progress on the terminal; return the metrics."""
    from vislam.runs.folder import map_choice
    from vislam.runs.run import run_source

    choice = map_choice(options.map, options.localize_only, options.settings)
    return run_source(
        options.source, options.settings, options.out, command, overwrite=options.overwrite, choice=choice,
        show=progress_bar,
    )  # fmt: skip
