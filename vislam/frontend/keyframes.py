"""When a frame becomes a keyframe, and what a keyframe is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.camera import Camera
from vislam.config import FrontEndConfig
from vislam.features import describe
from vislam.geometry import transform_points
from vislam.messages import Array, Frame, Keyframe


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
    least = config.keyframe_min_alive if departure.fit else config.keyframe_min_alive_unfit
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
        (turned_deg, config.keyframe_rotation_deg, f"turned by {turned_deg:.0f} deg"),
        (departure.dt_s, config.keyframe_max_interval_s, f"{departure.dt_s:.1f} s since the last keyframe"),
    )
    return next((reason for value, limit, reason in limits if value >= spacing * limit), "")


def make_keyframe(
    keyframe_id: int, frame: Frame, camera: Camera, T_body_cam: Array, features: int,
    measure_depth: Callable[[Array, NDArray[np.int64] | None], Array] | None,
) -> Keyframe:  # fmt: skip
    """Describe a frame for loop closing.

    `measure_depth` gives z-depths [N] in metres of raw pixels [N, 2] and the tracks [N] that they belong to, if any.
    A frame that brings its tracks brings their descriptors too, or has nothing to recognise it by.
    """
    ids = None
    if frame.tracks is None:
        pixels, descriptors = describe(frame.images[0], features)
    elif frame.tracks.descriptors is not None:
        ids, pixels, descriptors = frame.tracks.track_ids, frame.tracks.pixels_px, frame.tracks.descriptors
    else:
        pixels, descriptors = np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    points = None
    if measure_depth is not None:
        points = transform_points(T_body_cam, camera.unproject(pixels) * measure_depth(pixels, ids)[:, None])
    return Keyframe(keyframe_id, frame.t_ns, frame, pixels, descriptors, points)
