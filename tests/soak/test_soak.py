"""Runs as long as patience allows in every test run; the long ones are in benchmarks/long_run.py."""

from pathlib import Path

import numpy as np
import pytest
from g2o_edges import BEST_CHI2, EdgeFile

import vislam.window
from vislam.config import GraphConfig, WindowConfig
from vislam.core.geometry import se3_exp, transform
from vislam.core.messages import LoopDecision, LoopEdge, Tracking, VoMeasurement
from vislam.graph import Graph, PoseGraph
from worlds.endless_lap import STEREO, LapWorld, window_of_truth
from worlds.lap import RIG, packet_of
from worlds.parts import MACHINE


@pytest.mark.data
@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D", "MIT"])
def test_pose_graph_files_reach_their_optimum(data_root: Path, name: str) -> None:
    file = EdgeFile(data_root / "g2o" / f"{name}.g2o")
    graph = Graph()
    notes = file.replay(graph)
    print(notes)
    graph.optimise()
    chi2 = file.chi2(graph.poses())
    optimum = BEST_CHI2[name] or file.optimum_from(graph.poses())
    assert chi2 < 1.001 * optimum
    assert len(notes) <= 1  # a rebuild with QR, after which nothing fails again


def test_open_loop_chain_as_far_as_gtsam_throws() -> None:
    """A healthy chain on which iSAM2 with Cholesky throws, after about 370 m."""
    rng = np.random.default_rng(3)
    sigmas = np.repeat([0.001, 0.002], 3)
    step_m, count = 1.0, 700
    covariance = np.diag(sigmas**2)
    step = transform(np.eye(3), np.array([step_m, 0.0, 0.0]))
    config = GraphConfig(coupling="loose", vo_inflation=1.0, vo_floor_deg=0.0, vo_floor_m=0.0)
    graph = PoseGraph(config, None, MACHINE, RIG, WindowConfig())
    graph.initialise(None)
    chain, notes = np.eye(4), []
    for k in range(count):
        t_ns = k * 10**9
        measured = step @ se3_exp(rng.normal(size=6) * sigmas)
        chain = chain @ measured if k else chain
        vo = VoMeasurement(t_ns, max(k - 1, 0), measured, covariance, True, Tracking.OK, 100)
        notes += [f"{k}: {note}"] if (note := graph.add(packet_of(k, t_ns, vo)).note) else []
    print(notes)
    assert len(notes) == 1 and "rebuilt with QR" in notes[0]
    np.testing.assert_allclose(graph.poses()[-1], chain, atol=1e-3)
    end = LoopEdge(0, 0, count - 1, np.linalg.matrix_power(step, count - 1), covariance, True, 50, 1.0)
    vo = VoMeasurement(count * 10**9, count - 1, step, covariance, True, Tracking.OK, 100)
    assert graph.add(packet_of(count, count * 10**9, vo), [end]).accepted_loop_ids == (0,)
    assert np.linalg.norm(graph.poses()[count - 1, :3, 3] - [step_m * (count - 1), 0.0, 0.0]) < 0.1


@pytest.mark.parametrize(("coupling", "minutes"), [("loose", 4.5), ("tight", 1.5)])
def test_minutes_of_keyframes_with_loops(coupling: str, minutes: float) -> None:
    """Loose is long enough for poses to be read back in parts."""
    world = LapWorld(seed=5, tracks=40)
    config = GraphConfig(coupling="tight" if coupling == "tight" else "loose")
    graph = PoseGraph(config, world.noise, MACHINE, STEREO, WindowConfig())
    graph.initialise(world.initial_state())
    count = round(minutes * 60.0 * world.keyframe_hz)
    truth, most_read, seen = [], 0, {}
    for step in world.steps(count):
        update = graph.add(step.packet, step.edges)
        truth.append(step.truth)
        assert update.note == ""
        assert update.newest is not None and np.all(np.isfinite(update.newest.covariance))
        seen |= dict(zip(update.ids.tolist(), update.T_map_body, strict=True))
        if not step.edges:
            most_read = max(most_read, len(update.ids))
    assert sorted(seen) == list(range(count))
    assert most_read <= config.read_newest + config.read_block
    published = np.stack([seen[k] for k in range(count)])
    final = graph.finish()
    error_m = np.linalg.norm((final.T_map_body - np.stack(truth))[:, :3, 3], axis=1)
    lag_m = np.linalg.norm((published - final.T_map_body)[:, :3, 3], axis=1)
    print(f"rmse {np.sqrt(np.mean(error_m**2)):.3f} m, published poses were {lag_m.max():.4f} m from the final ones")
    assert np.sqrt(np.mean(error_m**2)) < 0.1
    assert lag_m.max() < 0.1


def test_loops_to_any_earlier_visit_tie_to_few_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    """What bounds the work of an update: the older ends of loop factors do not grow in number with the visits."""
    count, runs = 640, {}
    for name, after in (("as measured", 10**9), ("to anchors", 20)):
        world = LapWorld(seed=8, tracks=0)
        fake = window_of_truth(world, count)
        monkeypatch.setattr(vislam.window, "SlidingWindow", lambda *_, fake=fake: fake)
        graph = PoseGraph(
            GraphConfig(coupling="tight", anchor_after=after), world.noise, MACHINE, STEREO, WindowConfig()
        )
        graph.initialise(world.initial_state())
        truth = []
        for step in world.steps(count):
            assert graph.add(step.packet, step.edges).note == ""
            truth.append(step.truth)
        assert all(report.decision is LoopDecision.ACCEPTED for report in graph.edge_reports())
        keys = [model.factor(robust=True).keys() for model in graph._estimator.loops.values()]
        live, final = graph.poses(), graph.finish().T_map_body
        errors = [np.sqrt(np.mean(np.sum((T - np.stack(truth))[:, :3, 3] ** 2, axis=1))) for T in (live, final)]
        runs[name] = len({min(pair) for pair in keys[20:]}), len(keys), *errors
        print(name, "{} older ends of {} loops, rmse live {:.4f} m, final {:.4f} m".format(*runs[name]))
    measured, anchored = runs["as measured"], runs["to anchors"]
    assert anchored[0] <= 10 and measured[0] > 25
    assert anchored[2] < 1.3 * measured[2]
    assert abs(anchored[3] - measured[3]) < 1e-3
