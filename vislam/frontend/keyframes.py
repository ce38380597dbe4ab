"""When a frame becomes a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.config import FrontEndConfig


@dataclass(frozen=True, slots=True)
class Departure:
    """How far a frame has come from its keyframe."""

    dt_s: float
    rotation_rad: float
    parallax_px: float  # median, rotation taken out
    alive: float  # fraction of the keyframe's tracks that are still good


def keyframe_reason(departure: Departure, config: FrontEndConfig) -> str:
    """Return why the frame should become a keyframe, or an empty string.

    A keyframe costs a little drift and a node in the graph; a late one costs tracks. So distance decides, and time only
    makes sure that the graph hears of a camera that hardly moves.
    """
    if departure.alive < config.keyframe_min_alive:
        return f"only {departure.alive:.0%} of the tracks left"
    if departure.dt_s < config.keyframe_min_interval_s:
        return ""
    if departure.parallax_px > config.keyframe_parallax_px:
        return f"parallax of {departure.parallax_px:.0f} px"
    if departure.rotation_rad > np.deg2rad(config.keyframe_rotation_deg):
        return f"turned by {np.rad2deg(departure.rotation_rad):.0f} deg"
    if departure.dt_s >= config.keyframe_max_interval_s:
        return f"{departure.dt_s:.1f} s since the last keyframe"
    return ""
