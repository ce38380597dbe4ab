"""What further sensors say of motion while the camera is blind goes to the sliding window, not to the graph."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from vislam.core.messages import Array, KeyframePacket, NavState, Tracking
from vislam.core.readings import MotionReadings, OwnNow, PlacedReading
from vislam.sensors import Suite


def with_motions(
    packet: KeyframePacket,
    suite: Suite,
    begun: Iterable[str],
    state: NavState | None,
    own: Callable[[str], tuple[Array, Array]],
) -> KeyframePacket:
    """Return a keyframe's packet, its readings of motion set apart where vision does not tie it to the one before.

    By inertial data alone a window is soon lost. With any sensor of motion among those that have `begun`, the filter's
    `state` goes along. `own` gives values and sigmas [V] of a sensor's own variables, as the filter has them.
    """
    if any(suite[name].sees_motion_only for name in begun):
        packet = replace(packet, filter_state=state)
    if packet.begins_submap or packet.vo.tracking is not Tracking.LOST:
        return packet
    by_sensor: dict[str, list[PlacedReading]] = {}
    rest: list[PlacedReading] = []
    for one in packet.readings:
        name = one.reading.sensor
        (by_sensor.setdefault(name, []) if suite[name].sees_motion_only else rest).append(one)
    motions = (MotionReadings(name, tuple(placed), OwnNow(*own(name))) for name, placed in by_sensor.items())
    return replace(packet, readings=tuple(rest), motions=tuple(motions))
