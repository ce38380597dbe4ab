"""`vislam live`: the pipeline on live sensors, in processes, with the pose published."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro
from tyro.conf import UseAppendAction

from vislam.cli.verbs import VERBS
from vislam.cli.verbs.ahead import compile_ahead
from vislam.cli.verbs.arguments import parse, take_option, take_path
from vislam.cli.verbs.brief import COMMON, Brief
from vislam.cli.verbs.results import print_metrics
from vislam.cli.verbs.terminal import rewritten_line
from vislam.config import Config, SensorsConfig, load, load_cart
from vislam.config.ranges import Positive
from vislam.core.errors import UsageError, VislamError
from vislam.core.log import log_to

if TYPE_CHECKING:
    from vislam.live.run_live import LiveRun
    from vislam.live.web.station import Station
    from vislam.runs.folder import MapChoice

Made = TypeVar("Made")


@dataclass(frozen=True)
class PageOptions:
    """Options of the page: where it listens, names beside its own, and whether the run waits for it."""

    web: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[HOST:PORT]")] = None
    """A page that shows and steers the run; 127.0.0.1:8765 where nothing else is said"""
    web_waits: bool = False
    """With --web: begin when the page asks for it; until then it can calibrate"""
    web_host: Annotated[UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """With --web: a further name that the page may be asked for by, such as that of a tunnel"""


@contextmanager
def opened(page: PageOptions, pose_name: str, out: Path) -> Iterator[Station | None]:
    """Serve the page meanwhile, and say where; None where none was asked for.

    Raises UsageError for other options of the page without --web, and for what is no name or address.
    """
    if page.web is None:
        if page.web_waits or page.web_host:
            raise UsageError("--web-waits and --web-host are options of the page; add --web")
        yield None
        return
    from vislam.live.web.address import DEFAULT, is_name, parsed
    from vislam.live.web.station import Station

    for name in page.web_host:
        if not is_name(name):
            raise UsageError(f"--web-host '{name}' is no name of a host; write it without scheme and port")
    at = parsed(" ".join(page.web) or DEFAULT)
    station = Station(at, page.web_host, pose_name, out)
    try:
        print(f"vislam: the page of this run: {station.url}", file=sys.stderr, flush=True)
        if not at.is_loopback:
            print(
                f"vislam: others can reach {station.address} (with this machine's address where that is none); all who "
                "have the token can steer the run, and what is sent can be read on the way: a tunnel is safer "
                "(docs/cart.md)", file=sys.stderr, flush=True,
            )  # fmt: skip
        with station.noticing():
            yield station
    finally:
        station.close()


def begun_by_page(
    station: Station, options: LiveOptions, command: list[str], make: Callable[[LiveOptions], Made]
) -> tuple[Made, LiveOptions]:
    """Wait until the page begins the run, and return what `make` makes of the options, and those.

    Meanwhile the page can calibrate: the options then have what was found. Where it cannot be made, as where a sensor
    is missing, the page shows why and it may be tried again.

    Raises VislamError: the process of the page died.
    """
    from vislam.cli.wizard.calibration_steps import CalibrationSteps
    from vislam.cli.wizard.run_setup import RunSetup

    steps = CalibrationSteps(station, RunSetup(options.source, options.settings, options.sensors), options.out)
    with log_to(options.out, command), closing(steps):
        while station.is_well:
            for asked in station.asked():
                if asked.do == "start" and not steps.is_going:
                    try:
                        found = replace(options, settings=steps.setup.config, sensors=steps.setup.sensors)
                        return make(found), found
                    except VislamError as error:
                        steps.shown = {"kind": "run", "stage": "failed", "lines": [str(error)]}
                else:
                    steps.obey(asked.do, asked.values)
            can = ["start"] if not steps.is_going else []
            station.update("waiting", source=options.source, can=can, steps=steps.offered, wizard=steps.shown)
            steps.turn()
    raise VislamError("the process of the web page died before the run began; start it again")


@dataclass(frozen=True)
class LiveOptions:
    """Options of `vislam live`; `--resume RUN` goes on with a run, whose source, sensors and settings it takes."""

    out: Path
    """Folder to make for everything that the run leaves"""
    source: str = "virtual-cart"
    """virtual-cart[,bridge][,option=value], replay:SOURCE, or IMU and camera: gy85+webcam, board+webcam,
    serial:PORT+webcam; in place of webcam also picam, realsense[,depth], oak[,depth], none (no camera);
    realsense[,depth] and oak[,depth] alone: with the IMU inside that camera"""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    seconds: Positive | None = None
    """How long; None: until Ctrl-C, or the end of a replay"""
    overwrite: bool = False
    """Replace the run that the folder holds"""
    map: Path | None = None
    """Session (RUN/session.db or RUN) of an earlier run in whose map this one begins; it is not written"""
    localize_only: bool = False
    """With --map: find the way in it, and leave its keyframes and clouds as they are"""
    json: bool = False
    """Print the metrics as JSON instead of the table"""
    page: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)


@dataclass(frozen=True)
class ResumeOptions:
    """Options of `vislam live --resume RUN`; source, sensors and settings are those that the run began with."""

    seconds: Positive | None = None
    """How long; None: until Ctrl-C, or the end of a replay"""
    json: bool = False
    """Print the metrics as JSON instead of the table"""
    page: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)


OPTIONS = (LiveOptions, ResumeOptions)
TAKEN = {
    "--config FILE": "TOML file of settings; options go before it",
    "--profile pi": "settings for a small computer; file and options go before it",
    "--sensors FILE": "TOML file of a cart's sensors, with tables [sensors.NAME] of further ones; options go before it",
    "--resume RUN": "go on with that run",
}
BRIEF = Brief(
    "--out RUN [options]",
    (
        "vislam live --source virtual-cart --out runs/live",
        "vislam live --source gy85+webcam --calibration.camera camera.yaml --out runs/cart",
        "vislam live --source serial:/dev/ttyUSB0+webcam --out runs/cart --map runs/hall --localize-only",
        "vislam live --resume runs/cart",
        "vislam live --source gy85+webcam --calibration.camera camera.yaml --out runs/cart --web",
    ),
    (
        *COMMON, "live.send_to", "live.group", "live.allow_remote", "live.ros2_domain", "live.mavlink",
        "live.realtime_priority", "loop.start_in_map", "power_up.memory", "sensors.gy85.bus", "sensors.board.bus",
        "sensors.serial.port", "sensors.webcam.device",
    ),
    TAKEN,
)  # fmt: skip


def main(arguments: list[str]) -> int:
    """Run live until the time is over, the source ends or a signal comes."""
    command = ["vislam", "live", *arguments]
    resumed = take_path(arguments, "--resume")
    if resumed is not None:
        return _resume(resumed, arguments, command)
    settings = load(take_path(arguments, "--config"), profile_name=take_option(arguments, "--profile"))
    sensors, further = load_cart(take_path(arguments, "--sensors"))
    settings = settings if further.file is None else replace(settings, sensors=further)
    defaults = LiveOptions(out=tyro.MISSING, settings=settings, sensors=sensors)
    options = parse(LiveOptions, arguments, "live", defaults, BRIEF)
    compile_ahead(VERBS["live"].compiles)  # while it runs, its processes would stop for it
    from vislam.runs.folder import map_choice, prepare

    base = map_choice(options.map, options.localize_only, options.settings)
    with opened(options.page, options.settings.live.name, options.out) as station:
        make = partial(_made, command=command, base=base, station=station)
        if station is not None and options.page.web_waits:
            prepare(options.out, options.overwrite, base)
            (live, seconds), options = begun_by_page(station, options, command, make)
        else:
            live, seconds = make(options)
            prepare(options.out, options.overwrite, base)
        return _execute(live, command, options.out, options.sensors, seconds, options.json, station)


def _made(
    options: LiveOptions, command: list[str], base: MapChoice | None, station: Station | None
) -> tuple[LiveRun, float | None]:
    """Return the run that the options describe, which has not begun, and how long it shall be."""
    from vislam.live.beginning import in_map
    from vislam.live.run_live import LiveRun
    from vislam.live.sources import open_live

    source, settings = open_live(options.source, options.settings, options.sensors)
    beginning = None if base is None else in_map(base, source, settings)
    ends = None if station is None else station.ends
    live = LiveRun(source, settings, options.out, options.source, command, base, beginning, ends)
    return live, source.duration_s if options.seconds is None else options.seconds


def _resume(out: Path, arguments: list[str], command: list[str]) -> int:
    """Go on with the run in a folder, whatever ended it."""
    from vislam.live.beginning import in_map, resumed
    from vislam.live.run_live import LiveRun
    from vislam.live.sources import open_live, stored_sensors
    from vislam.runs.folder import prepare, read_setup

    options = parse(ResumeOptions, arguments, "live")
    if options.page.web_waits:
        raise UsageError("--web-waits is for new runs; leave it off with --resume")
    asked, config, base = read_setup(out)
    sensors = stored_sensors(out)
    source, settings = open_live(asked, config, sensors)
    beginning = resumed(out, source, settings)
    is_new = beginning is None  # there was nothing yet to go on from
    if is_new and base is not None:
        beginning = in_map(base, source, settings)
    with opened(options.page, settings.live.name, out) as station:
        ends = None if station is None else station.ends
        live = LiveRun(source, settings, out, asked, command, base, beginning, ends)
        if is_new:
            prepare(out, overwrite=True)
        seconds = source.duration_s if options.seconds is None else options.seconds
        return _execute(live, command, out, sensors, seconds, options.json, station)


def _execute(
    live: LiveRun, command: list[str], out: Path, sensors: SensorsConfig, seconds: float | None, as_json: bool,
    station: Station | None,
) -> int:  # fmt: skip
    from vislam.core.files import write_json
    from vislam.live.status import status_line
    from vislam.runs.run import written_up

    with written_up(out, command, lambda: live.is_brief), rewritten_line() as show:
        write_json(out / "sensors.json", asdict(sensors))

        def follow(run: LiveRun) -> None:
            show(status_line(run))
            if station is not None:
                station.follow(run)

        try:
            metrics = live.execute(follow, seconds)
        except KeyboardInterrupt:
            if live.is_brief:  # there was no time for more than the session
                print(f"vislam: {_what_now(out)}", file=sys.stderr)
            raise
    if station is not None and not live.is_brief:
        station.end(metrics)
    print_metrics(metrics, out, as_json)
    if live.is_brief and not as_json:
        print(f"left out, for Ctrl-C does not wait: vislam map {out}; vislam report {out}", flush=True)
    return 0


def _what_now(out: Path) -> str:
    """Return what can be done with a run that was interrupted before it was written up."""
    from vislam.runs.session import can_go_on, has_frames

    if not has_frames(out / "session.db"):
        return "nothing was recorded yet; the same command begins again"
    optimise = f", or vislam optimize {out}" if can_go_on(out / "session.db") else ""
    return f"to go on from there: vislam live --resume {out}{optimise}"
