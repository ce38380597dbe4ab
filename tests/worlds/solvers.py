"""The solvers that a graph makes, watched: what they hold, what they are asked, and how they fail."""

from __future__ import annotations

from typing import Any

import gtsam
import pytest

from vislam.core.memory import LoopPlace, LoopState
from vislam.factors.keys import X
from vislam.factors.loop import LoopModel
from vislam.factors.solvers import IncrementalSolver
from vislam.graph import PoseGraph, ladder
from vislam.graph.belief.consensus import Consensus, Verdict

POISON = RuntimeError("\nIndeterminate linear system detected while working near variable\n8646911284551352321")


class WatchedSolvers:
    """Every incremental solver that graphs make from here on, the newest last in `made`.

    The next `armed` updates throw, and as in gtsam an object that threw throws for ever; `used_after_throw` is whether
    one was asked for something. `asked` has the number of variables of each joint marginal.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.armed = 0
        self.used_after_throw = False
        self.asked: list[int] = []
        self.made: list[IncrementalSolver] = []
        outer = self

        class Watched(IncrementalSolver):
            def __init__(self, *args: Any) -> None:
                super().__init__(*args)
                self.dead = False
                outer.made.append(self)

            def __getattribute__(self, name: str) -> Any:
                outer.used_after_throw |= name == "_isam" and self.dead
                return super().__getattribute__(name)

            def update(self, *args: Any) -> list[int]:
                outer.used_after_throw |= self.dead
                if outer.armed > 0 or self.dead:
                    outer.armed -= 1
                    self.dead = True
                    raise POISON
                return super().update(*args)

            def joint_covariance(self, keys: list[int]) -> Any:
                outer.asked.append(len(keys))
                return super().joint_covariance(keys)

        monkeypatch.setattr(ladder, "IncrementalSolver", Watched)

    def arm_at_the_gate(self, monkeypatch: pytest.MonkeyPatch, failures: int) -> None:
        """Let updates fail from the next test of a loop on: that comes after its keyframe and before the loop."""
        chi2 = LoopModel.chi2

        def arm(model: LoopModel, *args: Any) -> float:
            monkeypatch.setattr(LoopModel, "chi2", chi2)
            self.armed = failures
            return chi2(model, *args)

        monkeypatch.setattr(LoopModel, "chi2", arm)


def factors(solver: IncrementalSolver) -> list[gtsam.NonlinearFactor]:
    """Return the factors that a solver holds."""
    graph = solver.factors(solver.around(list(solver.estimate().keys())))
    return [graph.at(n) for n in range(graph.size())]


def poses_in(solver: IncrementalSolver) -> set[int]:
    """Return the keyframes whose poses a solver holds."""
    return {key - X(0) for key in gtsam.utilities.allPose3s(solver.estimate()).keys()}  # noqa: SIM118  no dict


class Places:
    """Where the loops of a graph are, gathered from what it reports for its memory."""

    def __init__(self, graph: PoseGraph) -> None:
        self._graph = graph
        self._states: dict[int, LoopState] = {}

    def now(self) -> dict[int, LoopState]:
        """Return the state of every offered loop."""
        self._states |= {state.id: state for state in self._graph.take_record().loops}
        return self._states

    def of(self, place: LoopPlace) -> set[int]:
        """Return the ids of the loops in a place."""
        return {n for n, state in self.now().items() if state.place is place}


class Review:
    """Reviews of loops, one of which ends as a test wants it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._offered: dict[int, LoopModel] = {}
        self._verdict: Verdict | None = None
        offer, step = Consensus.offer, Consensus.step

        def remember(consensus: Consensus, loop: LoopModel, *args: Any) -> None:
            self._offered[loop.record.id] = loop
            offer(consensus, loop, *args)

        def decided(consensus: Consensus, *args: Any) -> Verdict | None:
            verdict, self._verdict = self._verdict, None
            return step(consensus, *args) if verdict is None else verdict

        monkeypatch.setattr(Consensus, "offer", remember)
        monkeypatch.setattr(Consensus, "step", decided)

    def decide(self, let_in: tuple[int, ...] = (), put_out: tuple[int, ...] = ()) -> None:
        """Let the review that comes with the next keyframe bring loops in and put others out."""
        out = [(self._offered[n], 99.0) for n in put_out]
        self._verdict = Verdict([self._offered[n] for n in let_in], out, places=3, scale=1.0)
