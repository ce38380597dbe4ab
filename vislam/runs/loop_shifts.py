"""By how much each loop moved the map: its own share of the shift of the update that took it in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from vislam.core.memory import LoopPlace, SlamMemory
from vislam.core.messages import Array, GraphUpdate, LoopEdge

if TYPE_CHECKING:
    from vislam.pipeline.steps import KeyframeStep

Shift = tuple[float, float]  # m: rms over the keyframes of the map, and largest


class LoopShifts:
    """Follows the keyframes of a map.

    An update may take in several loops. Its shift is divided among them by how far it moved the ends of each against
    each other, over the variance of the loop: so do normal equations, where it has moved as the loop asks. What is
    redundant is in no equation and moved nothing.
    """

    def __init__(self) -> None:
        """Start without keyframes."""
        self._poses: dict[int, Array] = {}  # T_map_body
        self._T_map_odom = np.eye(4)
        self._edges: dict[int, tuple[int, int, float]] = {}  # ends, and variance of the translation
        self._shifts: dict[int, Shift] = {}

    def place(self, memory: SlamMemory) -> None:
        """Take over the map of an earlier run."""
        self._poses = dict(enumerate(memory.graph.T_map_body))

    def restore(self, memory: SlamMemory, shifts: Mapping[int, Shift]) -> None:
        """Take over a run that is gone on with."""
        self.place(memory)
        self._T_map_odom = memory.graph.T_map_body[-1] @ np.linalg.inv(memory.graph.T_odom_body)
        self._know(loop.edge for loop in memory.graph.loops)
        self._shifts = dict(shifts)

    def __getitem__(self, edge_id: int) -> Shift:
        """Return the share of a loop; NaN where none is known."""
        return self._shifts.get(edge_id, (np.nan, np.nan))

    def of(self, edge_ids: Iterable[int]) -> dict[int, Shift]:
        """Return the shares of these loops, as far as they are known."""
        return {i: self._shifts[i] for i in edge_ids if i in self._shifts}

    def follow(self, step: KeyframeStep) -> None:
        """Take over what a keyframe's update moved."""
        self._know(step.edges)
        update, newest = step.update, step.odometry.packet.keyframe.id
        moved = dict(zip(update.ids.tolist(), update.T_map_body, strict=True))
        shifts_m = [float(np.linalg.norm((moved[i] - self._poses[i])[:3, 3])) for i in moved if i in self._poses]
        rms_m = float(np.sqrt(np.sum(np.square(shifts_m)) / max(len(self._poses), 1)))
        moved.setdefault(newest, update.T_map_odom @ step.odometry.T_odom_body)
        if update.accepted_loop_ids:
            before = self._poses | {newest: self._T_map_odom @ step.odometry.T_odom_body}
            spare = {state.id for state in step.record.loops if state.place is LoopPlace.SPARE}
            for loop_id, share in self._shares(update, spare, before, before | moved).items():
                self._shifts[loop_id] = share * rms_m, share * max(shifts_m, default=0.0)
        self._poses |= moved
        self._T_map_odom = update.T_map_odom

    def _shares(
        self, update: GraphUpdate, spare: set[int], before: Mapping[int, Array], after: Mapping[int, Array]
    ) -> dict[int, float]:
        """Return which share of the update is each loop's that it took in."""
        pulls = {i: 0.0 if i in spare else self._pull(i, before, after) for i in update.accepted_loop_ids}
        whole = sum(pulls.values())
        return {i: pull / whole if whole > 0.0 else 0.0 for i, pull in pulls.items()}

    def _pull(self, loop_id: int, before: Mapping[int, Array], after: Mapping[int, Array]) -> float:
        if loop_id not in self._edges:
            return 0.0
        older, newer, variance_m2 = self._edges[loop_id]
        # by numpy: in a live run no kernel may be met for the first time
        was, now = (np.linalg.solve(poses[older], poses[newer]) for poses in (before, after))
        return float(np.linalg.norm((now - was)[:3, 3])) / variance_m2

    def _know(self, edges: Iterable[LoopEdge]) -> None:
        for edge in edges:
            self._edges[edge.id] = edge.from_id, edge.to_id, float(np.trace(edge.covariance[3:, 3:]))
