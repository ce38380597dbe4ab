"""What the graph knows of some keyframes together at one moment, and what loops between them would teach it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vislam.core.geometry import invert, se3_adjoint
from vislam.core.messages import Array
from vislam.factors.loop import LoopModel, relative_covariance


class Known:
    """The joint covariance of keyframes: one marginal answers for all loops that end with a keyframe.

    `learn` brings in loops by Kalman's update, so that the next one is judged by what is left to learn, before the
    graph itself has them.
    """

    def __init__(self, poses: Mapping[int, Array], joint: Array) -> None:
        """Take T_map_body [4, 4] by keyframe and their joint covariance [6 M, 6 M] in that order, body side."""
        self._poses = dict(poses)
        self._at = {k: slice(6 * n, 6 * n + 6) for n, k in enumerate(self._poses)}
        self._joint = joint

    def has(self, k: int) -> bool:
        """Return whether a keyframe is among these."""
        return k in self._at

    def motion(self, i: int, j: int) -> Array:
        """Return T_i_j [4, 4]."""
        return invert(self._poses[i]) @ self._poses[j]

    def relative(self, i: int, j: int) -> Array:
        """Return the covariance [6, 6] of T_i_j, perturbed at j."""
        a, b = self._at[i], self._at[j]
        both = np.block([[self._joint[a, a], self._joint[a, b]], [self._joint[b, a], self._joint[b, b]]])
        return relative_covariance(self._poses[i], self._poses[j], both)

    def learn(self, model: LoopModel) -> float:
        """Take a loop as the graph will have it, by way of its tie if it has one; return what it added, in nats.

        The mutual information of measurement and poses, 0.5 log det(1 + S^-1 H P H^T).
        """
        H, noise = self._row(model)
        PH = self._joint @ H.T
        S = noise + H @ PH
        left = self._joint - PH @ np.linalg.solve(S, PH.T)
        self._joint = 0.5 * (left + left.T)
        return 0.5 * float(np.linalg.slogdet(S)[1] - np.linalg.slogdet(noise)[1])

    def gain(self, models: Sequence[LoopModel]) -> float:
        """Return what loops would add together, in nats; nothing is learnt."""
        trial = Known(self._poses, self._joint)
        return sum(trial.learn(model) for model in models)

    def _row(self, model: LoopModel) -> tuple[Array, Array]:
        """Return the Jacobian [n, 6 M] of a loop by all poses, and its covariance [n, n]."""
        a, b = model.record.from_id, model.record.to_id
        if model.tie is None:
            _, J = model.residual(self._poses[a], self._poses[b])
            noise = model.covariance
        else:
            a, J, noise = model.tie.from_id, np.eye(6), model.tie.covariance
        H = np.zeros((len(J), len(self._joint)))
        H[:, self._at[a]] = -J @ se3_adjoint(invert(self._poses[b]) @ self._poses[a])
        H[:, self._at[b]] = J
        return H, noise


def worth_a_factor(groups: Sequence[Sequence[LoopModel]], known: Known, gain_min: float) -> list[list[LoopModel]]:
    """Return those groups of loops that are worth their factors, the one with most information first.

    Each is judged by the information in nats that it adds to the graph's and to that of the ones before it; less than
    `gain_min` is not worth it. The measure is that by which Kretzschmar and Stachniss choose scans
    ("Information-theoretic compression of pose graphs for laser-based SLAM", IJRR 2012). `known` has learnt those
    that are returned.
    """
    left, worth = list(groups), list[list[LoopModel]]()
    while left:
        gains = [known.gain(group) for group in left]
        best = int(np.argmax(gains))
        if gains[best] < gain_min:
            break
        worth.append(list(left.pop(best)))
        for model in worth[-1]:
            known.learn(model)
    return worth
