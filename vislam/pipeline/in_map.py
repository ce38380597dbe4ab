"""Where a run is in the map: its published pose there, and whether the place is known."""

from __future__ import annotations

import numpy as np

from vislam.config import PublishConfig
from vislam.core.messages import Array, Localisation, Submaps, Tracking
from vislam.pipeline.steps import FrontStep, KeyframeStep
from vislam.trajectory.continuity import Continuity


class InMap:
    """Carries poses from odom into map without jumps, and counts how often the place was lost and found again."""

    def __init__(self, config: PublishConfig) -> None:
        """Begin at the origin of a map of one submap."""
        self.counters = {"frames_lost": 0, "relocalised": 0}
        self._submaps = Submaps()
        self._published = Continuity(config)
        self._T_map_odom = np.eye(4)  # at the last frame

    @property
    def submap(self) -> int:
        """Return the submap that the run is in, from 0."""
        return len(self._submaps.groups) - 1

    def begin(self, submaps: Submaps) -> None:
        """Go on in a map of these submaps."""
        self._submaps = submaps

    def publish(self, front: FrontStep, T_map_odom: Array | None) -> Array | None:
        """Return the pose in map; what the graph corrected since the last frame is taken in as the body moves."""
        if T_map_odom is None or front.estimate is None:
            return None
        estimate, T_before = front.estimate, self._T_map_odom
        self._T_map_odom = T_map_odom
        before, after = T_before @ estimate.T_odom_before, T_map_odom @ estimate.T_odom_body
        return self._published.follow(front.frame.t_ns, before, after, estimate.rate_sigma_rad_s)

    def localise(self, tracking: Tracking, keyframes: list[KeyframeStep]) -> Localisation:
        """Return whether the place in the map is known after a frame."""
        before = self._submaps
        if keyframes:
            self._submaps = keyframes[-1].update.submaps
        return localised(before, self._submaps, tracking, self.counters)


def localised(before: Submaps, after: Submaps, tracking: Tracking, counters: dict[str, int]) -> Localisation:
    """Return whether the place in the map is known after a frame that changed the submaps so, and count it."""
    is_joined = after.groups[-1] == 0
    if is_joined and before.groups[-1] != 0:
        counters["relocalised"] += 1
        return Localisation.RELOCALISED
    is_lost = tracking is Tracking.LOST or not is_joined
    counters["frames_lost"] += is_lost
    return Localisation.LOST if is_lost else Localisation.TRACKING
