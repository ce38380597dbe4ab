"""Dense loops over a graph that has velocities and biases, too."""

from __future__ import annotations

import pytest

from vislam.config import GraphConfig, WindowConfig
from vislam.graph import PoseGraph
from worlds.lap import RIG, World
from worlds.parts import MACHINE
from worlds.solvers import WatchedSolvers, poses_in


def test_keyframes_with_velocities_stay_in_the_solver_however_dense_loops_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world, watched = World(36.0, seed=3), WatchedSolvers(monkeypatch)
    config = GraphConfig(coupling="loose", freeze_keyframes=10, freeze_after=20, anchor_after=5)
    graph = PoseGraph(config, world.noise, MACHINE, RIG, WindowConfig())
    graph.initialise(world.initial_state())
    for k in range(world.count):
        graph.add(world.packet(k), [world.loop(k, k - 100, k)] if k > 102 else [])
    assert poses_in(watched.made[-1]) == set(range(world.count))
    assert len(graph.states()) == world.count
