"""The page of a live run, as the command line has it: its options, its beginning and its end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro
from tyro.conf import UseAppendAction

from vislam.core.errors import UsageError, VislamError
from vislam.core.log import log_to

if TYPE_CHECKING:
    from vislam.cli.verbs.live import LiveOptions
    from vislam.live.web.station import Station

Made = TypeVar("Made")


@dataclass(frozen=True)
class PageOptions:
    """Options of the page: where it listens, names beside its own, and whether the run waits for it."""

    web: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[HOST:PORT]")] = None
    """A page that shows and steers the run; 127.0.0.1:8765 where nothing else is said"""
    web_waits: bool = False
    """With --web: begin when the page says so; until then it can calibrate"""
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
                f"vislam: others can reach {station.address} (with this machine's address where that is none); whoever "
                "has the token steers the run, and what is sent can be read on the way: a tunnel is safer "
                "(docs/cart.md)", file=sys.stderr, flush=True,
            )  # fmt: skip
        with station.noticing():
            yield station
    finally:
        station.close()


def begun_by_page(
    station: Station, options: LiveOptions, command: list[str], make: Callable[[LiveOptions], Made]
) -> tuple[Made, LiveOptions]:
    """Wait until the page says that the run shall begin, and return what `make` makes of the options, and those.

    Meanwhile the page can calibrate: the options then have what was found. Where it cannot be made, as where a sensor
    is missing, the page says why and it may be tried again.

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
