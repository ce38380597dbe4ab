"""False loops made on purpose: as many as asked, wrong, the same every time, and of one mind within a group."""

import numpy as np
import pytest

from vislam.core.errors import UsageError
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.messages import LoopEdge
from vislam.loop.injection import FIRST_ID, FalseLoops, as_candidate

COUNT = 300


def poses() -> np.ndarray:
    steps = np.random.default_rng(2).normal(size=(COUNT, 6)) * [0.02, 0.02, 0.1, 0.1, 0.05, 0.02] + [0, 0, 0, 0.3, 0, 0]
    out = [np.eye(4)]
    for step in steps[1:]:
        out.append(out[-1] @ se3_exp(step))
    return np.array(out)


def injected(group: int) -> tuple[list[LoopEdge], int]:
    T, maker = poses(), FalseLoops(0.5, group, 3)
    false, true = [], 0
    for k in range(COUNT):
        edges = [LoopEdge(k, k - 40, k, np.eye(4), np.eye(6) * 1e-4, True, 30, 0.5)] if k > 60 else []
        false += maker.add(T[k], edges)
        true += len(edges)
    return false, true


@pytest.mark.parametrize("group", [1, 10])
def test_half_are_false_and_the_same_every_time(group: int) -> None:
    T = poses()
    false, true = injected(group)
    assert 0.85 * true < len(false) <= true
    again, _ = injected(group)
    for a, b in zip(false, again, strict=True):
        assert (a.id, a.from_id, a.to_id) == (b.id, b.from_id, b.to_id)
        assert np.array_equal(a.T_from_to, b.T_from_to)
    assert [edge.id for edge in false] == list(range(FIRST_ID, FIRST_ID + len(false)))
    for edge in false:
        wrong = se3_log(invert(edge.T_from_to) @ invert(T[edge.from_id]) @ T[edge.to_id])
        assert np.linalg.norm(wrong[3:]) > 0.5 and edge.from_id < edge.to_id
        assert as_candidate(edge).source == "injected"


def test_a_group_says_one_and_the_same_thing() -> None:
    T = poses()
    false, _ = injected(10)
    first = false[0]
    mates = [e for e in false if e.to_id - first.to_id == e.from_id - first.from_id and e.to_id - first.to_id < 10]
    assert len(mates) == 10
    for edge in mates[1:]:
        i = invert(T[first.from_id]) @ T[edge.from_id]
        j = invert(T[edge.to_id]) @ T[first.to_id]
        cycle = se3_log(invert(first.T_from_to) @ i @ edge.T_from_to @ j)
        assert np.linalg.norm(cycle[:3]) < 0.1 and np.linalg.norm(cycle[3:]) < 0.3


@pytest.mark.parametrize(("share", "group"), [(1.0, 1), (-0.1, 1), (0.5, 0)])
def test_a_share_that_is_none_is_refused(share: float, group: int) -> None:
    with pytest.raises(UsageError, match="inject"):
        FalseLoops(share, group, 0)
