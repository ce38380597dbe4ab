"""`vislam loops`: edges listed, undone and brought back, through the graph that the session stored."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import Config, GraphConfig, WindowConfig
from vislam.core.errors import DataError, UsageError
from vislam.core.memory import FrameEntry, KeyframeEntry, LoopPlace
from vislam.core.messages import LoopDecision
from vislam.graph import PoseGraph
from vislam.runs.offline.loop_undo import change_loops, list_loops
from vislam.runs.session import Session, SessionWriter, recall
from vislam.trajectory import read_tum
from worlds.lap import RIG, World, rmse_m
from worlds.parts import GRAVITY_M_S2, MACHINE

GRAPH = GraphConfig(coupling="loose", vo_inflation=1.0)
BEFORE, CLOSES = 100, 120  # keyframes of one lap; the only loops end at the second


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, World]:
    """The folder of a run with drift and two loops, 0 and 1, and a false one, 2."""
    run = tmp_path_factory.mktemp("loops") / "run"
    run.mkdir()
    world = World(28.0, seed=6, vo_sigma_rad=np.deg2rad(0.4), vo_sigma_m=0.01)
    writer = SessionWriter.create(run / "session.db", {"config": asdict(Config(graph=GRAPH))}, RIG, None, GRAVITY_M_S2)
    graph = PoseGraph(GRAPH, None, MACHINE, RIG, WindowConfig())
    graph.initialise(None, world.truth[0])
    for k in range(world.count):
        edges = [world.loop(0, 20, k), world.loop(1, 21, k)] if k == CLOSES else []
        edges += [world.false_loop(2, 60, k)] if k == CLOSES + 4 else []
        packet = world.packet(k, imu=False)
        update = graph.add(packet, edges, world.truth[k])
        pose = graph.poses()[-1]
        writer.add_frame(FrameEntry(world.t_ns(k), k, np.eye(4), world.truth[k], pose, packet.vo.tracking, 9, k, ""))
        writer.add(KeyframeEntry(packet, world.truth[k], update, graph.take_record(), edges))
    final = graph.finish()
    writer.move(final, graph.take_record())
    writer.close(finished=True)
    return run, world


def poses_of(run: Path) -> np.ndarray:
    return read_tum(run / "trajectory_graph.tum").T_world_body


def test_an_edge_is_undone_stays_undone_and_comes_back(finished, capsys) -> None:
    run, world = finished
    assert [(loop["id"], loop["decision"]) for loop in list_loops(run)] == [
        (0, "accepted"), (1, "accepted"), (2, "pending")
    ]  # fmt: skip
    stored = np.array([k.T_map_body for k in Session(run / "session.db").keyframes()])
    answer = change_loops(run, [0, 1], [])
    assert answer["undone"] == [0, 1] and answer["moved_max_m"] > 0.05
    without = poses_of(run)
    assert rmse_m(without, world.truth) > 1.5 * rmse_m(stored, world.truth)
    memory = recall(Session(run / "session.db"))
    assert memory is not None
    places = {loop.edge.id: loop.state.place for loop in memory.graph.loops}
    assert places[0] is places[1] is LoopPlace.UNDONE
    np.testing.assert_allclose(memory.graph.T_map_body, without, atol=1e-5)
    again = PoseGraph(GRAPH, None, MACHINE, RIG, WindowConfig())  # what a resumed run, or one on this map, does
    again.initialise(None, world.truth[0])
    again.restore(memory.graph)
    again.finish()
    reports = {r.loop_id: r for r in again.edge_reports()}
    assert reports[0].decision is LoopDecision.REJECTED and reports[0].weight == 0.0
    assert "undone by the user" in reports[0].reason

    assert run_verb(["loops", str(run), "--redo", "0", "--redo", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["undone"] == []
    np.testing.assert_allclose(poses_of(run), stored, atol=2e-3)
    assert run_verb(["loops", str(run)]) == 0
    assert "brought back" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_what_cannot_be_changed_is_told_and_nothing_is_touched(finished, tmp_path, capsys) -> None:
    run, _ = finished
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.name != "log.txt"}
    for undo, redo, says in (
        ([7], [], "has no loop 7"),
        ([2], [], "nothing to undo"),
        ([], [0], "was not undone"),
        ([0], [0], "at once"),
    ):
        with pytest.raises(UsageError, match=says):
            change_loops(run, undo, redo)
    with pytest.raises(DataError, match="no run folder"):
        list_loops(tmp_path / "nothing")
    assert run_verb(["loops", str(run), "--undo", "7"]) == 2
    assert run_verb(["loops", str(tmp_path), "--undo", "7"]) == 3
    assert "Traceback" not in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.name != "log.txt"} == before
