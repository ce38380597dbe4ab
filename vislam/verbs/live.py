"""`vislam live`: the pipeline on live sensors, in processes, with the pose published."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from vislam.config import Config, SensorsConfig, load, load_sensors
from vislam.verbs.arguments import parse, take_path
from vislam.verbs.results import print_metrics, written_up
from vislam.verbs.terminal import rewritten_line


@dataclass(frozen=True)
class LiveOptions:
    """Options of `vislam live`."""

    out: Path
    """Folder to make for everything that the run leaves"""
    source: str = "virtual-cart"
    """virtual-cart[,option=value], replay:SOURCE, or IMU and camera: gy85+webcam, serial:PORT+webcam"""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    seconds: float | None = None
    """How long; None: until Ctrl-C, or the end of a replay"""
    overwrite: bool = False
    """Replace the run that the folder holds"""
    json: bool = False
    """Print the metrics as JSON instead of the table"""


def main(arguments: list[str]) -> int:
    """Run live until the time is over, the source ends or a signal comes."""
    command = ["vislam", "live", *arguments]
    settings, sensors = load(take_path(arguments, "--config")), load_sensors(take_path(arguments, "--sensors"))
    base = LiveOptions(out=tyro.MISSING, settings=settings, sensors=sensors)
    options = parse(LiveOptions, arguments, "live", base)
    from vislam.live.run_live import LiveRun
    from vislam.live.sensors import open_live
    from vislam.live.status import status_line
    from vislam.runfolder import prepare

    source, settings = open_live(options.source, options.settings, options.sensors)
    prepare(options.out, options.overwrite)
    with written_up(options.out), rewritten_line() as show:
        live = LiveRun(source, settings, options.out, options.source, command)
        seconds = source.duration_s if options.seconds is None else options.seconds
        metrics = live.execute(lambda run: show(status_line(run)), seconds)
    print_metrics(metrics, options.out, options.json)
    return 0
