"""The driver: onto goals by an exact pose, standing still where pose or map are in doubt; then all of it together."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import load
from vislam.core.angles import wrapped
from vislam.core.errors import DataError, UsageError
from vislam.hw.health import Health
from vislam.live.driving.driver import Driver
from vislam.live.driving.lock_step import LockStepCart, drive
from vislam.live.driving.orders import Goal
from vislam.live.driving.pursuit import Limits, PathFollower
from vislam.live.driving.steering import grid_of
from vislam.live.notices import MapCells
from vislam.live.virtual.motion import Drive, Segment, locate
from vislam.live.virtual.place import PlaceOptions, course
from vislam.live.wire.published_pose import PublishedPose
from vislam.mapping.drive.drive_grid import DriveGrid
from vislam.runs.folder import prepare

WELL = Health.LEVELLED | Health.VISION_OK
STEP_NS = 20_000_000
Walls = list[tuple[slice, slice]]


def hall(walls: Walls = [], unseen: Walls = []) -> DriveGrid:  # noqa: B006
    """Flat ground from -2 to 4 m along x and -2 to 2 m along y."""
    states = np.zeros((80, 120), np.int8)
    for rows, columns in walls:
        states[rows, columns] = 1
    for rows, columns in unseen:
        states[rows, columns] = -1
    return grid_of(MapCells(states, 0.05, (-2.0, -2.0), 0.0, (0.6, 0.5)))


class Ride:
    """A cart that a driver drives by its exact pose, which a test may spoil."""

    def __init__(self, *goals: tuple[float, float, float], explores: bool = True) -> None:
        self.driver = Driver([Goal(x, y, math.radians(yaw)) for x, y, yaw in goals], Limits(), explores)
        self.path: list[Segment] = []
        self.now_ns = 0
        self._drive = Drive(None, 0.0, 0.0, 0.0)

    def pose(self) -> PublishedPose:
        here = self._drive.at(self.now_ns * 1e-9)
        twist = np.array([here.speed_m_s, 0.0, 0.0]), np.array([0.0, 0.0, here.rate_rad_s])
        spread, T = np.zeros((6, 6)), here.T_world_body(0.0)
        return PublishedPose(self.now_ns, self.now_ns, 1, WELL, T, *twist, spread, spread, np.eye(4), 1, 0, 0.0)

    def go(self, seconds: float, spoil: Callable[[PublishedPose], PublishedPose | None] = lambda pose: pose) -> Segment:
        """Drive until there is no goal left, or for so long; return where the cart is then."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns and not self.driver.is_over:
            self.now_ns += STEP_NS
            speed, rate = self.driver.command(spoil(self.pose()), self.now_ns)
            self.path += self._drive.advance(self.now_ns * 1e-9, speed, rate)
        return self._drive.at(self.now_ns * 1e-9)


def off(here: Segment, x: float, y: float, yaw_deg: float) -> tuple[float, float]:
    return math.hypot(here.x_m - x, here.y_m - y), math.degrees(abs(wrapped(here.yaw_rad - math.radians(yaw_deg))))


