"""When a frame becomes a keyframe, what a keyframe is made of, and the life of the one that frames are placed by."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.geometry import so3_log, transform_points
from vislam.core.messages import Array, Frame, Keyframe, Observations, no_observations
from vislam.frontend.result import TrackResult, identity_motion, lost_motion
from vislam.vision.features import describe

PATIENCE_S = 0.4  # so long a lost keyframe is searched for before a new one starts
_KEYFRAME_ROTATION_DEG = 15.0  # patches turn with the camera and stop matching
# fraction of the keyframe's tracks that are still followed, and the same where a frame without depth would follow it
_KEYFRAME_MIN_ALIVE, _KEYFRAME_MIN_ALIVE_UNFIT = 0.45, 0.2
_RESTART_KEYFRAMES = 8  # that come as soon as they may after a loss: chances to recognise the place


@dataclass(frozen=True, slots=True)
class Departure:
    """How far a frame has come from its keyframe."""

    dt_s: float
    rotation_rad: float
    parallax_px: float  # median, rotation taken out
    alive: float  # fraction of the keyframe's tracks that are still followed
    inliers: int
    fit: bool  # whether the frame has what a keyframe of this front end needs, such as depth
    restarted: bool = False  # whether tracking was lost a few keyframes ago


def keyframe_reason(departure: Departure, config: FrontEndConfig, spacing: float = 1.0) -> str:
    """Return why the frame should become a keyframe, or an empty string.

    A keyframe costs a little drift and a node in the graph; a late one costs tracks. So distance decides, and time only
    makes sure that the graph hears of a camera that hardly moves. `spacing` widens the distances and times: 1 where
    the back end keeps up.
    """
    least = _KEYFRAME_MIN_ALIVE if departure.fit else _KEYFRAME_MIN_ALIVE_UNFIT
    if departure.alive < least:
        return f"only {departure.alive:.0%} of the tracks left"
    if not departure.fit or departure.dt_s < spacing * config.keyframe_min_interval_s:
        return ""
    if departure.restarted:
        return "one of the first since tracking was lost"
    if departure.inliers < config.keyframe_min_inliers:
        return f"only {departure.inliers} tracks agree"
    turned_deg = float(np.rad2deg(departure.rotation_rad))
    limits = (
        (departure.parallax_px, config.keyframe_parallax_px, f"parallax of {departure.parallax_px:.0f} px"),
        (turned_deg, _KEYFRAME_ROTATION_DEG, f"turned by {turned_deg:.0f} deg"),
        (departure.dt_s, config.keyframe_max_interval_s, f"{departure.dt_s:.1f} s since the last keyframe"),
    )
    return next((reason for value, limit, reason in limits if value >= spacing * limit), "")


MeasureDepth = Callable[[Array, NDArray[np.int64] | None], Array]
"""Gives z-depths [N] in metres of raw pixels [N, 2] and the tracks [N] that they belong to, if any."""


def _as_seen(pixels: Array, depth_m: Array) -> Array:
    return pixels


@dataclass(frozen=True, slots=True, eq=False)
class Exposed:
    """When the rows and the depth of a keyframe were taken, as far as its features ask for it."""

    depth_m: MeasureDepth
    instant_px: Callable[[Array, Array], Array] = (
        _as_seen  # raw pixels [N, 2] with depths [N], at the middle row's time
    )
    T_image_depth: Array | None = None  # see Keyframe
    depth_sweep: Array | None = None  # see Keyframe
    image_sweep: Array | None = None  # see Keyframe


def make_keyframe(
    keyframe_id: int, frame: Frame, camera: Camera, T_body_cam: Array, features: int, exposed: Exposed | None
) -> Keyframe:
    """Describe a frame for loop closing; `exposed` None: there are no depths.

    A frame that brings its tracks brings their descriptors too, or has nothing to recognise it by.
    """
    ids = None
    if frame.tracks is None:
        pixels, descriptors = describe(frame.images[0], features, mask=frame.mask(0))
    elif frame.tracks.descriptors is not None:
        ids, pixels, descriptors = frame.tracks.track_ids, frame.tracks.pixels_px, frame.tracks.descriptors
    else:
        pixels, descriptors = np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    if exposed is None:
        return Keyframe(keyframe_id, frame.t_ns, frame, pixels, descriptors, None)
    depth_m = exposed.depth_m(pixels, ids)
    pixels = exposed.instant_px(pixels, depth_m)
    points = transform_points(T_body_cam, camera.unproject(pixels) * depth_m[:, None])
    return Keyframe(
        keyframe_id, frame.t_ns, frame, pixels, descriptors, points, exposed.T_image_depth, exposed.depth_sweep,
        exposed.image_sweep,
    )  # fmt: skip


class KeyframeLife:
    """The keyframe that frames are placed by: its number, when the next one is due, and when it is given up."""

    def __init__(self, config: FrontEndConfig, has_scale: bool) -> None:
        """Begin without a keyframe; `has_scale`: measurements are in metres."""
        self.keyframe: Keyframe | None = None
        self._config = config
        self._has_scale = has_scale
        self._since_restart = _RESTART_KEYFRAMES  # keyframes; that many: long ago
        self._first_id = 0
        self._tracks = 0  # with which the keyframe began
        self._t_placed_ns = -1  # of the last frame that was placed

    @property
    def newest_id(self) -> int:
        """The keyframe's id, -1 before the first."""
        return -1 if self.keyframe is None else self.keyframe.id

    def begin_at(self, keyframe_id: int, seeks_place: bool) -> None:
        """Number the first keyframe, which the next one is; see FrontEnd.begin_at."""
        self.keyframe, self._first_id = None, keyframe_id
        if seeks_place:
            self._since_restart = 0

    def placed(self, t_ns: int) -> None:
        """Take note that a frame was placed."""
        self._t_placed_ns = t_ns

    def placed_without_vision(self, t_ns: int) -> None:
        """Take note that a frame was placed, not by vision: what follows should be recognised soon, as after a loss."""
        self._t_placed_ns, self._since_restart = t_ns, 0

    def is_given_up(self, t_ns: int) -> bool:
        """Return whether no frame was placed for so long that another keyframe has to begin."""
        return (t_ns - self._t_placed_ns) * 1e-9 >= PATIENCE_S

    def departure(
        self, t_ns: int, R_key_cam: Array, parallax_px: float, followed: int, inliers: int, fit: bool = True
    ) -> Departure:
        """Return how far a placed frame has come; `followed` tracks of those with which the keyframe began."""
        assert self.keyframe is not None
        return Departure(
            dt_s=(t_ns - self.keyframe.t_ns) * 1e-9,
            rotation_rad=float(np.linalg.norm(so3_log(np.ascontiguousarray(R_key_cam)))),
            parallax_px=parallax_px,
            alive=followed / max(self._tracks, 1),
            inliers=inliers,
            fit=fit,
            restarted=self._since_restart < _RESTART_KEYFRAMES,
        )

    def install(
        self, frame: Frame, camera: Camera, T_body_cam: Array, tracks: int, exposed: Exposed | None = None
    ) -> Keyframe:
        """Make a frame with that number of tracks the keyframe; see make_keyframe."""
        new_id = self._first_id if self.keyframe is None else self.keyframe.id + 1
        features = self._config.described_features
        self.keyframe = make_keyframe(new_id, frame, camera, T_body_cam, features, exposed)
        self._since_restart += 1
        self._tracks = tracks
        self._t_placed_ns = frame.t_ns
        return self.keyframe

    def lost(self, t_ns: int, why: str, inliers: int = 0) -> TrackResult:
        """Return the result of a frame that could not be placed."""
        vo = lost_motion(t_ns, self.newest_id, self._has_scale, inliers)
        return TrackResult(vo, no_observations(), None, 0.0, why)

    def refused(self, t_ns: int, failure: str, lack: str) -> TrackResult:
        """Return the result of a frame that lacks what a start needs, after a failure or as the first."""
        return self.lost(t_ns, f"{failure}; {lack}" if failure else lack)

    def started(self, observations: Observations, corners: int, failure: str) -> TrackResult:
        """Return the result of the frame that was just installed as the first keyframe or after a failure."""
        new = self.keyframe
        assert new is not None
        if new.id == self._first_id:
            vo = identity_motion(new.t_ns, new.id, self._has_scale, corners)
            return TrackResult(vo, observations, new, 0.0, "first keyframe")
        self._since_restart = 0
        vo = lost_motion(new.t_ns, new.id - 1, self._has_scale)
        return TrackResult(vo, observations, new, 0.0, f"restarted: {failure}")
