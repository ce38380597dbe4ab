"""Which loops may enter the graph: a chi-square gate, and a car park where rejected ones wait for company.

Odometry covariances are optimistic, so a true loop can lie outside the gate. It is parked, and a group of parked loops
that agree pairwise through the odometry between them is accepted together (pairwise consistency, Mangelson et al., ICRA
2018, with scalar variances that are summed along the run).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from vislam.config import GraphConfig
from vislam.factors.loop import LoopModel
from vislam.geometry import invert, so3_log
from vislam.messages import Array, LoopDecision


@dataclass(frozen=True, slots=True, eq=False)
class EdgeReport:
    """What became of one offered loop edge."""

    loop_id: int
    from_id: int
    to_id: int
    chi2: float  # at the gate, NaN when it was not reached
    weight: float  # of the Cauchy kernel at the current estimate, 0 when not in the graph
    decision: LoopDecision
    reason: str


class Travel:
    """Sums along the run that bound what odometry can tell about two keyframes: variances and distance."""

    def __init__(self) -> None:
        """Start with keyframe 0."""
        self._rad2: list[float] = [0.0]
        self._m2: list[float] = [0.0]
        self._distance_m: list[float] = [0.0]

    def append(self, variance_rad2: float, variance_m2: float, distance_m: float) -> None:
        """Add the motion to a new keyframe."""
        self._rad2.append(self._rad2[-1] + variance_rad2)
        self._m2.append(self._m2[-1] + variance_m2)
        self._distance_m.append(self._distance_m[-1] + distance_m)

    def amend(self, k: int, variance_rad2: float, variance_m2: float) -> None:
        """Replace the variances of the motion to keyframe k, one of the newest."""
        for sums, variance in ((self._rad2, variance_rad2), (self._m2, variance_m2)):
            delta = variance - (sums[k] - sums[k - 1])
            for n in range(k, len(sums)):
                sums[n] += delta

    def between(self, i: int, j: int) -> tuple[float, float, float]:
        """Return variance in rad^2 and m^2 per axis and the distance in m travelled between two keyframes."""
        rad2, distance = abs(self._rad2[j] - self._rad2[i]), abs(self._distance_m[j] - self._distance_m[i])
        return rad2, abs(self._m2[j] - self._m2[i]) + rad2 * distance**2 / 3.0, distance

    def scale(self, sigma_factor: float) -> None:
        """Multiply all sigmas."""
        self._rad2 = [v * sigma_factor**2 for v in self._rad2]
        self._m2 = [v * sigma_factor**2 for v in self._m2]

    def relative_covariance(self, i: int, j: int) -> Array:
        """Return a diagonal stand-in [6, 6] for the covariance of the relative pose, from odometry alone."""
        rad2, m2, _ = self.between(i, j)
        return np.diag(np.repeat([rad2 + 1e-12, m2 + 1e-12], 3))


class CarPark:
    """Loops that wait outside the gate."""

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._config = config
        self._limit = float(chi2_distribution.ppf(config.loop_gate_probability, 6))
        self._edges: list[LoopModel] = []
        self._agree: NDArray[np.bool_] = np.zeros((0, 0), dtype=bool)

    @property
    def edges(self) -> list[LoopModel]:
        """Return the parked edges, oldest first."""
        return list(self._edges)

    def park(self, edge: LoopModel, poses: Array, travel: Travel) -> LoopModel | None:
        """Add an edge and compare it with all others; return the one that had to leave, if any."""
        row = np.array([self._consistent(edge, other, poses, travel) for other in self._edges], dtype=bool)
        count = len(self._edges)
        agree = np.zeros((count + 1, count + 1), dtype=bool)
        agree[:count, :count] = self._agree
        agree[count, :count] = agree[:count, count] = row
        self._edges.append(edge)
        self._agree = agree
        if len(self._edges) > self._config.parked_max:
            oldest = self._edges[0]
            self.remove([oldest])
            return oldest
        return None

    def remove(self, edges: list[LoopModel]) -> None:
        """Take edges out."""
        gone = {id(edge) for edge in edges}
        keep = [n for n, edge in enumerate(self._edges) if id(edge) not in gone]
        self._edges = [self._edges[n] for n in keep]
        self._agree = self._agree[np.ix_(keep, keep)]

    def group_of(self, edge: LoopModel) -> list[LoopModel]:
        """Return a group of mutually consistent parked edges around `edge`, empty when too few agree.

        They must see at least two different older and two different newer keyframes: one image that deceives
        several times is still one witness.
        """
        n = next(i for i, other in enumerate(self._edges) if other is edge)
        members, open_ = [n], self._agree[n].copy()
        while open_.any():
            candidates = np.flatnonzero(open_)
            friends = self._agree[np.ix_(candidates, candidates)].sum(axis=1)
            best = int(candidates[int(np.argmax(friends))])
            members.append(best)
            open_ &= self._agree[best]
        group = [self._edges[i] for i in sorted(members)]
        places = {g.record.from_id for g in group}, {g.record.to_id for g in group}
        enough = len(group) > self._config.consistency_min_others and min(map(len, places)) >= 2
        return group if enough else []

    def _consistent(self, a: LoopModel, b: LoopModel, poses: Array, travel: Travel) -> bool:
        """Return whether two metric loops and the odometry between their ends close a cycle.

        Scale-free loops never count: rotation alone is too weak a witness.
        """
        ra, rb, config = a.record, b.record, self._config
        if not (ra.has_scale and rb.has_scale):
            return False
        rad2_i, m2_i, path_i = travel.between(ra.from_id, rb.from_id)
        rad2_j, m2_j, path_j = travel.between(ra.to_id, rb.to_id)
        k2 = config.consistency_inflation**2
        own_rad2 = float(np.trace(a.covariance[:3, :3] + b.covariance[:3, :3])) / 3.0
        own_m2 = float(np.trace(a.covariance[3:, 3:] + b.covariance[3:, 3:])) / 3.0
        rad2 = k2 * (rad2_i + rad2_j) + own_rad2
        lever = path_i + path_j + float(np.linalg.norm(ra.T_from_to[:3, 3]))
        m2 = k2 * (m2_i + m2_j) + own_m2 + own_rad2 * lever**2
        if m2 > config.consistency_max_sigma_m**2 or rad2 > np.deg2rad(config.consistency_max_sigma_deg) ** 2:
            return False
        T_i = invert(poses[ra.from_id]) @ poses[rb.from_id]
        T_j = invert(poses[rb.to_id]) @ poses[ra.to_id]
        cycle = invert(ra.T_from_to) @ T_i @ rb.T_from_to @ T_j
        rotation = so3_log(np.ascontiguousarray(cycle[:3, :3]))
        d2 = float(rotation @ rotation) / rad2 + float(cycle[:3, 3] @ cycle[:3, 3]) / m2
        return d2 < self._limit