def test_goals_are_reached_one_after_another_with_their_headings() -> None:
    goals = [(2.0, 0.0, 90.0), (0.5, 1.0, 180.0), (0.4, 1.0, 180.0), (0.6, 0.9, -170.0), (0.6, 0.9, 10.0)]
    ride = Ride(*goals)
    ride.driver.see(hall())
    for count, goal in enumerate(goals, start=1):
        while len(ride.driver.arrivals) < count:
            here = ride.go(0.1)
        away_m, away_deg = off(here, *goal)
        assert away_m < 0.03 and away_deg < 1.5, goal
        assert ride.driver.arrivals[-1].is_reached
        assert ride.driver.arrivals[-1].off_m < 0.02
    assert ride.driver.is_over and ride.driver.command(ride.pose(), ride.now_ns) == (0.0, 0.0)
    assert max(abs(s.speed_m_s) for s in ride.path) < 0.61
    assert max(abs(s.rate_rad_s) for s in ride.path) < 0.81


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda pose: None, "there is no pose"),
        (lambda pose: replace(pose, t_ns=pose.t_ns - 300_000_000), "the pose is stale"),
        (lambda pose: replace(pose, health=WELL | Health.INVALID), "the pose is not valid"),
        (lambda pose: replace(pose, health=Health.VISION_OK), "the pose is not valid"),
    ],
)
def test_it_stops_while_the_pose_is_in_doubt_and_goes_on_or_gives_up(
    spoil: Callable[[PublishedPose], PublishedPose | None], reason: str
) -> None:
    ride = Ride((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    ride.driver.see(hall())
    assert ride.go(2.0).speed_m_s > 0.5
    here = ride.go(2.0, spoil)
    assert (here.speed_m_s, here.rate_rad_s) == (0.0, 0.0)
    assert ride.driver.hindrance == reason
    assert ride.go(1.0).speed_m_s > 0.3
    assert ride.driver.hindrance == ""
    there = ride.go(21.0, spoil)
    assert [arrival.reason for arrival in ride.driver.arrivals] == [reason]
    assert ride.go(60.0).x_m < 0.05 < there.x_m  # the next goal is driven to
    assert ride.driver.arrivals[-1].is_reached


def test_an_obstacle_that_appears_is_driven_around_or_stopped_before() -> None:
    wall = (slice(0, 52), slice(70, 74))
    ride = Ride((3.0, 0.0, 0.0))
    ride.driver.see(hall())
    assert ride.go(1.5).speed_m_s > 0.5
    ride.driver.see(hall([wall]))
    assert off(ride.go(60.0), 3.0, 0.0, 0.0)[0] < 0.03
    assert max(s.y_m for s in ride.path) > 0.8
    assert not touches(ride.path, hall([wall]))
    ride = Ride((3.0, 0.0, 0.0), explores=False)
    ride.driver.see(hall())
    ride.go(1.5)
    closed = hall([(slice(0, 80), slice(70, 74))])
    ride.driver.see(closed)
    here = ride.go(60.0)
    assert here.speed_m_s == 0.0 and not touches(ride.path, closed)
    assert "no way leads there" in ride.driver.arrivals[0].reason


def touches(path: list[Segment], grid: DriveGrid) -> bool:
    xy = np.array([[s.x_m, s.y_m] for s in path])
    return not grid.is_traversable(xy, np.array([s.yaw_rad for s in path])).all()


def test_ground_that_was_not_seen_is_not_driven_on_until_it_is() -> None:
    unseen = (slice(0, 80), slice(80, 120))
    ride = Ride((3.0, 0.0, 0.0))
    ride.driver.see(hall(unseen=[unseen]))
    here = ride.go(15.0)
    assert 1.0 < here.x_m < 1.6 and here.speed_m_s == 0.0
    assert ride.driver.hindrance == "the ground ahead is not seen"
    ride.driver.see(hall())
    assert off(ride.go(30.0), 3.0, 0.0, 0.0)[0] < 0.03
    ride = Ride((3.0, 0.0, 0.0), explores=False)
    ride.driver.see(hall(unseen=[unseen]))
    assert ride.go(30.0).x_m == 0.0
    assert "not seen" in ride.driver.arrivals[0].reason


def test_a_cart_that_does_not_know_its_place_turns_to_find_it_and_gives_up_after_a_turn() -> None:
    ride = Ride((2.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    ride.driver.see(hall())

    def lost(pose: PublishedPose) -> PublishedPose:
        return replace(pose, health=WELL | Health.NOT_IN_MAP)

    here = ride.go(10.0, lost)
    assert (here.x_m, here.y_m) == (0.0, 0.0) and here.yaw_rad > 3.0
    while not ride.driver.arrivals:
        ride.go(0.1)
    ride.go(60.0, lost)
    assert [one.reason for one in ride.driver.arrivals] == ["", "the cart was not found in the map"]


def test_it_follows_its_goal_when_the_map_is_corrected() -> None:
    ride = Ride((2.0, 0.5, 0.0))
    ride.driver.see(hall())
    ride.go(2.0)
    T = np.eye(4)
    T[:2, 3] = 0.2, -0.1  # where odom is in map from now on
    here = ride.go(60.0, lambda pose: replace(pose, T_map_odom=T))
    assert off(here, 1.8, 0.6, 0.0)[0] < 0.03


@pytest.mark.parametrize("world", ["workshop", "room", "corridor"])
def test_the_programmed_course_is_followed_to_its_end(world: str) -> None:
    way = course(world, 1)
    follower, cart, errors = PathFollower(way), Drive(None, *way[0].tolist(), 0.0), []
    for k in range(10_000):
        here = cart.at(0.02 * k)
        speed, rate, is_done = follower.command(here.x_m, here.y_m, here.yaw_rad)
        if is_done:
            break
        cart.advance(0.02 * k, speed, rate)
        errors.append(follower.error_m(here.x_m, here.y_m))
    assert is_done and max(errors) < 0.25


def test_what_a_driven_cart_cannot_be_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("bridge=true", "steered=true", "rig=none"):
        with pytest.raises(UsageError, match="leave them off"):
            LockStepCart(PlaceOptions(**dict([option.split("=")])), 9.81)
    with pytest.raises(DataError, match="drive again"):
        next(iter(LockStepCart(PlaceOptions(), 9.81).events()))
    for typed, said in (
        (["--source", "gy85+webcam", "--goal", "1", "0", "0"], "vislam drive moves the virtual cart"),
        (["--source", "virtual-cart,rig=mono", "--goal", "1", "0", "0"], "does not see what is in the way"),
        (["--goal", "1", "0", "nan"], "goal"),
        (["--goal", "1", "0"], "goal"),
        ([], "goal"),
    ):
        assert run_verb(["drive", "--out", str(tmp_path / "drive"), *typed]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "drive").exists()


@pytest.mark.slow
def test_the_virtual_cart_reaches_goals_by_what_it_sees_alone(tmp_path: Path) -> None:
    """Real driver, emulated chips, rendered camera, reference pipeline; the truth decides."""
    config = load(None, {"view.enabled": False, "map.products": ("drive",)})
    options = PlaceOptions(world="room", rig="rgbd", camera_hz=5.0, image_width_px=320, imu_out=((3.0, 3.8),))
    cart = LockStepCart(options, config.machine.gravity_m_s2)
    goal = Goal(0.9, 0.1, math.pi / 2.0)
    driver = Driver([goal], Limits())
    prepare(tmp_path / "run", overwrite=False)
    metrics = drive(cart, driver, config, tmp_path / "run", "virtual-cart", ["vislam", "drive"])
    x, y, _ = options.start
    (arrival,) = driver.arrivals
    assert arrival.is_reached
    there = locate(cart.segments, (arrival.ended_ns - cart.begin_ns) * 1e-9)
    away_m, away_deg = off(there, x + goal.x_m, y + goal.y_m, math.degrees(goal.yaw_rad))
    assert away_m < 0.05 and away_deg < 3.0
    braking = [s.speed_m_s for s in cart.segments if 3.45 < s.t_s < 3.8]  # the pose is stale, the wheels answer late
    assert braking[0] > 0.2 and all(now < before for before, now in pairwise(braking) if before > 0.0)
    assert metrics["keyframes"] > 5 and (tmp_path / "run" / "map" / "drive.pgm").is_file()
