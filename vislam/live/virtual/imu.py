"""The virtual cart's GY-85: the real driver, through the real smbus2, against emulated chips. Loads no OpenCV.

Or behind the serial bridge: a process is the board, on a pseudo-terminal, and the real bridge and pyserial read it.
"""

import math
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

from vislam.config import Gy85Config, SensorsConfig
from vislam.core.errors import HardwareError
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.emulator import BridgeEmulator, LineFaults, SteppedClock, Truth, emulated_bus, emulated_gy85, gy85_errors
from vislam.hw.gy85 import Gy85
from vislam.hw.imu_source import InertialSource
from vislam.hw.sensors import open_inertial
from vislam.hw.timing import Clock, HostClock
from vislam.live.epoch import Epoch
from vislam.live.processes.child import Life
from vislam.live.virtual.motion import SEGMENT_S, Drive, Follower

_NS = 1_000_000_000
_FIELD_UT = (18.2, -10.5, -43.0)  # central Europe, z up
_WARM_C = 25.0
_DRIFT = 0.003  # of the board's clock: an Arduino's resonator is good to 0.005
_PLUGGED_S = 60.0  # that the port is waited for
_POLL_S = 0.005
_CLOSING_S = 30.0  # that the port's reader may take to end


class VirtualGy85(Gy85):
    """A GY-85 on a cart; unplugged in each of `outages`."""

    def __init__(
        self, cart: Drive | Follower, begin_ns: Callable[[], int], config: Gy85Config, seed: int, gravity_m_s2: float,
        outages: tuple[tuple[float, float], ...] = (), stepped: SteppedClock | None = None,
    ) -> None:  # fmt: skip
        """Put a board on a cart, and open it with the driver.

        Args:
            cart: its motion.
            begin_ns: when that begins; 0 while it is not known, and the cart stands.
            config: of the driver.
            seed: of errors and noise.
            gravity_m_s2: where it drives.
            outages: s since the beginning, from and to: unplugged.
            stepped: the clock of a simulation that takes no time; None: that of the host.
        """
        self._begin_ns, self._outages = begin_ns, _Outages(outages)
        clock: Clock = HostClock() if stepped is None else stepped
        truth = _truth(cart, begin_ns, gravity_m_s2)
        self._board = emulated_gy85(truth, clock.now_ns, seed, path=config.bus, stepped=stepped)
        self._is_plugged = True
        self._stack = ExitStack()
        self._stack.enter_context(emulated_bus(self._board))
        super().__init__(config, clock)

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what the driver reads."""
        plugged = not self._outages.is_out(self._clock.now_ns() - self._begin_ns())
        if plugged != self._is_plugged:
            self._is_plugged = plugged
            (self._board.replug if plugged else self._board.unplug)()
        return super().read(timeout_s)

    def close(self) -> None:
        """Give the board back."""
        super().close()
        self._stack.close()


def run_board(
    life: Life, port: Path, cart: str, epoch: Epoch, gravity_m_s2: float, seed: int,
    outages: tuple[tuple[float, float], ...], faults: tuple[str, ...],
) -> None:  # fmt: skip
    """Be the serial bridge's board on the cart until the run ends; `port` is a link to its pseudo-terminal.

    In each of `outages` it is `unplugged`, or has the fault of that name in `LineFaults`: one of `faults` in turn.
    """
    truth = _truth(Follower.waiting(cart), epoch.peek_ns, gravity_m_s2)
    with BridgeEmulator(port, truth, seed, _DRIFT, gy85_errors(seed)) as board:
        if not life.ready():
            return
        begin_ns, spans = epoch.begin_ns(), _Outages(outages)
        while not life.stopped:
            is_out = spans.is_out(time.monotonic_ns() - begin_ns)
            fault = faults[(spans.count - 1) % len(faults)] if is_out else ""
            board.faults = replace(LineFaults(), **({fault: True} if fault not in ("", "unplugged") else {}))
            (board.unplug if fault == "unplugged" else board.plug)()
            time.sleep(_POLL_S)
        board.await_closing(_CLOSING_S)  # or the reader, which may see the end later, would count a lost port


def open_board(port: Path) -> InertialSource:
    """Open the port of `run_board`, once it is there and sends; raises HardwareError as for a real one."""
    deadline = time.monotonic() + _PLUGGED_S
    while time.monotonic() < deadline:  # its process may be put aside for longer than a board is silent
        with suppress(HardwareError):
            return open_inertial(f"serial:{port}", SensorsConfig())
        time.sleep(_POLL_S)
    return open_inertial(f"serial:{port}", SensorsConfig())


def open_gy85(
    cart: str, epoch: Epoch, config: Gy85Config, seed: int, gravity_m_s2: float,
    outages: tuple[tuple[float, float], ...],
) -> VirtualGy85:  # fmt: skip
    """Open the board of a cart whose segments are published under a name, see `VirtualGy85`."""
    return VirtualGy85(Follower.waiting(cart), epoch.peek_ns, config, seed, gravity_m_s2, outages)


class _Outages:
    """Spans since the beginning, one after the other; what was slept through comes late and is as long."""

    def __init__(self, spans_s: tuple[tuple[float, float], ...]) -> None:
        self.count = 0  # of those that have begun
        self._left, self._until_s = sorted(spans_s), -math.inf

    def is_out(self, since_ns: int) -> bool:
        since_s = since_ns / _NS
        if since_s >= self._until_s and self._left and since_s >= self._left[0][0]:
            begin, end = self._left.pop(0)
            self._until_s, self.count = since_s + end - begin, self.count + 1
        return since_s < self._until_s


def _truth(cart: Drive | Follower, begin_ns: Callable[[], int], gravity_m_s2: float) -> Truth:
    """Return what chips on the cart sense at a time: a body above the middle of the axle, level."""

    def at(t_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], float]:
        zero_ns = begin_ns()
        since_s = -1.0 if zero_ns == 0 else (t_ns - zero_ns) * 1e-9
        s = cart.segment(since_s)
        beyond = max(since_s - s.t_s - SEGMENT_S, 0.0)
        dt = max(since_s - s.t_s, 0.0) - beyond
        speed, rate = s.speed_m_s + s.accel_m_s2 * dt, s.rate_rad_s + s.angular_accel_rad_s2 * dt
        yaw = s.yaw_rad + dt * (s.rate_rad_s + 0.5 * s.angular_accel_rad_s2 * dt) + rate * beyond
        c, n = math.cos(yaw), math.sin(yaw)
        accel = s.accel_m_s2 if since_s > 0.0 and beyond == 0.0 else 0.0
        field = (c * _FIELD_UT[0] + n * _FIELD_UT[1], c * _FIELD_UT[1] - n * _FIELD_UT[0], _FIELD_UT[2])
        return (0.0, 0.0, rate), (accel, speed * rate, gravity_m_s2), field, _WARM_C

    return at
