"""`vislam drive`: the cart driven to goals, on the published pose and the map as it grows."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vislam.cli.verbs import VERBS
from vislam.cli.verbs.ahead import compile_ahead
from vislam.cli.verbs.arguments import parse, take_option, take_path
from vislam.cli.verbs.brief import COMMON, Brief
from vislam.cli.verbs.terminal import rewritten_line
from vislam.config import Config, SensorsConfig, load
from vislam.config.ranges import Finite, Positive
from vislam.core.errors import TrackingLostError, UsageError

if TYPE_CHECKING:
    from vislam.live.driving import Goal, Limits
    from vislam.live.driving.driver import Arrival
    from vislam.live.run_live import LiveRun
    from vislam.live.virtual.place import PlaceOptions

_SEES = "rig=rgbd,image_width_px=640"  # what the virtual cart has here, where nothing else is asked for
_Place = tuple[Finite, Finite, Finite]


@dataclass(frozen=True)
class DriveOptions:
    """Options of `vislam drive`."""

    goal: Annotated[tuple[_Place, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="X Y HEADING_DEG")] = ()
    """Where to stand, in m and degrees of the map; given again, the next goal"""
    out: Path = Path("drive")
    """Folder to make for everything that the run leaves"""
    source: str = "virtual-cart"
    """virtual-cart[,option=value], such as world=workshop, room or corridor, start_x_m, start_yaw_deg"""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    speed_m_s: Positive = 0.6
    """Most that it drives"""
    turn_deg_s: Positive = 45.0
    """Most that it turns"""
    known_ground: bool = False
    """Stay on ground that the map has; without, ground ahead may be driven on once it is seen"""
    real_time: bool = False
    """With the processes of vislam live, pose and map published; without, time passes as the pipeline takes it"""
    listen: bool = False
    """In real time, obey goal_pose, initialpose and cmd_vel of ROS 2 in the domain --live.ros2-domain, until Ctrl-C"""
    overwrite: bool = False
    """Replace the run that the folder holds"""
    map: Path | None = None
    """Session (RUN/session.db or RUN) of an earlier run in whose map the goals lie; it is not written"""
    localize_only: bool = False
    """With --map: find the way in it, and leave its keyframes and clouds as they are"""
    json: bool = False
    """Print the goals as JSON, a line each"""


OPTIONS = (DriveOptions,)
BRIEF = Brief(
    "--goal X Y HEADING_DEG [--goal ...] [options]",
    (
        "vislam drive --goal 2 0 90 --goal 0.5 0.2 180 --out runs/hall",
        "vislam drive --source virtual-cart,start_y_m=2.6 --map runs/hall --goal 2 0 0 --out runs/next",
    ),
    (*COMMON, "map.drive.body_length_m", "map.drive.body_width_m", "map.drive.max_step_m", "map.grid_high_m"),
    {
        "--config FILE": "TOML file of settings; options go before it",
        "--profile pi": "settings for a small computer; file and options go before it",
    },
)


def main(arguments: list[str]) -> int:
    """Drive to goals; raises TrackingLostError when one of them was not reached."""
    command = ["vislam", "drive", *arguments]
    settings = load(take_path(arguments, "--config"), profile_name=take_option(arguments, "--profile"))
    options = parse(DriveOptions, arguments, "drive", DriveOptions(settings=settings), BRIEF)
    kind, _, rest = options.source.partition(",")
    if kind != "virtual-cart":
        raise UsageError(
            f"--source {options.source}: vislam drive moves the virtual cart; write virtual-cart[,option=value]"
        )
    if not options.goal and not options.listen:
        raise UsageError("nowhere to drive to: give --goal X Y HEADING_DEG, or --listen for goals of ROS 2")
    if options.listen and options.settings.live.ros2_domain is None:
        raise UsageError("--listen hears ROS 2: give its domain, --live.ros2-domain 0")
    from vislam.live.driving import Goal, Limits

    goals = [Goal(x, y, math.radians(heading)) for x, y, heading in options.goal]
    limits = Limits(options.speed_m_s, math.radians(options.turn_deg_s))
    go = _in_lock_step
    if options.real_time or options.listen:
        go = _in_real_time
        compile_ahead(VERBS["drive"].compiles)  # while the cart drives, its processes would stop for it
    arrivals = go(options, f"{_SEES},{rest}", goals, limits, command)
    if not options.json:
        print(f"report: {options.out / 'report.html'}")
    missed = max(len(goals), len(arrivals)) - sum(arrival.is_reached for arrival in arrivals)
    if missed and not options.listen:
        raise TrackingLostError(f"{missed} of {len(goals)} goals were not reached; {options.out} has the run")
    return 0


def _in_lock_step(
    options: DriveOptions, asked: str, goals: list[Goal], limits: Limits, command: list[str]
) -> list[Arrival]:
    from vislam.live.driving import Driver, LockStepCart, drive
    from vislam.live.sources import place_options
    from vislam.runs.folder import map_choice, prepare
    from vislam.runs.run import written_up

    config, place = options.settings, place_options(asked)
    _refuse_blind(place, config)
    base = map_choice(options.map, options.localize_only, config)
    driver, cart = Driver(goals, limits, not options.known_ground), LockStepCart(place, config.machine.gravity_m_s2)
    prepare(options.out, options.overwrite, base)
    printed = _Printed(options.json)
    with written_up(options.out, command), rewritten_line() as show:

        def follow(frames: int, _: int, tracking: str) -> None:
            printed.show(driver.arrivals)
            number = min(len(driver.arrivals) + 1, len(goals))
            show(f"goal {number} of {len(goals)}, {frames} frames, {driver.hindrance or tracking}")

        drive(cart, driver, config, options.out, options.source, command, base, follow)
    printed.show(driver.arrivals)
    return driver.arrivals


def _in_real_time(
    options: DriveOptions, asked: str, goals: list[Goal], limits: Limits, command: list[str]
) -> list[Arrival]:
    from vislam.live.beginning import in_map
    from vislam.live.driving import steering
    from vislam.live.run_live import LiveRun
    from vislam.live.sources import open_live
    from vislam.live.status import status_line
    from vislam.live.virtual.cart import VirtualCart
    from vislam.runs.folder import map_choice, prepare
    from vislam.runs.run import written_up

    base = map_choice(options.map, options.localize_only, options.settings)
    source, config = open_live(f"virtual-cart,{asked},steered=true", options.settings, SensorsConfig())
    assert isinstance(source, VirtualCart)
    _refuse_blind(source.options, config)
    send_to = (*config.live.send_to, steering.listening_at(config.live))
    config = replace(config, live=replace(config.live, send_to=send_to))
    beginning = None if base is None else in_map(base, source, config)
    live = LiveRun(source, config, options.out, options.source, command, base, beginning)
    armed = steering.Armed(tuple(goals), limits, not options.known_ground, source.command_name, options.listen)
    live.add_driver(partial(steering.run, armed=armed, live=config.live))
    prepare(options.out, options.overwrite, base)
    printed = _Printed(options.json)
    with written_up(options.out, command, lambda: live.is_brief), rewritten_line() as show:

        def follow(run: LiveRun) -> None:
            notes = run.notes.get("drive", {})
            printed.show(notes.get("arrivals", []))
            if notes.get("is_over") and not options.listen:
                run.stop()
            show(f"{status_line(run)} {notes.get('hindrance', '')}")

        live.execute(follow)
    arrivals: list[Arrival] = live.notes.get("drive", {}).get("arrivals", [])
    printed.show(arrivals)
    return arrivals


def _refuse_blind(place: PlaceOptions, config: Config) -> None:
    """Raise UsageError for a cart that does not see what is in its way."""
    if place.rig != "rgbd" and not config.map.mono_depth.enabled:
        raise UsageError(f"rig={place.rig} does not see what is in the way; leave it off, or give rig=rgbd")


class _Printed:
    """What was printed of goals."""

    def __init__(self, as_json: bool) -> None:
        self._as_json, self._count = as_json, 0

    def show(self, arrivals: list[Arrival]) -> None:
        """Print a line for each goal that is new."""
        for arrival in arrivals[self._count :]:
            self._count += 1
            print((_as_json if self._as_json else _line)(self._count, arrival), flush=True)
        sys.stdout.flush()


def _line(number: int, arrival: Arrival) -> str:
    goal = arrival.goal
    where = f"goal {number} ({goal.x_m:g}, {goal.y_m:g}, {math.degrees(goal.yaw_rad):.0f} deg)"
    way = f"{arrival.driven_m:.1f} m in {arrival.took_s:.1f} s"
    if not arrival.is_reached:
        return f"{where}: not reached, {arrival.reason}; {way}"
    off = f"{100.0 * arrival.off_m:.1f} cm and {math.degrees(arrival.off_rad):.1f} deg off by the pose"
    return f"{where}: reached, {off}; {way}"


def _as_json(_: int, arrival: Arrival) -> str:
    from vislam.core.files import plain

    return json.dumps(plain({**asdict(arrival), "reached": arrival.is_reached}))
