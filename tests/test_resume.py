"""A run that was ended, by whatever, goes on: what each stage remembers, and the whole pipeline under kill -9."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from fake_window import FakeWindow
from graph_world import GRAVITY_M_S2, RIG, World, rmse_m
from session_entries import start_facts

from vislam.config import GraphConfig, WindowConfig
from vislam.graph import PoseGraph
from vislam.memory import KeyframeEntry
from vislam.messages import LoopDecision
from vislam.session import Session, SessionWriter, recall

LOOSE = GraphConfig(coupling="loose", vo_inflation=1.0, imu_inflation=1.0)
TIGHT = GraphConfig(coupling="tight", window_inflation=1.0)
SOURCE = "points:corridor-loop,duration_s=20"
KILLS = 20


# ---- the graph


def make_graph(world: World, config: GraphConfig, imu: bool, monkeypatch: pytest.MonkeyPatch) -> PoseGraph:
    monkeypatch.setattr("vislam.window.SlidingWindow", lambda *_: FakeWindow(world, imu=imu), raising=False)
    graph = PoseGraph(config, world.noise if imu else None, GRAVITY_M_S2, RIG, WindowConfig())
    graph.initialise(world.initial_state() if imu else None, None if imu else world.truth[0])
    return graph


def edges_of(world: World, k: int) -> list:
    """True loops to a lap before, and now and then one that is false."""
    if k <= 105 or k % 4:
        return []
    return [world.loop(2 * k, k - 100, k), *([world.false_loop(2 * k + 1, k - 60, k)] if k % 12 == 0 else [])]


def feed(graph: PoseGraph, world: World, measured: list, writer: SessionWriter | None = None) -> None:
    """Add packets with their loops; with a writer, as a run stores them."""
    for packet, edges in measured:
        k = packet.keyframe.id
        update = graph.add(packet, edges, world.truth[k])
        if writer is not None:
            start = start_facts(world.initial_state(), world.noise) if measured[-1][0].imu is not None else None
            writer.add(KeyframeEntry(packet, world.truth[k], update, graph.take_news(), edges, start=start))


def same(a: object, b: object) -> bool:
    """Whether two values hold the same bits, field by field."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if not hasattr(a, "__slots__") or isinstance(a, str):
        return bool(a == b)
    return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


@pytest.mark.parametrize(("config", "imu"), [(LOOSE, True), (LOOSE, False), (TIGHT, True), (TIGHT, False)])
def test_a_graph_is_built_again_exactly_and_ends_where_it_would_have(config, imu, tmp_path, monkeypatch):
    world = World(36.0, seed=5)
    measured = [(world.packet(k, imu=imu, lost=k == 60), edges_of(world, k)) for k in range(world.count)]
    writer = SessionWriter(tmp_path / "session.db", {}, RIG, world.noise if imu else None, GRAVITY_M_S2)
    old = make_graph(world, config, imu, monkeypatch)
    feed(old, world, measured[:150], writer)
    writer.close()
    memory = recall(Session(tmp_path / "session.db"))
    assert memory is not None
    new = make_graph(world, config, imu, monkeypatch)
    update = new.restore(memory.graph)
    assert len(new.journal) == len(old.journal)
    assert all(same(a, b) for a, b in zip(new.journal, old.journal, strict=True))
    assert np.abs(new.poses() - old.poses()).max() < 1e-2
    assert update.ids.tolist() == list(range(150))
    assert np.allclose(update.T_map_odom, new.poses()[-1] @ np.linalg.inv(world.truth[149]))
    for a, b in zip(new.edge_reports(), old.edge_reports(), strict=True):
        assert same(replace(a, weight=0.0), replace(b, weight=0.0))
        assert a.weight == pytest.approx(b.weight, abs=0.1)
    decisions = {report.decision for report in new.edge_reports()}
    assert decisions >= {LoopDecision.ACCEPTED, LoopDecision.PARKED}
    if config is TIGHT:  # a new window starts at the newest keyframe, seen again
        new.go_on(replace(measured[149][0], imu=None), world.truth[149])
    for graph in (old, new):
        feed(graph, world, measured[150:])
        graph.finish()
    print("rmse [m]: went on", rmse_m(new.poses(), world.truth), "uninterrupted", rmse_m(old.poses(), world.truth))
    assert np.abs(new.poses() - old.poses()).max() < (1e-3 if config is LOOSE else 0.05)
    assert [s.t_ns for s in new.states()] == [s.t_ns for s in old.states()]


def test_the_newest_state_of_the_window_is_that_of_the_last_commit(tmp_path, monkeypatch):
    world = World(10.0, seed=6)
    measured = [(world.packet(k), []) for k in range(40)]
    writer = SessionWriter(tmp_path / "session.db", {}, RIG, world.noise, GRAVITY_M_S2)
    graph = make_graph(world, TIGHT, True, monkeypatch)
    feed(graph, world, measured, writer)
    writer.close()
    states = Session(tmp_path / "session.db").states("graph")
    assert sorted(states) == list(range(40))
    new = make_graph(world, TIGHT, True, monkeypatch)
    memory = recall(Session(tmp_path / "session.db"))
    new.restore(memory.graph)
    for a, b in zip(new.states(), graph.states(), strict=True):
        assert np.allclose(a.velocity_world_m_s, b.velocity_world_m_s, atol=0.02)
        assert np.array_equal(a.accel_bias_m_s2, b.accel_bias_m_s2)
