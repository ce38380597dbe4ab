"""Whether the tracks agree on a motion, and what becomes of it where a filter expects them elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.messages import Array


class Placing(Protocol):
    """One try to place a frame relative to the keyframe."""

    @property
    def pixels(self) -> Array:
        """Where all tracks are [N, 2], NaN where not found."""

    @property
    def failure(self) -> str:
        """Why it cannot be trusted; empty when it can."""

    @property
    def followed(self) -> int:
        """How many tracks were found."""

    @property
    def agreeing(self) -> NDArray[np.bool_]:
        """Which tracks [N] agree on the motion."""


T = TypeVar("T", bound=Placing)


def confirmed(placing: T, astray: NDArray[np.bool_], place: Callable[[Array], T], config: FrontEndConfig) -> T:
    """Return the placing, or another without the tracks that contradict the filter's motion, where most do.

    Where most do not, the filter has no say: vision drawn to what the filter believes would tell it nothing new.

    Args:
        placing: by all tracks.
        astray: which tracks [N] are not where the filter's motion can put them.
        place: places the frame by tracks at pixels [N, 2], NaN where not to be used.
        config: the shares that decide.
    """
    agree = int(placing.agreeing.sum())
    if not placing.failure and (astray & placing.agreeing).sum() <= config.contradicting_share * agree:
        return placing
    other = place(np.where(astray[:, None], np.nan, placing.pixels))
    few = int(other.agreeing.sum()) < config.min_expected_share * placing.followed
    return placing if few or other.failure else other


def failure(tracks: int, followed: int, agree: int, converged: bool, least: int, config: FrontEndConfig) -> str:
    """Return why a motion on which tracks `agree` cannot be trusted, or an empty string; `least` have to be found."""
    if followed < least:
        return f"only {followed} of {tracks} tracks found"
    if not converged:
        return "the motion does not converge"
    if agree < max(least, config.min_inlier_ratio * followed):
        return f"only {agree} of {followed} tracks agree on a motion"
    return ""


def weakness(followed: int, agree: int, enough: int, config: FrontEndConfig) -> str:
    """Return why tracking is degraded, or an empty string; fewer than `enough` tracks that agree are a reason."""
    if agree < enough:
        return f"only {agree} inliers"
    if agree < config.degraded_inlier_ratio * followed:
        return f"only {agree} of {followed} tracks agree"
    return ""
