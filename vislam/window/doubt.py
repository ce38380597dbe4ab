"""What a window takes out again: views that it did not expect, before they are used, and such as fit to nothing, after.

The first is the test of `gate`; see there.
"""

import numpy as np
from numpy.typing import NDArray

from vislam.core.chi_square import chi_square_limit
from vislam.core.messages import Array
from vislam.window import gate
from vislam.window.equations import Camera, Solution, Views, visual
from vislam.window.keyframes import Keyframes
from vislam.window.tracks import RHO_START, Selection, TrackTable

_GATE_TRACK_FRACTION = 0.34  # of a track's observations beyond the gate: the whole track goes
_GATE_PROBABILITY = 0.999  # chi-square of an observation; above it after optimisation, it is taken out
_CONTRADICTED = 0.25  # of the tested views are as expected at most: a crowd of wrong tracks, ...
_LEAST_SPREAD = 0.05  # no tracker is better, a fit to few views only looks so
_LEAST_VIEWS, _LEAST_TESTED = 3, 30  # of a landmark, and of all, before their scatter means anything
_MEDIAN_PX, _MEDIAN_DEPTH = 1.1774, 0.6745  # of the length of a normal error, in a plane and on a line
_STUBBORN_KEYFRAMES = 4  # ... or, in this number of successive keyframes, a wrong prediction


class Doubt:
    """Owns how often in a row hardly anything was as expected."""

    def __init__(self, cameras: int) -> None:
        """Start without any, for a number of cameras."""
        self._gate = chi_square_limit(_GATE_PROBABILITY, 2)
        self._contradictions = 0  # keyframes in a row
        # see the function, at most 1: stated sigmas cover errors that neighbours share, too
        self.spreads = np.ones(cameras + 1)

    def newest(
        self, tracks: TrackTable, keyframes: Keyframes, covariance: Array, calibration: Array, camera: Camera
    ) -> int:
        """Take out observations of the newest keyframe that contradict the prediction; return the number of tracks.

        `covariance` [6 M + 16, 6 M + 16] is that of all poses, the newest a prediction, and of the calibration. If
        hardly anything is as expected, again and again, it is the expectation that is wrong, and all of it stays.
        """
        rows = tracks.continued(keyframes.ids)
        if len(rows) == 0:
            return 0
        X, views = keyframes.X, tracks.arrange(rows, keyframes.ids)
        points = tracks.points[views.slots]
        fresh = tracks.host[views.slots] != keyframes.ids[views.views.host]
        if fresh.any():
            older = tracks.arrange(rows[tracks.keyframe[rows] != keyframes.ids[-1]], keyframes.ids)
            visual.start(X, calibration, older.views, camera, fresh, RHO_START, points)
        squares = np.empty(len(rows))
        gate.innovations(X, points, calibration, views.views, camera, covariance, squares)
        tested, bad = ~np.isnan(squares), squares > self._gate
        contradicted = bad.sum() > (1.0 - _CONTRADICTED) * tested.sum()
        self._contradictions = self._contradictions + 1 if contradicted else 0
        if self._contradictions > _STUBBORN_KEYFRAMES:
            return 0
        tracks.remove_rows(rows[bad])
        return int(bad.sum())

    def solved(self, tracks: TrackTable, selection: Selection, solution: Solution) -> int:
        """Set `spreads`; take out views beyond the gate, and tracks with too many; return how many tracks."""
        self.spreads = np.minimum(spreads(solution, selection.views, len(self.spreads) - 1), 1.0)
        bad: NDArray[np.bool_] = solution.squares.max(axis=1, initial=0.0) > self._gate
        if not bad.any():
            return 0
        first = selection.views.first
        counts = np.add.reduceat(bad.astype(np.int64), first[:-1])
        hopeless = counts > _GATE_TRACK_FRACTION * np.diff(first)
        hopeless |= bad[first[:-1]]  # the host's own view: without it the landmark has no bearing
        tracks.remove_rows(selection.rows[bad | np.repeat(hopeless, np.diff(first))])
        return int(hopeless.sum())


def spreads(solution: Solution, views: Views, cameras: int) -> Array:
    """Return the sigmas [C + 1] of a pixel's error in each camera and of a depth's, whitened; 1 where few are seen.

    By medians, so that as many as half may be outliers. Views that a landmark and poses were fitted to scatter less;
    those of landmarks with fewer than three hardly at all, and do not count.
    """
    seen = np.diff(views.first)
    poses = 1.0 - min(3.0 * len(solution.X) / max(len(views.camera), 1), 0.5)
    loosened = 1.0 / np.sqrt(np.repeat(1.0 - 1.5 / np.maximum(seen, _LEAST_VIEWS), seen) * poses)
    pixels, depths = (np.sqrt(solution.squares) * loosened[:, None]).T
    counts = np.repeat(seen >= _LEAST_VIEWS, seen)
    groups = [(pixels[counts & (views.camera == c)], _MEDIAN_PX) for c in range(cameras)]
    groups.append((depths[counts & (views.values[:, 7] > 0.0)], _MEDIAN_DEPTH))
    found = [np.median(g) / usual if len(g) >= _LEAST_TESTED else 1.0 for g, usual in groups]
    return np.maximum(np.array(found), _LEAST_SPREAD)
