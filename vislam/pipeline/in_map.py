"""Where a run is in the map: its published pose there, and whether the place is known."""

import numpy as np

from vislam.config import PublishConfig
from vislam.core.messages import Array, Localisation, Submaps, Tracking
from vislam.pipeline.steps import FrontStep, KeyframeStep
from vislam.trajectory.continuity import Continuity


class Place:
    """Whether the place in the map is known, and how often it was lost and found again."""

    def __init__(self) -> None:
        """Begin at the origin of a map of one submap."""
        self.counters = {"frames_lost": 0, "relocalised": 0}
        self.submaps = Submaps()

    @property
    def submap(self) -> int:
        """Return the submap that the run is in, from 0."""
        return len(self.submaps.groups) - 1

    def localise(self, tracking: Tracking, keyframes: list[KeyframeStep]) -> Localisation:
        """Return whether the place in the map is known after a frame, and count it."""
        was_joined = self.submaps.is_joined
        if keyframes:
            self.submaps = keyframes[-1].update.submaps
        if self.submaps.is_joined and not was_joined:
            self.counters["relocalised"] += 1
            return Localisation.RELOCALISED
        is_lost = tracking is Tracking.LOST or not self.submaps.is_joined
        self.counters["frames_lost"] += is_lost
        return Localisation.LOST if is_lost else Localisation.TRACKING


class InMap:
    """Carries poses from odom into map without jumps, but for those with which the place in the map is found."""

    def __init__(self, config: PublishConfig) -> None:
        """Begin at the origin of a map of one submap."""
        self.place = Place()
        self._published = Continuity(config)
        self._T_map_odom = np.eye(4)  # at the last frame

    def take(
        self, front: FrontStep, keyframes: list[KeyframeStep], T_map_odom: Array | None
    ) -> tuple[Array | None, Localisation]:
        """Return the pose in map [4, 4] after a frame, and whether the place is known; None before a loop into it.

        What the graph corrected since the last frame is taken in as the body moves, but for where the place was found:
        what odometry made of `map` until then was a guess, and nothing in `map` could go on from it.
        """
        localisation, T_before = self.place.localise(front.track.vo.tracking, keyframes), self._T_map_odom
        if localisation is Localisation.RELOCALISED:
            self._published.clear()
        if T_map_odom is None or front.estimate is None:
            return None, localisation
        estimate, self._T_map_odom = front.estimate, T_map_odom
        before, after = T_before @ estimate.T_odom_before, T_map_odom @ estimate.T_odom_body
        shown = self._published.follow(front.frame.t_ns, before, after, estimate.rate_sigma_rad_s)
        return shown if self.place.submaps.is_joined else None, localisation
