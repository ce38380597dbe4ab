"""One joint covariance for all loops of a keyframe: the gate answers as with exact marginals, the gains add up."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from vislam.config import GraphConfig
from vislam.core.geometry import invert, se3_exp
from vislam.factors.journal import LoopRecord
from vislam.factors.keys import X
from vislam.factors.loop import LoopModel, relative_covariance
from vislam.factors.noise_models import gaussian
from vislam.factors.visual import pose_factor
from vislam.graph.belief.known import Known, worth_a_factor

Array = NDArray[np.float64]
COUNT = 30
LEVER_M = np.array([0.1, 0.02, -0.03])
STEP = np.repeat([0.004, 0.01], 3)


class Chain:
    """A random walk of keyframes with a prior, as gtsam has it; loops can be put in for an exact answer."""

    def __init__(self, seed: int) -> None:
        print(f"chain seed {seed}")
        self.rng = np.random.default_rng(seed)
        self.poses = [np.eye(4)]
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-2)))
        for k in range(1, COUNT):
            T = se3_exp(self.rng.normal(size=6) * np.repeat([0.3, 0.6], 3))
            self.graph.add(pose_factor(X(k - 1), X(k), T, gaussian(np.diag(STEP**2), 1e6)))
            self.poses.append(self.poses[-1] @ T)
        for k, T_map_body in enumerate(self.poses):
            self.values.insert(X(k), gtsam.Pose3(T_map_body))

    def joint(self, ids: list[int]) -> Array:
        return np.asarray(
            gtsam.Marginals(self.graph, self.values).jointMarginalCovariance([X(k) for k in ids]).fullMatrix()
        )

    def known(self, ids: list[int]) -> Known:
        return Known({k: self.poses[k] for k in ids}, self.joint(ids))

    def loop(self, n: int, a: int, b: int, has_scale: bool = True, sigmas: float = 0.0) -> LoopModel:
        sigma = np.repeat([0.006, 0.02], 3)
        T = invert(self.poses[a]) @ self.poses[b] @ se3_exp(self.rng.normal(size=6) * sigma * sigmas)
        covariance = np.diag(sigma**2)
        if not has_scale:
            moved = T[:3, 3] + (T[:3, :3] - np.eye(3)) @ LEVER_M
            T = T.copy()
            T[:3, 3] = moved / np.linalg.norm(moved)
        return LoopModel(LoopRecord(n, a, b, T, covariance, has_scale, b), GraphConfig(), LEVER_M)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("has_scale", [True, False])
def test_the_gate_answers_as_exact_marginals_of_each_pair_do(seed: int, has_scale: bool) -> None:
    chain = Chain(seed)
    newest, olds = COUNT - 1, [2, 5, 9, 16, 24]
    known = chain.known([*olds, newest])
    inside = set()
    for n in range(60):
        old = olds[n % len(olds)]
        loop = chain.loop(n, old, newest, has_scale, sigmas=float(chain.rng.uniform(0.0, 12.0)))
        exact = relative_covariance(chain.poses[old], chain.poses[newest], chain.joint([old, newest]))
        np.testing.assert_allclose(known.relative(old, newest), exact, rtol=1e-6, atol=1e-12)
        answers = [
            loop.chi2(chain.poses[old], chain.poses[newest], P) <= loop.threshold
            for P in (exact, known.relative(old, newest))
        ]
        assert answers[0] == answers[1]
        inside.add(answers[0])
    assert inside == {True, False}, "some were inside and some were not"


@pytest.mark.parametrize("seed", range(3))
def test_what_it_learns_is_what_the_graph_knows_afterwards(seed: int) -> None:
    chain = Chain(seed)
    ids = [3, 8, 20, COUNT - 1]
    known = chain.known(ids)
    loops = [chain.loop(0, 3, COUNT - 1), chain.loop(1, 8, COUNT - 1, has_scale=False), chain.loop(2, 20, COUNT - 1)]
    together, gains = known.gain(loops), [known.learn(loop) for loop in loops]
    assert together == pytest.approx(sum(gains))
    before = float(np.linalg.slogdet(chain.joint(ids))[1])
    for loop in loops:
        chain.graph.add(loop.factor(robust=False))
    after = chain.joint(ids)
    assert sum(gains) == pytest.approx(0.5 * (before - float(np.linalg.slogdet(after)[1])), rel=1e-3)
    for a in ids[:-1]:
        exact = relative_covariance(chain.poses[a], chain.poses[ids[-1]], chain.joint([a, ids[-1]]))
        np.testing.assert_allclose(known.relative(a, ids[-1]), exact, rtol=1e-3, atol=1e-9)


def test_information_gain_falls_with_what_is_known_and_rises_with_what_is_not() -> None:
    chain = Chain(7)
    newest = COUNT - 1
    gains = [chain.known([old, newest]).gain([chain.loop(n, old, newest)]) for n, old in enumerate((25, 15, 8, 1))]
    assert gains == sorted(gains) and gains[0] > 0.0, "odometry knows less of what is farther away"
    known, loop = chain.known([1, newest]), chain.loop(9, 1, newest)
    repeated = [known.learn(loop) for _ in range(6)]
    assert all(a > b > 0.0 for a, b in pairwise(repeated))


def test_loops_are_taken_by_what_they_tell_until_the_rest_tells_too_little() -> None:
    chain = Chain(11)
    newest = COUNT - 1
    groups = [[chain.loop(10 * old + n, old, newest) for n in range(count)] for old, count in ((27, 1), (1, 3), (2, 1))]
    known = chain.known([1, 2, 27, newest])
    first = known.gain(groups[1])
    assert first > known.gain(groups[2]) > known.gain(groups[0])
    worth = worth_a_factor(groups, known, 0.9 * first)
    assert worth == [groups[1]], "the next place is known by then"
    assert known.gain(groups[2]) < 0.9 * first
    assert len(worth_a_factor(groups, chain.known([1, 2, 27, newest]), 0.0)) == 3


def test_a_loop_tied_to_an_anchor_says_no_more_than_as_measured() -> None:
    chain = Chain(5)
    newest = COUNT - 1
    for has_scale in (True, False):
        known, loop = chain.known([4, 6, newest]), chain.loop(0, 6, newest, has_scale)
        as_measured = known.gain([loop])
        T_4_6, T_6_newest = invert(chain.poses[4]) @ chain.poses[6], invert(chain.poses[6]) @ chain.poses[newest]
        assert loop.tie_to(4, T_4_6, known.relative(4, 6), T_6_newest, most=4.0)
        assert loop.tie is not None
        np.testing.assert_allclose(loop.tie.T_from_to, invert(chain.poses[4]) @ chain.poses[newest], atol=1e-6)
        tied = known.gain([loop])
        print(f"as measured {as_measured:.3f}, tied {tied:.3f} nats")
        assert 0.0 < tied <= as_measured * 1.02
        assert not chain.loop(1, 6, newest, has_scale).tie_to(4, T_4_6, np.eye(6), T_6_newest, most=4.0), (
            "nobody knows the way"
        )
