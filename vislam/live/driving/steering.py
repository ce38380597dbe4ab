"""The driver in a live run: a process that hears the published pose as any controller does, and commands the wheels."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

import numpy as np

from vislam.config import LiveConfig
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array
from vislam.hw.health import Health
from vislam.live.bridges import translator
from vislam.live.driving.driver import Driver, doubt_of
from vislam.live.driving.orders import Goal, Place
from vislam.live.driving.pursuit import Limits
from vislam.live.notices import MapCells
from vislam.live.processes.child import Life
from vislam.live.virtual.pilot import WATCHDOG_S, CommandWriter
from vislam.live.wire.published_pose import PublishedPose
from vislam.live.wire.publisher import socket_path
from vislam.mapping.drive.drive_grid import DriveGrid, distance_cells

if TYPE_CHECKING:
    from vislam.live.bridges.ros2_orders import Ros2Orders


_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Armed:
    """What a cart is armed for.

    Attributes:
        goals: to drive to, one after another.
        limits: of speed and turn.
        explores: over ground that was not seen, too.
        command_name: of the shared memory that its wheels are commanded by.
        listens: to goal_pose and cmd_vel of ROS 2, in the domain of the run.
    """

    goals: tuple[Goal, ...]
    limits: Limits
    explores: bool
    command_name: str
    listens: bool = False


def listening_at(live: LiveConfig) -> str:
    """Return where the driver's process listens to poses, for `live.send_to`."""
    return f"unix:{socket_path(f'{live.name}-drive')}"


def run(life: Life, armed: Armed, live: LiveConfig, maps: Connection, guesses: Connection) -> None:
    """Drive until the run ends; `maps` brings `MapCells`, `guesses` takes where the body is, `T_map_body` [4, 4]."""
    _rehearse()
    open_wire = partial(Steering, armed, live, life.note, guesses.send)
    translator.run(life, listening_at(live), live.bridge_rate_hz, open_wire, maps)


class Steering:
    """Satisfies `Wire`: what comes is poses and maps, what leaves is commands for the wheels."""

    def __init__(
        self, armed: Armed, live: LiveConfig, note: Callable[..., None], guess: Callable[[Array], None]
    ) -> None:
        """Take the wheels.

        Args:
            armed: what the cart may do.
            live: of the run.
            note: takes, by name, what a person is to see.
            guess: takes where a user thinks that the body is, `T_map_body` [4, 4].

        Raises StorageError when the memory of the wheels' commands cannot be made.
        """
        self._armed, self._note, self._guess = armed, note, guess
        self._T_base_body = np.eye(4)
        self._T_base_body[:3, 3] = -np.asarray(live.base_offset_m)
        self._driver = Driver([*armed.goals], armed.limits, armed.explores)
        self._wheels = CommandWriter(armed.command_name)
        self._orders: Ros2Orders | None = None
        if armed.listens and live.ros2_domain is not None:
            from vislam.live.bridges.ros2_orders import Ros2Orders

            self._orders = Ros2Orders(live.ros2_domain, live.allow_remote)
        self._steered: tuple[float, float] = (0.0, 0.0)  # by a cmd_vel ...
        self._steered_until_ns = 0  # ... which is good so long
        self._noted: object = None

    def see(self, cells: MapCells) -> None:
        """Take the map as it is now."""
        self._driver.see(grid_of(cells))

    def send(self, pose: PublishedPose) -> None:
        """Command the wheels by a pose that has just come."""
        now_ns = time.monotonic_ns()
        if self._orders is not None:
            self._obey(self._orders, now_ns)
        if now_ns < self._steered_until_ns:
            self._wheels.command(*((0.0, 0.0) if doubt_of(pose, now_ns) else self._steered))
        else:
            self._wheels.command(*self._driver.command(pose, now_ns))
        told = len(self._driver.arrivals), self._driver.hindrance, self._driver.is_over
        if told != self._noted:
            self._noted = told
            self._note(
                arrivals=list(self._driver.arrivals), hindrance=self._driver.hindrance, is_over=self._driver.is_over
            )

    def close(self) -> None:
        """Let the wheels go, which stops them; may be called twice."""
        self._wheels.close()
        if self._orders is not None:
            self._orders.close()

    def _obey(self, orders: Ros2Orders, now_ns: int) -> None:
        """Take what ROS 2 asks for: a goal takes the place of all before, and so does a twist while it is repeated."""
        order = orders.take()
        if order is None:
            return
        if isinstance(order, Place):
            turned = so3_exp(np.array([0.0, 0.0, order.yaw_rad]))
            with suppress(OSError):  # the back process has ended
                self._guess(transform(turned, np.array(order.position_m)) @ self._T_base_body)
            return
        while not self._driver.is_over:
            self._driver.end("something else was asked for", now_ns)
        if isinstance(order, Goal):
            self._driver.add(order)
            self._steered_until_ns = 0
            return
        speed, rate = self._armed.limits.speed_m_s, self._armed.limits.rate_rad_s
        self._steered = min(max(order.speed_m_s, -speed), speed), min(max(order.rate_rad_s, -rate), rate)
        self._steered_until_ns = now_ns + round(WATCHDOG_S * _NS)


def grid_of(cells: MapCells) -> DriveGrid:
    """Return the drive grid that the map process handed on, without heights and slopes."""
    unknown = np.full(cells.states.shape, np.nan, np.float32)
    clearance_m = distance_cells(cells.states > 0) * np.float32(cells.resolution_m)
    return DriveGrid(
        cells.states, unknown, unknown, clearance_m, cells.resolution_m, cells.origin_m, cells.floor_m, cells.body_m
    )


def _rehearse() -> None:
    """Compile what driving needs, before a cart waits for it."""
    states = np.zeros((80, 80), np.int8)
    states[40:50, 60:] = 1
    driver = Driver([Goal(2.0, 0.5, 0.0)], Limits())
    driver.see(grid_of(MapCells(states, 0.05, (-1.0, -1.0), 0.0, (0.6, 0.5))))
    still, none, here = np.zeros(3), np.zeros((6, 6)), np.eye(4)
    for k in range(1, 4):
        health = Health.LEVELLED | Health.VISION_OK
        driver.command(PublishedPose(k, k, k, health, here, still, still, none, none, here, 0, 0, 0.0), k)
