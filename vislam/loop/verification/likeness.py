"""Whether two views may show the same place, by their matches alone and at a fraction of what a pose costs.

Words rank keyframes by likeness but do not decide whether any is alike: in a new place the most alike is a wrong one.
Matched points with depth decide: distances between points of one rigid scene are the same in both views,
wherever these stand (Bailey et al., ICRA 2000), and wrong matches hardly ever keep more than four of them together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopConfig
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.loop.view import View
from vislam.vision.features import match
from vislam.vision.hamming import packed

_MATCH_RATIO = 0.8  # nearest to second nearest descriptor; 0.8 keeps true matches of repeated texture out
MATCH_MAX_DISTANCE = 64  # bits of 256; unrelated ORB descriptors are 128 apart
INLIER_PX = 3.0  # reprojection error of an inlier; ORB's coarse octaves are good to 2 px
INVERSE_DEPTH_SIGMA_1_M = 0.01  # of the difference of two inverse depths
_MIN_KNOWN = 8  # expected matches with both depths known, from which on their distances are tested
_MAX_TOLD = 64  # of them that are compared: bounds the time to 0.2 ms
_SIGMAS = 3.0
_BEYOND_DOUBT = 2.0
_FAR_APART = 2.0  # tolerances; nearer points keep their distance whatever they are
_APART_PX = 16.0  # between two features that look alike, at least: nearer ones are of one corner
_MOST = 400  # features that are compared, at most: bounds the time to some milliseconds
_AS_MANY = 0.5  # of the features that the most frequent step has, for a shorter one to be the period


@dataclass(frozen=True, slots=True, eq=False)
class Likeness:
    """The matches of an older view a and a newer view b, and what speaks for them."""

    pairs: NDArray[np.int64]  # [M, 2] features of a and b
    rigid: int  # matches whose points keep all their distances to each other; 0: not asked
    is_alike: bool  # worth a pose

    @property
    def rank(self) -> tuple[int, int]:
        """The larger, the surer."""
        return self.rigid, len(self.pairs)


def compare(a: View, b: View, config: LoopConfig, px: float) -> Likeness:
    """Match two views and say whether they are alike; `px` is one pixel on the plane z = 1.

    Where enough matches have depth, `min_rigid` of them have to keep their distances. Without, their number has to be
    three sigmas (Poisson) above what chance gives; twice that is enough in any case, since distances between points
    that lie close together, as on a picture far away, carry no information.
    """
    pairs = match(a.descriptors, b.descriptors, _MATCH_RATIO, MATCH_MAX_DISTANCE)
    chance = config.chance_matched_share * min(len(a.xy), len(b.xy))
    least = max(config.min_inliers, chance + _SIGMAS * math.sqrt(chance))
    known_share = a.known.sum() * b.known.sum() / max(1, len(a.xy) * len(b.xy))
    if len(pairs) * known_share < _MIN_KNOWN:
        return Likeness(pairs, 0, len(pairs) >= least)
    told = pairs[a.known[pairs[:, 0]] & b.known[pairs[:, 1]]][:_MAX_TOLD]
    points_a, points_b = a.points_or_nan()[told[:, 0]], b.points_or_nan()[told[:, 1]]
    rigid = rigid_count(points_a, points_b, INVERSE_DEPTH_SIGMA_1_M, INLIER_PX * px)
    return Likeness(pairs, rigid, rigid >= config.min_rigid or len(pairs) >= _BEYOND_DOUBT * least)


def repeated_step(view: View, px: float, least: int) -> Array | None:
    """Return the shortest step [3] in cam0, metres, by which a place looks like itself, as a wall of equal panels does.

    None where fewer than `least` features do; `px` is one pixel on the plane z = 1.
    """
    known = np.flatnonzero(view.known)
    known = known[:: max(-(-len(known) // _MOST), 1)]
    if len(known) < least:
        return None
    points, xy, bits = view.points_or_nan()[known], view.xy[known], packed(view.descriptors[known])
    unlike = np.bitwise_count(bits[:, None] ^ bits[None]).sum(axis=2, dtype=np.int64)
    unlike[np.linalg.norm(xy[:, None] - xy[None], axis=2) < _APART_PX * px] = MATCH_MAX_DISTANCE + 1
    alike = np.argmin(unlike, axis=1)
    found = np.flatnonzero(unlike[np.arange(len(known)), alike] <= MATCH_MAX_DISTANCE)
    steps, z_m = points[alike[found]] - points[found], np.maximum(points[alike[found], 2], points[found, 2])
    slack_m = INVERSE_DEPTH_SIGMA_1_M * z_m**2 + INLIER_PX * px * z_m
    there, back = (np.linalg.norm(steps[:, None] - sign * steps[None], axis=2) for sign in (1.0, -1.0))
    votes = np.sum(np.minimum(there, back) <= np.maximum(slack_m[:, None], slack_m[None]), axis=1)
    often = np.flatnonzero(votes >= max(least, _AS_MANY * votes.max(initial=0)))
    if not len(often):
        return None
    return np.asarray(steps[often[np.argmin(np.linalg.norm(steps[often], axis=1))]])


@njit(cache=True, nogil=True)
def rigid_count(points_a: Array, points_b: Array, sigma_1_m: float, slack: float) -> int:
    """Return how many matched points [N, 3] of two views, greedily taken, keep all their distances to each other.

    Args:
        points_a: in one camera, metres, z > 0.
        points_b: the same in the other camera.
        sigma_1_m: of an inverse depth; distances may differ by as much as it moves their ends.
        slack: further difference, as a share of the depth: pixels that a keypoint is off, on the plane z = 1.

    The point that agrees with most others is taken first, then among those the next: a clique, if not the largest.
    """
    count = len(points_a)
    agree = np.zeros((count, count), np.bool_)
    for i in range(count):
        for j in range(i):
            apart_a = np.sqrt(np.sum((points_a[i] - points_a[j]) ** 2))
            apart_b = np.sqrt(np.sum((points_b[i] - points_b[j]) ** 2))
            a_i, a_j, b_i, b_j = points_a[i, 2], points_a[j, 2], points_b[i, 2], points_b[j, 2]
            moved = sigma_1_m * max(a_i * a_i + a_j * a_j, b_i * b_i + b_j * b_j)
            tolerance = moved + slack * max(a_i, a_j, b_i, b_j)
            far = max(apart_a, apart_b) > _FAR_APART * tolerance
            agree[i, j] = agree[j, i] = far and abs(apart_a - apart_b) <= tolerance
    left = np.ones(count, np.bool_)
    taken = 0
    while left.any():
        best, most = -1, -1
        for i in range(count):
            if left[i]:
                degree = np.sum(left & agree[i])
                if degree > most:
                    best, most = i, degree
        left &= agree[best]
        taken += 1
    return taken
