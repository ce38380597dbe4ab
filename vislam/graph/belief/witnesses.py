"""Loops about one and the same pair of places are one witness: what deceives an image deceives its neighbours too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vislam.config import GraphConfig
from vislam.core.angles import angles_of
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import invert, invert_many, so3_log
from vislam.factors.loop import LoopModel
from vislam.factors.loop_evidence import LADDER, PLACE, log_volume
from vislam.graph.travel import Chain, Travel

_WITNESS_M = 1.0  # loops that start and end at the places of another's, or whose ends lie so near to its ends ...
_WITNESS_DEG = 45.0  # ... looking the same way, see the same things: together they are one witness
# on odometry sigma, for whether two loops of one witness say the same; 3 mixed them
_WITNESS_INFLATION = 1.5
EXPECTED = 3.0  # half the chi-square of six degrees of freedom, what a true loop loses of its evidence
_SEEDS = 5  # loops with most friends, around which the largest group is looked for


class Witnesses:
    """Metric loops of a run, gathered by the two places that they join and by what they say about them.

    Scale-free loops testify to too little and are not taken.
    """

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._limit = chi_square_limit(config.loop_gate_probability, 6)
        self._loops: list[list[LoopModel]] = []
        self._ends: NDArray[np.int64] = np.zeros((16, 2), dtype=np.int64)  # of those that stand for each witness

    def __len__(self) -> int:
        return len(self._loops)

    def loops(self) -> list[list[LoopModel]]:
        """Return the loops of each witness; the first stands for all."""
        return [list(loops) for loops in self._loops]

    def add(self, loop: LoopModel, travel: Travel) -> None:
        """Let a loop join the witness that saw the same from the same places, or be a new one."""
        ends = np.array([loop.record.from_id, loop.record.to_id])
        near = np.flatnonzero(self._near(ends, travel)).tolist()
        fits = [self._cycle_chi2(self._loops[n][0], loop, travel) for n in near]
        if fits and min(fits) < self._limit:
            self._loops[near[int(np.argmin(fits))]].append(loop)
            return
        if len(self) == len(self._ends):
            self._ends = np.concatenate([self._ends, np.zeros_like(self._ends)])
        self._ends[len(self)] = ends
        self._loops.append([loop])

    def _near(self, ends: NDArray[np.int64], travel: Travel) -> NDArray[np.bool_]:
        """Return which witnesses [W] are about the same two places: few keyframes apart, or next to one another."""
        poses = travel.poses
        known = self._ends[: len(self)]
        close = np.abs(known - ends) <= PLACE
        moved = np.linalg.norm(poses[known, :3, 3] - poses[ends, :3, 3], axis=2)
        cosine = (np.einsum("wnij,nij->wn", poses[known, :3, :3], poses[ends, :3, :3]) - 1.0) / 2.0
        close |= (moved < _WITNESS_M) & (cosine > np.cos(np.deg2rad(_WITNESS_DEG)))
        return np.asarray(close.all(axis=1))

    def _cycle_chi2(self, a: LoopModel, b: LoopModel, travel: Travel) -> float:
        """Return how far two loops and the odometry between their ends are from closing a cycle."""
        ra, rb = a.record, b.record
        rad2_i, m2_i, path_i = travel.between(ra.from_id, rb.from_id)
        rad2_j, m2_j, path_j = travel.between(ra.to_id, rb.to_id)
        own_rad2 = float(np.trace(a.covariance[:3, :3] + b.covariance[:3, :3])) / 3.0
        own_m2 = float(np.trace(a.covariance[3:, 3:] + b.covariance[3:, 3:])) / 3.0
        k2 = _WITNESS_INFLATION**2
        lever = path_i + path_j + float(np.linalg.norm(ra.T_from_to[:3, 3]))
        rad2 = k2 * (rad2_i + rad2_j) + own_rad2
        m2 = k2 * (m2_i + m2_j) + own_m2 + own_rad2 * lever**2
        poses = travel.poses
        T_i = invert(poses[ra.from_id]) @ poses[rb.from_id]
        T_j = invert(poses[rb.to_id]) @ poses[ra.to_id]
        cycle = invert(ra.T_from_to) @ T_i @ rb.T_from_to @ T_j
        turn = so3_log(np.ascontiguousarray(cycle[:3, :3]))
        return float(turn @ turn) / rad2 + float(cycle[:3, 3] @ cycle[:3, 3]) / m2


def confirming(loops: Sequence[LoopModel], chain: Chain) -> list[int]:
    """Return the largest group found of loops that confirm one another through odometry alone, as indices.

    Two confirm one another when they close a cycle that would hardly close by chance: its covariance is small against
    the volume of relative poses that a false loop may claim, by the highest rung of evidence. Pairwise consistency as
    by Mangelson et al., "Pairwise Consistent Measurement Set Maximization", ICRA 2018, with variances summed along the
    run.
    """
    if len(loops) < 2:
        return []
    limit, volume = chi_square_limit(0.999, 6), log_volume(chain.poses[:, :3, 3])
    a, b = (np.array([getattr(m.record, end) for m in loops]) for end in ("from_id", "to_id"))
    Z = np.stack([m.record.T_from_to for m in loops])
    own = np.array([[np.trace(m.covariance[:3, :3]), np.trace(m.covariance[3:, 3:])] for m in loops]) / 3.0
    A, B, Z_inverse = chain.poses[a], chain.poses[b], invert_many(Z)
    A_inverse, B_inverse = invert_many(A), invert_many(B)
    agree = np.zeros((len(loops), len(loops)), dtype=bool)
    for n in range(len(loops)):
        T_i, T_j = A_inverse[n] @ A, B_inverse @ B[n]
        cycle = Z_inverse[n] @ T_i @ Z @ T_j
        lever = sum(np.linalg.norm(T[:, :3, 3], axis=1) for T in (T_i, T_j, Z))
        rad2, m2 = (
            np.abs(sums[a] - sums[a[n]]) + np.abs(sums[b] - sums[b[n]]) + own[:, i] + own[n, i]
            for i, sums in enumerate((chain.rad2, chain.m2))
        )
        m2 = m2 + rad2 * lever**2 / 3.0
        d2 = angles_of(cycle[:, :3, :3]) ** 2 / rad2 + np.sum(cycle[:, :3, 3] ** 2, axis=1) / m2
        evidence = volume - 1.5 * (np.log(rad2) + np.log(m2)) - 3.0 * np.log(2.0 * np.pi) - EXPECTED
        agree[n] = (d2 < limit) & (evidence > LADDER[0])
        agree[n, n] = False
    best: list[int] = []
    for seed in np.argsort(-agree.sum(axis=1), kind="stable")[:_SEEDS].tolist():
        members, open_ = [seed], agree[seed].copy()
        while open_.any():
            candidates = np.flatnonzero(open_)
            friends = agree[np.ix_(candidates, candidates)].sum(axis=1)
            chosen = int(candidates[int(np.argmax(friends))])
            members.append(chosen)
            open_ &= agree[chosen]
        if len(members) > max(len(best), 1):
            best = members
    return sorted(best)
