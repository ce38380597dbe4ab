"""Drives to goals: plans on the map as it grows, follows the route on the published pose, and stops where it must.

It has no clock and no thread: who owns it passes poses, grids and the time, in a live run as in a simulation that takes
no time. It knows nothing but what a controller gets: the published pose, and the drive grid of the map.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from vislam.core.angles import wrapped
from vislam.core.messages import Array
from vislam.hw.health import Health
from vislam.live.driving.orders import Goal
from vislam.live.driving.pursuit import Docking, Limits, PathFollower
from vislam.live.wire.published_pose import PublishedPose
from vislam.mapping.drive.drive_grid import Drive, DriveGrid
from vislam.mapping.drive.route import ground, plan

REACHED_M, REACHED_RAD = 0.02, math.radians(1.0)  # by the pose: what it is off itself comes on top
_NS = 1_000_000_000
_ANSWER_NS = 125_000_000  # until the wheels do what is commanded
_STALE_NS = 250_000_000
_PATIENCE_S = 20.0  # that the cart stands before it gives a goal up
_DOCK_M = 0.35  # from the goal, where it is driven onto
_STILL_M_S, _STILL_RAD_S, _STILL_S = 0.02, 0.03, 0.4
_SEE_M = 0.9  # ahead the ground is seen by a camera that looks down on it; what is not seen there is not driven on
_CREEP_M, _CREPT_M = 0.012, 0.55  # of way to brake on that it creeps by, as long as what is not seen is so far away
_PUT_M = 1.0  # around where the cart was put, the ground is free: who put it there saw that
_TRAIL_M, _TRAIL = 0.2, 500  # between places that it has stood on, and how many are remembered
_SHORTER = 0.85  # of the way left is a new one that is changed to
_LONGEST_S, _LONGEST_S_PER_M = 120.0, 20.0  # that a goal may take, and more by the length of the first route
_SEARCH_RAD_S, _SEARCH_RAD = 0.35, 7.5  # to be found in a map it turns on the spot
_TURN_RAD = 0.3  # of a turn on the spot is looked ahead


@dataclass(frozen=True, slots=True)
class Arrival:
    """What became of a goal."""

    goal: Goal
    reason: str  # it was not reached for; empty: it was
    ended_ns: int
    took_s: float
    driven_m: float
    off_m: float  # at the end, by the published pose
    off_rad: float

    @property
    def is_reached(self) -> bool:
        """Whether the cart stands there."""
        return not self.reason


class Driver:
    """Takes poses and grids, gives speed and turn rate."""

    def __init__(self, goals: list[Goal], limits: Limits, explores: bool = True) -> None:
        """Prepare for goals, one after another; `explores`: over ground that was not seen yet, too."""
        self.arrivals: list[Arrival] = []
        self._goals, self._limits, self._explores = deque(goals), limits, explores
        self._grid: DriveGrid | None = None
        self._ground: DriveGrid | None = None  # the grid to drive by, once it is looked at for this goal
        self._follower: PathFollower | None = None
        self._docking: Docking | None = None
        self._stood_odom: list[Array] = []  # [4, 4] places of this run
        self._begun_ns = self._last_ns = 0
        self._driven_m = 0.0
        self._no_way, self._first_m = "", 0.0  # why the newest grid has no route, and how long the first one was
        self._hindered: tuple[str, int] | None = None  # why it stands, and since when
        self._still_ns = 0  # since when it stands at the goal
        self._searched_rad = 0.0

    @property
    def is_over(self) -> bool:
        """Whether no goal is left."""
        return not self._goals

    @property
    def hindrance(self) -> str:
        """Why the cart stands now; empty: it drives."""
        return "" if self._hindered is None else self._hindered[0]

    def add(self, goal: Goal) -> None:
        """Take one more goal."""
        self._goals.append(goal)

    def see(self, grid: DriveGrid) -> None:
        """Take the map as it is now."""
        self._grid, self._ground = grid, None

    def command(self, pose: PublishedPose | None, now_ns: int) -> tuple[float, float]:
        """Return speed and turn rate to ask of the wheels now; call it some ten times a second and more."""
        if not self._goals:
            return 0.0, 0.0
        self._begun_ns = self._begun_ns or now_ns
        if now_ns - self._begun_ns > (_LONGEST_S + _LONGEST_S_PER_M * self._first_m) * _NS:
            self.end(f"it took too long, {self.hindrance or 'though nothing was in the way'}", now_ns)
            return 0.0, 0.0
        since_s, self._last_ns = (now_ns - (self._last_ns or now_ns)) / _NS, now_ns
        doubt = doubt_of(pose, now_ns)
        if doubt or pose is None:
            return self._stand(doubt, now_ns)
        self._driven_m += abs(float(pose.velocity_m_s[0])) * since_s
        self._remember(pose)
        if Health.NOT_IN_MAP in pose.health:
            return self._search(since_s, now_ns)
        self._searched_rad = 0.0
        if self._grid is None:
            return self._stand("there is no map yet", now_ns)
        return self._drive(pose, now_ns)

    def end(self, reason: str, now_ns: int, off: tuple[float, float] = (math.nan, math.nan)) -> None:
        """End the goal that is driven to: `reason` it was not reached for, empty where it was."""
        took_s = (now_ns - self._begun_ns) / _NS
        self.arrivals.append(Arrival(self._goals.popleft(), reason, now_ns, took_s, self._driven_m, *off))
        self._ground = self._follower = self._docking = self._hindered = None
        self._begun_ns, self._driven_m, self._first_m, self._still_ns = now_ns, 0.0, 0.0, 0

    def _stand(self, reason: str, now_ns: int) -> tuple[float, float]:
        """Return what stops the cart; give the goal up when it has stood for long."""
        since_ns = now_ns if self._hindered is None else self._hindered[1]
        self._hindered = reason, since_ns
        if now_ns - since_ns > _PATIENCE_S * _NS:
            self.end(reason, now_ns)
        return 0.0, 0.0

    def _search(self, since_s: float, now_ns: int) -> tuple[float, float]:
        """Return what turns the cart until it is found in the map."""
        if self._searched_rad > _SEARCH_RAD:
            return self._stand("the cart was not found in the map", now_ns)
        self._ground = self._follower = self._docking = self._hindered = None
        self._searched_rad += _SEARCH_RAD_S * since_s
        return 0.0, _SEARCH_RAD_S

    def _remember(self, pose: PublishedPose) -> None:
        """Keep where the cart stands: there the ground is free, whether the camera saw it or not."""
        T = pose.T_odom_base
        if not self._stood_odom or np.linalg.norm(T[:2, 3] - self._stood_odom[-1][:2, 3]) > _TRAIL_M:
            self._stood_odom.append(T.copy())
            del self._stood_odom[1 : len(self._stood_odom) - _TRAIL]

    def _drive(self, pose: PublishedPose, now_ns: int) -> tuple[float, float]:
        """Return speed and rate of a cart that knows where it is."""
        then = pose.predict(max(now_ns, pose.t_ns) + _ANSWER_NS).T_map_base
        x, y, yaw = float(then[0, 3]), float(then[1, 3]), math.atan2(then[1, 0], then[0, 0])
        if self._ground is None:
            self._no_way = self._look(pose, x, y)
        if self._no_way:
            return self._stand(self._no_way, now_ns)
        goal, away_m = self._goals[0], self._away_m(x, y)
        if away_m < _DOCK_M and self._docking is None and self._is_clear(x, y):
            self._docking = Docking(goal.x_m, goal.y_m, goal.yaw_rad, self._limits)
        if self._docking is not None:
            if away_m < 2.0 * _DOCK_M and self._is_clear(x, y):
                return self._dock(self._docking, pose, (x, y, yaw), now_ns)
            self._docking = self._ground = self._follower = None
            return 0.0, 0.0
        return self._follow(x, y, yaw, now_ns)

    def _follow(self, x: float, y: float, yaw: float, now_ns: int) -> tuple[float, float]:
        """Return speed and rate along the route."""
        follower, free_m = self._follower, self._seen_m()
        assert follower is not None, "`_look` found a way"
        speed, rate, is_done = follower.command(x, y, yaw, free_m)
        if is_done:  # though it is not near the goal: the map was moved meanwhile
            self._ground = self._follower = None
            return 0.0, 0.0
        if speed == 0.0 and rate == 0.0:
            return self._stand("the ground ahead is not seen", now_ns)
        return self._unless_it_touches(x, y, yaw, speed, rate, now_ns)

    def _dock(
        self, docking: Docking, pose: PublishedPose, at: tuple[float, float, float], now_ns: int
    ) -> tuple[float, float]:
        """Return speed and rate onto the goal; note that it is reached."""
        goal, here = self._goals[0], pose.T_map_base
        is_still = abs(pose.velocity_m_s[0]) < _STILL_M_S and abs(pose.rate_rad_s[2]) < _STILL_RAD_S
        self._still_ns = (self._still_ns or now_ns) if is_still else 0
        off_m = math.hypot(goal.x_m - here[0, 3], goal.y_m - here[1, 3])
        off_rad = abs(wrapped(goal.yaw_rad - math.atan2(here[1, 0], here[0, 0])))
        speed, rate = docking.command(*at)
        if is_still and now_ns - self._still_ns > _STILL_S * _NS:
            if off_m < REACHED_M and off_rad < REACHED_RAD:
                self.end("", now_ns, (off_m, off_rad))
                return 0.0, 0.0
            if off_m >= REACHED_M and speed == 0.0:
                docking.again()
        return self._unless_it_touches(*at, speed, rate, now_ns)

    def _look(self, pose: PublishedPose, x: float, y: float) -> str:
        """Look at the newest grid: keep the route, change it, or return why there is none."""
        assert self._grid is not None
        goal = np.array([self._goals[0].x_m, self._goals[0].y_m])
        stood = np.array([(pose.T_map_odom @ T)[:2, 3] for T in self._stood_odom])
        radius_m = np.full(len(stood), self._grid.turning_radius_m)
        radius_m[0] = _PUT_M
        here = np.array([x, y])
        grid = ground(self._grid, np.stack([here, goal]), np.column_stack([stood, radius_m]))
        found = plan(grid, here, goal, self._explores)
        old, self._ground = self._follower, grid
        if isinstance(found, str):
            self._follower = None
            return found
        if old is None or not self._is_open(old) or found.length_m < _SHORTER * _length_m(old.left):
            self._follower = PathFollower.of_corners(found.corners_m, self._limits)
        self._first_m = self._first_m or found.length_m
        return ""

    def _is_open(self, follower: PathFollower) -> bool:
        """Return whether the cart still fits along the way left."""
        grid, left = self._ground, follower.left
        assert grid is not None
        rows, columns = grid.cells_at(left)
        needed_m = 0.5 * min(grid.body_m) + grid.resolution_m
        return bool((rows >= 0).all() and (grid.clearance_m[rows, columns] >= needed_m).all())

    def _seen_m(self) -> float:
        """Return on how much of the way left the cart has to stop, for what comes then was not seen."""
        if self._follower is None or self._ground is None:
            return 0.0
        left = self._follower.left
        unseen = np.flatnonzero(self._ground.state_at(left) != Drive.FREE)
        if len(unseen) == 0:
            return math.inf
        seen_m = _length_m(left[: unseen[0] + 1])
        return max(seen_m - _SEE_M, _CREEP_M if seen_m > _CREPT_M else 0.0)

    def _unless_it_touches(
        self, x: float, y: float, yaw: float, speed: float, rate: float, now_ns: int
    ) -> tuple[float, float]:
        """Return speed and rate; none of a turn on the spot by which the body would come to touch something."""
        if speed == 0.0 and rate != 0.0 and self._ground is not None:
            yaws = yaw + math.copysign(_TURN_RAD, rate) * np.linspace(0.0, 1.0, 4)
            fits = self._ground.is_traversable(np.tile([x, y], (len(yaws), 1)), yaws)
            if fits[0] and not fits.all():  # where it touches something already, by the map, turning may be the way out
                return self._stand("there is no room to turn", now_ns)
        self._hindered = None
        return speed, rate

    def _is_clear(self, x: float, y: float) -> bool:
        """Return whether the cart can drive straight onto the goal."""
        grid, goal = self._ground, self._goals[0]
        if grid is None:
            return True  # until the next look
        clearance = grid.line_clearance_m(np.array([x, y]), np.array([goal.x_m, goal.y_m]))[0]
        return bool(clearance >= 0.5 * min(grid.body_m))

    def _away_m(self, x: float, y: float) -> float:
        return math.hypot(self._goals[0].x_m - x, self._goals[0].y_m - y)


def _length_m(line: Array) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def doubt_of(pose: PublishedPose | None, now_ns: int) -> str:
    """Return why a pose is not to be driven by; empty where it is."""
    if pose is None:
        return "there is no pose"
    if now_ns - pose.t_ns > _STALE_NS:
        return "the pose is stale"
    if Health.INVALID in pose.health or Health.LEVELLED not in pose.health:
        return "the pose is not valid"
    return ""
