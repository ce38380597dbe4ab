"""False loops put among the true ones on purpose, to measure what keeps them out of the graph."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from vislam.core.errors import UsageError
from vislam.core.geometry import invert, se3_exp
from vislam.core.messages import Array, LoopCandidate, LoopDecision, LoopEdge

INJECTED = "injected"  # of candidates
FIRST_ID = 1_000_000_000  # ids from here on are injected; those of the detector never get there
_TRIES = 50  # to find two different places
_APART_M = 1.0  # two keyframes nearer than this, or than a tenth of what was seen of the world, may be one place
_APART_SHARE = 0.1
_SIGMAS = (0.2, 0.2, 0.2, 0.3, 0.3, 0.3)  # rad and m, of the pose that a false loop claims: two views that look alike


class FalseLoops:
    """Offers false loops, alone or in groups whose members agree with one another, as repeated objects make them.

    A group pairs consecutive keyframes from two different places, moved onto each other by one and the same motion, so
    odometry between its members confirms it.
    """

    def __init__(self, share: float, group: int, seed: int, sigmas: ArrayLike = _SIGMAS) -> None:
        """Make false loops `share` of all that are offered, in groups of `group`; 1: each for itself.

        `sigmas` [6], rotation first, in rad and m, are of the pose that a false loop claims.
        Raises UsageError for a share that is none, or a group of nothing.
        """
        if not 0.0 < share < 1.0 or group < 1:
            raise UsageError(f"loop.inject_share {share} must be below 1 and loop.inject_group {group} at least 1")
        self._per_true = share / (1.0 - share)
        self._group = group
        self._sigmas = np.asarray(sigmas, dtype=np.float64)
        self._rng = np.random.default_rng([seed, 0xFA15E])
        self._poses: list[Array] = []
        self._open: list[tuple[int, int, Array, LoopEdge]] = []  # groups: first ends, motion between them, a model
        self._owed = 0.0
        self._next_id = FIRST_ID

    def add(self, T_odom_body: Array, true: Sequence[LoopEdge]) -> list[LoopEdge]:
        """Take the next keyframe with the loops that were found with it; return the false ones to be offered as well.

        `T_odom_body` [4, 4] only has to be right between near keyframes, and differ between different places.
        """
        self._poses.append(np.array(T_odom_body, dtype=np.float64))
        newest = len(self._poses) - 1
        self._owed += self._per_true * len(true)
        while true and self._owed >= self._group:
            place = self._other_place(newest)
            if place is None:
                break
            self._open.append((place, newest, se3_exp(self._rng.normal(size=6) * self._sigmas), true[-1]))
            self._owed -= self._group
        edges = [self._edge(newest, *group) for group in self._open]
        self._open = [group for group in self._open if newest - group[1] + 1 < self._group]
        return edges

    def _other_place(self, newest: int) -> int | None:
        """Return an older keyframe, the first of a group that ends before the newest, at another place."""
        here = self._poses[newest][:3, 3]
        positions = np.array([T[:3, 3] for T in self._poses])
        apart_m = max(_APART_M, _APART_SHARE * float(np.linalg.norm(np.ptp(positions, axis=0))))
        most = newest - 2 * self._group - 10
        for _ in range(_TRIES if most > 0 else 0):
            old = int(self._rng.integers(0, most))
            if float(np.min(np.linalg.norm(positions[old : old + self._group] - here, axis=1))) > apart_m:
                return old
        return None

    def _edge(self, newest: int, old: int, new: int, T_old_new: Array, model: LoopEdge) -> LoopEdge:
        step = newest - new
        poses = self._poses
        T = invert(poses[old + step]) @ poses[old] @ T_old_new @ invert(poses[new]) @ poses[newest]
        T = T @ se3_exp(np.linalg.cholesky(model.covariance) @ self._rng.normal(size=6))
        self._next_id += 1
        return LoopEdge(
            self._next_id - 1, old + step, newest, T, model.covariance, True, model.inliers, model.score
        )  # fmt: skip


def is_injected(edge_id: int) -> bool:
    """Return whether an edge was made up here."""
    return edge_id >= FIRST_ID


def as_candidate(edge: LoopEdge) -> LoopCandidate:
    """Return the record of a false loop, marked as injected."""
    return LoopCandidate(
        edge.from_id, edge.to_id, INJECTED, edge.score, edge.inliers, LoopDecision.ACCEPTED,
        "false, injected on purpose", sigma_m=float(np.sqrt(np.trace(edge.covariance[3:, 3:]) / 3.0)),
        T_from_to=edge.T_from_to,
    )  # fmt: skip
