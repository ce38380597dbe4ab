"""Keyframes of a camera that sees nothing: readings of further sensors in the graph hang on those around them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.core.messages import Array, Frame, Keyframe, KeyframePacket, NavState, Tracking, VoMeasurement

_PATIENCE_S = 5.0  # without sight; until then the camera may find the last keyframe again
_EVERY_S = 1.0  # from then on
_SLACK_S = 0.05  # frames come when they come


def unseen_keyframe(keyframe_id: int, frame: Frame) -> Keyframe:
    """Return a keyframe in which nothing is to be recognised."""
    return Keyframe(keyframe_id, frame.t_ns, frame, np.empty((0, 2)), np.empty((0, 32), np.uint8), None)


class Waypoints:
    """Says when a frame without sight is to be a keyframe: often enough for the path between two by inertial data.

    And for the memory of them, which is `imu.buffer_s`. Only as long as the filter knows where the body is: what its
    sensors leave in doubt is for loops to join, as after any loss of sight.
    """

    def __init__(self) -> None:
        """Start before the first keyframe."""
        self._seen_ns: int | None = None  # the last frame that was placed, or keyframe
        self._newest_ns: int | None = None  # waypoint since then
        self._ends = False  # whether sight is back since `marked`

    def wants(self, vo: VoMeasurement, is_keyframe: bool) -> bool:
        """Take note of a frame; return whether it is time for a keyframe, though vision gives none."""
        if vo.tracking is not Tracking.LOST or is_keyframe or self._seen_ns is None:
            self._ends = self._ends or self._newest_ns is not None
            self._seen_ns, self._newest_ns = vo.t_ns, None
            return False
        since_ns, wait_s = (self._seen_ns, _PATIENCE_S) if self._newest_ns is None else (self._newest_ns, _EVERY_S)
        if (vo.t_ns - since_ns) * 1e-9 < wait_s - _SLACK_S:
            return False
        self._newest_ns = vo.t_ns
        return True

    def marked(self, packet: KeyframePacket, state: NavState | None) -> KeyframePacket:
        """Return a keyframe's packet, with the filter's `state` there if it is the first with sight after waypoints."""
        ends, self._ends = self._ends, False
        return replace(packet, state_at_sight=state) if ends else packet


def surer_gyro_bias(state: NavState, graph: NavState | None, walk: float) -> tuple[Array, float]:
    """Return the gyroscope's bias [3] and its largest sigma, of the filter or of the graph: whoever is surer.

    For what is published only: the graph has seen the same images longer, and the filter stays what it is alone.
    `walk` is that of the bias, in rad/s^2/sqrt(Hz).
    """
    sigma_rad_s = float(np.sqrt(np.diag(state.covariance)[9:12].max()))
    if graph is None:
        return state.gyro_bias_rad_s, sigma_rad_s
    walked = walk**2 * max(state.t_ns - graph.t_ns, 0) * 1e-9
    graph_rad_s = float(np.sqrt(np.diag(graph.covariance)[9:12].max() + walked))
    if graph_rad_s < sigma_rad_s:
        return graph.gyro_bias_rad_s, graph_rad_s
    return state.gyro_bias_rad_s, sigma_rad_s
