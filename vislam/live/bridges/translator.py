"""The published pose on other wires: each translator is a process of its own that listens as any controller does."""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from multiprocessing.connection import Connection
from typing import Protocol

import numpy as np

from vislam.config import LiveConfig
from vislam.core.errors import UsageError, install_line
from vislam.core.messages import Array
from vislam.live.notices import MapCells
from vislam.live.processes.child import Life
from vislam.live.wire.mail import Inbox
from vislam.live.wire.published_pose import PublishedPose
from vislam.live.wire.publisher import PoseListener, send_address, socket_path

_LISTEN_S = 0.1  # after which the end of the run is looked for
_DOMAINS = 233  # of DDS, as many as its port numbers leave room for


class Wire(Protocol):
    """A translator and where it sends to."""

    def send(self, pose: PublishedPose) -> None:
        """Send the pose in the translator's format."""
        ...

    def see(self, cells: MapCells) -> None:
        """Take the map as it is now; only who is given a wire of it is called."""
        ...

    def close(self) -> None:
        """Let go of everything; may be called twice."""
        ...


def asked(
    live: LiveConfig, T_body_cams: tuple[Array, ...] = (), maps: Connection | None = None
) -> dict[str, tuple[str, Callable[[Life], None]]]:
    """Return the translators that are asked for, by role: where each listens, and its process's body.

    ROS 2 gets the frames of the cameras, at `T_body_cam` [4, 4] each, and the map, of which `maps` brings `MapCells`.

    Raises UsageError: a package is not installed, or a domain, address or rate that is none.
    """
    if live.ros2_domain is None and live.mavlink is None:
        return {}
    if not live.bridge_rate_hz > 0.0:
        raise UsageError(f"--live.bridge-rate-hz {live.bridge_rate_hz:g}: messages a second must be more than 0")
    wires: dict[str, Callable[[], Wire]] = {}
    if live.ros2_domain is not None:
        _require("cyclonedds", "ros2", "--live.ros2-domain")
        if not 0 <= live.ros2_domain < _DOMAINS:
            raise UsageError(f"--live.ros2-domain {live.ros2_domain}: DDS has domains 0 to {_DOMAINS - 1}")
        wires["ros2"] = partial(_open_ros2, live.ros2_domain, sensor_frames(live, T_body_cams), live.allow_remote)
    if live.mavlink is not None:
        _require("pymavlink", "mavlink", "--live.mavlink")
        send_address(live.mavlink, live.name, live.allow_remote)
        wires["mavlink"] = partial(_open_mavlink, live.mavlink, live.name, live.allow_remote)
    return {role: _bridge(role, open_wire, live, maps if role == "ros2" else None) for role, open_wire in wires.items()}


def _bridge(
    role: str, open_wire: Callable[[], Wire], live: LiveConfig, maps: Connection | None
) -> tuple[str, Callable[[Life], None]]:
    at = f"unix:{socket_path(f'{live.name}-{role}')}"
    return at, partial(run, at=at, rate_hz=live.bridge_rate_hz, open_wire=open_wire, maps=maps)


def run(life: Life, at: str, rate_hz: float, open_wire: Callable[[], Wire], maps: Connection | None = None) -> None:
    """Translate poses until the run ends.

    Args:
        life: of this process.
        at: where to listen.
        rate_hz: poses beyond this rate are left out.
        open_wire: opens the translator, in this process.
        maps: from the map process; None: it gets none.
    """
    period_ns, due_ns, sent = round(1e9 / rate_hz), 0, 0
    listener = PoseListener(at)
    try:
        wire = open_wire()
        try:
            if not life.ready():
                return
            inbox = None if maps is None else Inbox(maps)
            while not life.stopped:
                if inbox is not None and (cells := inbox.get()) is not None:
                    wire.see(cells)
                pose = listener.next(_LISTEN_S)
                if pose is None or pose.published_ns < due_ns:
                    continue
                due_ns += period_ns
                if due_ns <= pose.published_ns:  # the first, or poses came slower
                    due_ns = pose.published_ns + period_ns
                wire.send(pose)
                sent += 1
            life.note(sent=sent)
        finally:
            wire.close()
    finally:
        listener.close()


def _require(package: str, extra: str, option: str) -> None:
    if find_spec(package) is None:
        raise UsageError(f"{option} needs {package}; install it: {install_line(extra)}")


def sensor_frames(live: LiveConfig, T_body_cams: tuple[Array, ...]) -> dict[str, Array]:
    """Return `T_base_sensor` [4, 4] by ROS's names of frames: optical ones have z ahead (REP-103)."""
    T_base_body = np.eye(4)
    T_base_body[:3, 3] = -np.asarray(live.base_offset_m)
    cameras = {f"cam{k}_optical": T_base_body @ T for k, T in enumerate(T_body_cams)}
    return {"imu_link": T_base_body, **cameras}


def _open_ros2(domain: int, sensors: dict[str, Array], allow_remote: bool) -> Wire:
    from vislam.live.bridges.ros2 import Ros2

    return Ros2(domain, sensors, allow_remote)


def _open_mavlink(to: str, name: str, allow_remote: bool) -> Wire:
    from vislam.live.bridges.mavlink import Mavlink

    return Mavlink(to, name, allow_remote)
