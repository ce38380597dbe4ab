"""A camera that sees nothing, or is silent: keyframes have to go on, for readings of further sensors hang on them."""

from dataclasses import replace
from enum import StrEnum

import numpy as np

from vislam.core.camera import Rig
from vislam.core.messages import Frame, Keyframe, KeyframePacket, NavState, Tracking, VoMeasurement, chosen

_PATIENCE_NS = 5_000_000_000  # without sight; until then the camera may find the last keyframe again
_EVERY_NS = 1_000_000_000  # from then on
_SLACK_NS = 50_000_000  # frames do not come to the millisecond
_LOOK_NS = 100_000_000  # without a camera: between two poses of the trajectories, and two looks whether the body rests


class Sight(StrEnum):
    """What a camera sees, in the order in which a dark place is entered; any frame that is placed leads to SEEING."""

    SEEING = "seeing"
    LOST = "lost"  # for so short that the last keyframe may be found again
    DARK = "dark"  # keyframes come by time alone


class Waypoints:
    """Decides when a frame without sight is to be a keyframe: often enough for the path between two by inertial data.

    Often enough also for the memory of these data, which is `imu.buffer_s`. Only as long as the filter knows where the
    body is: what its sensors leave in doubt is for loops to join, as after any loss of sight. Without a camera it is
    dark from the start, and keyframes always go on.

    Attributes:
        sight: now.
    """

    def __init__(self) -> None:
        """Start before the first frame."""
        self.sight = Sight.SEEING
        self._since_ns: int | None = None  # the last frame that was placed, or waypoint; None: no frame yet
        self._ends = False  # whether sight is back since `marked`

    def wants(self, vo: VoMeasurement, is_keyframe: bool) -> bool:
        """Take note of a frame; return whether it is time for a keyframe, though vision gives none."""
        since_ns, is_blind = self._since_ns, vo.tracking is Tracking.BLIND
        if vo.tracking.sees or is_keyframe or (since_ns is None and not is_blind):
            self._ends = self._ends or self.sight is Sight.DARK
            self.sight, self._since_ns = Sight.DARK if is_blind else Sight.SEEING, vo.t_ns
            return False
        patience_ns = (_EVERY_NS if self.sight is Sight.DARK else _PATIENCE_NS) - _SLACK_NS
        if since_ns is not None and vo.t_ns - since_ns < patience_ns:
            self.sight = Sight.LOST if self.sight is Sight.SEEING else self.sight
            return False
        self.sight, self._since_ns = Sight.DARK, vo.t_ns
        return True

    def marked(self, packet: KeyframePacket, state: NavState | None) -> KeyframePacket:
        """Return a keyframe's packet, with the filter's `state` there if it is the first with sight after waypoints."""
        ends, self._ends = self._ends, False
        return replace(packet, state_at_sight=state) if ends else packet


class SilentCamera:
    """Stands in for a camera that is silent: frames in which it is dark, so that all goes on as for a covered one.

    Where there is no camera, the frames are empty and come with the IMU from its first sample on.

    Attributes:
        is_all: whether there is no camera, and all frames are put in.
        frames: that were put in.
    """

    def __init__(self, rig: Rig) -> None:
        """Start before the first frame."""
        self.is_all = rig.is_blind
        self.frames = 0
        self._last: Frame | None = None  # of the camera
        self._newest_ns = 0  # dark ones included
        self._patience_ns, self._every_ns = (0, _LOOK_NS) if self.is_all else (_PATIENCE_NS, _EVERY_NS)

    def see(self, frame: Frame) -> None:
        """Take a frame of the camera."""
        self._last, self._newest_ns = frame, frame.t_ns

    def go_on(self, t_ns: int) -> None:
        """Go on after the frame of a time, where an earlier run ended; without a camera its frame was one of these."""
        if self.is_all:
            self.see(Frame(t_ns, 0, ()))

    def stand_in(self, t_ns: int, has_begun: bool = True) -> list[Frame]:
        """Return the dark frame that is due at a time, a nanosecond before it, if there is one.

        The camera's own next frame has that time, or a later one. Before a run `has_begun` a camera is waited for.
        """
        if not (has_begun or self.is_all):
            return []
        if self.is_all and self._last is None:
            self.see(Frame(t_ns, 0, ()))
        last = self._last
        if last is None or t_ns - last.t_ns < self._patience_ns or t_ns - self._newest_ns < self._every_ns:
            return []
        self._newest_ns = t_ns - 1
        self.frames += 1
        return [dark(last, self._newest_ns)]


def unseen_keyframe(keyframe_id: int, frame: Frame) -> Keyframe:
    """Return a keyframe in which nothing is to be recognised."""
    return Keyframe(keyframe_id, frame.t_ns, frame, np.empty((0, 2)), np.empty((0, 32), np.uint8), None)


def dark(frame: Frame, t_ns: int) -> Frame:
    """Return a frame like another in which nothing is seen."""
    tracks = frame.tracks
    if tracks is not None:
        tracks = replace(chosen(tracks, np.zeros(len(tracks.track_ids), dtype=np.bool_)), further=())
    return Frame(
        t_ns, frame.index, tuple(np.zeros_like(image) for image in frame.images),
        None if frame.color is None else np.zeros_like(frame.color),
        None if frame.depth_m is None else np.zeros_like(frame.depth_m), tracks,
    )  # fmt: skip
