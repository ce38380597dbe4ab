"""The virtual cart's GY-85: the real driver, through the real smbus2, against emulated chips. Loads no OpenCV.

Or behind the serial bridge: a process is the board, on a pseudo-terminal, and the real bridge and pyserial read it.
"""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from vislam.config import Gy85Config, SensorsConfig
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.emulator import BridgeEmulator, LineFaults, Truth, emulated_bus, emulated_gy85, gy85_errors
from vislam.hw.gy85 import Gy85
from vislam.hw.health import Health
from vislam.hw.sensors import open_inertial
from vislam.hw.source import InertialSource
from vislam.live.epoch import Epoch
from vislam.live.processes.child import Life
from vislam.live.virtual.motion import Follower

_NS = 1_000_000_000
_FIELD_UT = (18.2, -10.5, -43.0)  # central Europe, z up
_WARM_C = 25.0
_DRIFT = 0.003  # of the board's clock: an Arduino's resonator is good to 0.005
_PLUGGED_S = 60.0  # that the port is waited for
_POLL_S = 0.005


class VirtualGy85:
    """Satisfies `InertialSource`; unplugged in each of `outages`."""

    def __init__(
        self, cart: str, epoch: Epoch, config: Gy85Config, seed: int, gravity_m_s2: float,
        outages: tuple[tuple[float, float], ...] = (),
    ) -> None:  # fmt: skip
        """Put a board on the cart whose segments are published under a name, and open it with the driver."""
        self._epoch, self._outages = epoch, outages
        self._stack = ExitStack()
        truth = _truth(Follower.waiting(cart), epoch, gravity_m_s2)
        self._board = emulated_gy85(truth, time.monotonic_ns, seed, path=config.bus)
        self._is_plugged = True
        self._stack.enter_context(emulated_bus(self._board))
        self._driver = Gy85(config)
        self._stack.callback(self._driver.close)
        self.rate_hz = self._driver.rate_hz

    @property
    def temperature_c(self) -> float | None:
        """That of the driver."""
        return self._driver.temperature_c

    def zeroed_at(self, temperature_c: float, gyro_per_c: Array) -> None:
        """Pass the zero on to the driver."""
        self._driver.zeroed_at(temperature_c, gyro_per_c)

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what the driver reads."""
        plugged = not _is_within(self._outages, self._epoch.begin_ns())
        if plugged != self._is_plugged:
            self._is_plugged = plugged
            (self._board.replug if plugged else self._board.unplug)()
        return self._driver.read(timeout_s)

    def health(self) -> Health:
        """Return that of the driver."""
        return self._driver.health()

    def counters(self) -> dict[str, int]:
        """Return those of the driver."""
        return self._driver.counters()

    def close(self) -> None:
        """Give the board back."""
        self._stack.close()


def run_board(
    life: Life, port: Path, cart: str, epoch: Epoch, gravity_m_s2: float, seed: int,
    outages: tuple[tuple[float, float], ...], fault: str,
) -> None:  # fmt: skip
    """Be the serial bridge's board on the cart until the run ends; `port` is a link to its pseudo-terminal.

    In each of `outages` it is `unplugged`, or has the fault of that name in `LineFaults`.
    """
    truth = _truth(Follower.waiting(cart), epoch, gravity_m_s2)
    with BridgeEmulator(port, truth, seed, _DRIFT, gy85_errors(seed)) as board:
        if not life.ready():
            return
        begin_ns = epoch.begin_ns()
        while not life.stopped:
            is_out = _is_within(outages, begin_ns)
            if fault != "unplugged":
                board.faults = replace(LineFaults(), **{fault: is_out})
            elif is_out:
                board.unplug()
            else:
                board.plug()
            time.sleep(_POLL_S)


def open_board(port: Path) -> InertialSource:
    """Open the port of `run_board`, once it is there; raises HardwareError as for a real one."""
    deadline = time.monotonic() + _PLUGGED_S
    while not port.exists() and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    return open_inertial(f"serial:{port}", SensorsConfig())


def _is_within(spans_s: tuple[tuple[float, float], ...], begin_ns: int) -> bool:
    """Return whether it is now within one of some spans since a beginning."""
    since_s = (time.monotonic_ns() - begin_ns) / _NS
    return any(begin <= since_s < end for begin, end in spans_s)


def _truth(cart: Follower, epoch: Epoch, gravity_m_s2: float) -> Truth:
    """Return what chips on the cart sense at a time: a body above the middle of the axle, level."""
    begin_ns = epoch.peek_ns  # the cart stands until the epoch is known

    def at(t_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
        zero_ns = begin_ns()
        since_s = -1.0 if zero_ns == 0 else (t_ns - zero_ns) * 1e-9
        s = cart.segment(since_s)
        dt = max(since_s - s.t_s, 0.0)
        speed, rate = s.speed_m_s + s.accel_m_s2 * dt, s.rate_rad_s + s.angular_accel_rad_s2 * dt
        yaw = s.yaw_rad + dt * (s.rate_rad_s + 0.5 * s.angular_accel_rad_s2 * dt)
        c, n = math.cos(yaw), math.sin(yaw)
        accel = s.accel_m_s2 if since_s > 0.0 else 0.0
        field = (c * _FIELD_UT[0] + n * _FIELD_UT[1], c * _FIELD_UT[1] - n * _FIELD_UT[0], _FIELD_UT[2])
        return (0.0, 0.0, rate), (accel, speed * rate, gravity_m_s2), field, _WARM_C

    return at
