"""Precision, recall and edge errors against the truth, and the tables that they are computed from."""

import itertools
import json
import math
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import LoopConfig, LoopTruthConfig
from vislam.core.errors import DataError
from vislam.core.geometry import interpolate, invert, se3_exp
from vislam.core.memory import GraphRecord, KeyframeEntry
from vislam.core.messages import (
    GraphUpdate,
    KeyframePacket,
    LoopDecision,
    Observations,
    RetrievedKeyframe,
    Tracking,
    VoMeasurement,
)
from vislam.loop.closer import LoopCloser
from vislam.loop.evaluation import (
    DOUBTFUL,
    RIGHT,
    WRONG,
    Detections,
    bootstrap_interval,
    precision_recall,
    true_places,
)
from vislam.loop.table import LoopRow, loops_text, read_loops, read_retrieved, retrieved_text
from vislam.loop.words import Vocabulary, seed_vocabulary
from vislam.runs.offline.loop_evaluation import evaluate_loops, judge_loops
from vislam.runs.session import Session, SessionWriter
from vislam.trajectory import Trajectory, read_tum, write_tum
from worlds.landmarks import LandmarkWorld, lap_poses, room

PER_LAP = 30
RULE = replace(LoopTruthConfig(), min_apart_s=3.0, min_apart_keyframes=20)  # keyframes come every 0.2 s here


def detections(*answers: tuple[float, int]) -> Detections:
    return Detections(np.array([a[0] for a in answers]), np.array([a[1] for a in answers], dtype=np.int64))


def test_precision_and_recall_are_those_of_counting() -> None:
    found = detections((9, RIGHT), (8, RIGHT), (7, DOUBTFUL), (6, WRONG), (5, RIGHT), (5, WRONG), (math.nan, DOUBTFUL))
    revisits = np.array([True, False, True, False, True, True, True])
    curve = precision_recall(found, revisits)
    assert curve.threshold.tolist() == [9, 8, 7, 6, 5]
    assert curve.precision.tolist() == pytest.approx([1, 1, 1, 2 / 3, 3 / 5])
    assert curve.recall.tolist() == pytest.approx([0.2, 0.2, 0.2, 0.2, 0.4])  # the second was right, but no revisit
    assert curve.recall_at_full_precision == pytest.approx(0.2)


ANSWERS = st.lists(
    st.tuples(
        st.integers(0, 6).map(float) | st.just(math.nan), st.sampled_from([RIGHT, DOUBTFUL, WRONG]), st.booleans()
    )
)


@given(ANSWERS)
def test_recall_at_full_precision_is_that_of_trying_all_thresholds(answers: list[tuple[float, int, bool]]) -> None:
    found = detections(*[(a[0], a[1]) for a in answers])
    revisits = np.array([a[2] for a in answers], dtype=np.bool_)
    curve = precision_recall(found, revisits)
    best = 0.0
    for threshold in range(7):
        above = [a for a in answers if a[0] >= threshold]
        if not any(a[1] == WRONG for a in above):
            best = max(best, sum(a[1] == RIGHT and a[2] for a in above) / max(1, revisits.sum()))
    assert curve.recall_at_full_precision == pytest.approx(best)
    assert np.all(np.diff(curve.recall) >= 0.0)
    assert np.all((curve.precision >= 0.0) & (curve.precision <= 1.0))


def test_the_bootstrap_repeats_and_brackets_the_figure() -> None:
    rng = np.random.default_rng(5)
    score = rng.uniform(size=200)
    verdict = np.where(score > 0.4, RIGHT, np.where(rng.uniform(size=200) < 0.5, WRONG, RIGHT))
    revisits = np.ones(200, dtype=np.bool_)
    found = Detections(score, verdict)
    low, high = bootstrap_interval(found, revisits, RULE)
    assert (low, high) == bootstrap_interval(found, revisits, RULE)
    assert low <= precision_recall(found, revisits).recall_at_full_precision <= high
    assert 0.4 < low < high < 0.8
    assert bootstrap_interval(found, revisits, replace(RULE, seed=1)) != (low, high)
    assert all(math.isnan(value) for value in bootstrap_interval(found, ~revisits, RULE))


def test_revisits_are_the_second_lap_and_only_it() -> None:
    world, poses = room(1), np.array(lap_poses(2.0, PER_LAP))
    ids = np.arange(2 * PER_LAP)
    seen = [world.points[:0]] * len(ids)  # replaced below: what each keyframe sees
    rng = np.random.default_rng(0)
    for k in ids:
        points = world.see(int(k), poses[k], rng).points_body_m
        seen[k] = points[np.isfinite(points).all(axis=1)]
    known = np.ones(len(ids), dtype=np.bool_)
    places = true_places(ids, ids * 200_000_000, poses, seen, known, world.rig, RULE)
    assert np.array_equal(places.overlap, places.overlap.T)
    assert places.revisits[PER_LAP:].all()
    assert not places.revisits[: PER_LAP // 2].any()
    assert places.image_verdict(3, PER_LAP + 3) == RIGHT
    assert places.image_verdict(0, PER_LAP + PER_LAP // 2) == WRONG  # the other side, looking the other way
    T = invert(poses[3]) @ poses[PER_LAP + 5]
    assert places.pose_error(3, PER_LAP + 5, T) == pytest.approx((0.0, 0.0), abs=1e-6)
    off = T @ se3_exp(np.array([0.0, 0.0, np.deg2rad(4.0), 0.3, 0.0, 0.0]))
    metres, degrees = places.pose_error(3, PER_LAP + 5, off)
    assert metres == pytest.approx(0.3, abs=0.01)
    assert degrees == pytest.approx(4.0, abs=0.01)
    assert not places.is_gross((metres, degrees))
    assert places.is_gross((0.51, 0.0))
    assert places.is_gross((0.0, 10.1))
    assert places.is_gross((math.nan, 0.0))
    unit = T.copy()
    unit[:3, 3] /= np.linalg.norm(T[:3, 3])
    without = replace(places, with_depth=~known)
    assert without.pose_error(3, PER_LAP + 5, unit) == pytest.approx((0.0, 0.0), abs=1e-6)


def row(**changes: object) -> LoopRow:
    usual = LoopRow(
        3, 40, 5, 9, "odometry", 0.5, 30.0, 41.0, 0.02, 0.0, math.nan, math.nan, math.nan, math.nan, None, "rejected",
        "12 inliers, of \"many\", \n needs more",
    )  # fmt: skip
    return replace(usual, **changes)  # type: ignore[arg-type]


def same(a: LoopRow, b: LoopRow) -> bool:
    if (a.T_from_to is None) != (b.T_from_to is None):
        return False
    if a.T_from_to is not None and b.T_from_to is not None and not np.allclose(a.T_from_to, b.T_from_to, atol=1e-6):
        return False
    one, other = (json.dumps([getattr(r, n) for n in LoopRow.__dataclass_fields__ if n != "T_from_to"]) for r in (a, b))
    return one == other


@settings(max_examples=50)
@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.sampled_from(list(LoopDecision)))
def test_tables_come_back_as_they_were_written(
    tmp_path_factory: pytest.TempPathFactory, xi: list[float], decision: LoopDecision
) -> None:
    rows = [row(), row(T_from_to=se3_exp(np.array(xi)), decision=str(decision), weight=0.25, chi2=4.5, from_t_ns=-1)]
    path = tmp_path_factory.mktemp("tables") / "loops.csv"
    path.write_text(loops_text(rows))
    assert [same(a, b) for a, b in zip(rows, read_loops(path), strict=True)] == [True, True]
    assert [r.was_offered for r in read_loops(path)] == [False, True]


def test_damaged_tables_are_refused(tmp_path: Path) -> None:
    path, good = tmp_path / "loops.csv", loops_text([row(T_from_to=np.eye(4))])
    for bad, message in (
        (good.replace("0,0,0,0,0,0,1", "0,0,0,0,0,0,0"), "is no pose"),
        (good.replace("0,0,0,0,0,0,1", "0,0,0,0,0,0,"), "is no pose"),
        (good.replace("3,40", "3,x40"), "invalid literal"),
        (good.replace("supporters", "support"), "expected the columns"),
        (good[: good.index("rejected")], "cut short"),
    ):
        path.write_text(bad)
        with pytest.raises(DataError, match=message):
            read_loops(path)
    found = [RetrievedKeyframe(1, 30, 0.25, 0.5, 2)]
    path.write_text(retrieved_text(found))
    (back,) = read_retrieved(path)
    assert (back.from_id, back.to_id, back.score, back.island_score, back.consistency) == (1, 30, 0.25, 0.5, 2)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with two laps through landmarks, as far as the evaluation reads it; odometry is the truth."""
    folder = tmp_path_factory.mktemp("run")
    world: LandmarkWorld = room(1)
    rng, poses = np.random.default_rng(0), lap_poses(2.0, PER_LAP)
    detector = LoopCloser(replace(LoopConfig(), appearance_skip_keyframes=12, appearance_skip_s=1.0), world.rig, 0)
    writer = SessionWriter.create(folder / "session.db", {"source": "test"}, world.rig, None, 9.81)
    rows: list[LoopRow] = []
    retrieved: list[RetrievedKeyframe] = []
    for k, pose in enumerate(poses):
        keyframe = world.see(k, pose, rng)
        edges, candidates = detector.detect(keyframe, pose)
        retrieved += detector.retrieved
        vo = VoMeasurement(keyframe.t_ns, max(0, k - 1), np.eye(4), np.eye(6), True, Tracking.OK, 100)
        seen = Observations(np.empty(0, np.int64), np.empty((0, 2)))
        update = GraphUpdate(k, np.array([k]), pose[None], np.eye(4), None)
        writer.add(KeyframeEntry(KeyframePacket(keyframe, vo, seen, None), pose, update, GraphRecord(), edges))
        for c in candidates:
            weight = 1.0 if c.decision is LoopDecision.ACCEPTED else math.nan
            judged = {"decision": str(c.decision), "reason": c.reason, "source": c.source, "weight": weight}
            pose_found = {"inliers": float(c.inliers), "T_from_to": c.T_from_to}
            rows.append(row(from_id=c.from_id, to_id=c.to_id, **judged, **pose_found))
    writer.close()
    (folder / "loops.csv").write_text(loops_text(rows))
    (folder / "retrieved.csv").write_text(retrieved_text(retrieved))
    stamps = np.arange(len(poses)) * 200_000_000
    write_tum(Trajectory(stamps, np.array(poses)), folder / "trajectory_truth.tum")
    return folder


def test_a_run_is_judged_stage_by_stage(finished: Path) -> None:
    answer = evaluate_loops(finished, RULE)
    assert answer == json.loads((finished / "loops_eval.json").read_text())
    assert answer["keyframes"] == 2 * PER_LAP
    assert answer["revisits"] >= PER_LAP
    stages = answer["stages"]
    assert list(stages) == ["appearance", "hindsight", "normalised", "temporal", "geometry", "checks", "graph"]
    assert all(0.0 <= stage["recall"] <= 1.0 for stage in stages.values())
    assert stages["temporal"]["answers"] <= stages["appearance"]["answers"]
    assert stages["graph"]["wrong"] == 0
    assert stages["graph"]["recall_at_full_precision"] > 0.7
    low, high = stages["graph"]["interval"]
    assert low <= stages["graph"]["recall_at_full_precision"] <= high
    assert answer["edges"]["gross"] == 0
    assert answer["edges"]["error_m"]["median"] < 0.05
    lines = (finished / "loops_eval.csv").read_text().splitlines()
    assert lines[0] == "from_id,to_id,error_m,error_deg,gross,apart"
    assert len(lines) == 1 + answer["edges"]["accepted"]
    assert max(float(line.split(",")[2]) for line in lines[1:]) == pytest.approx(answer["edges"]["error_m"]["max"])


def test_a_score_is_normalised_by_that_of_the_keyframe_before(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in finished.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    session = Session(tmp_path / "session.db")
    words = seed_vocabulary() if (own := session.words()) is None else Vocabulary.from_bytes(own.data, "test")
    bags = {keyframe.id: words.transform(keyframe.descriptors) for keyframe in session.keyframes()}
    session.close()
    retrieved = read_retrieved(tmp_path / "retrieved.csv")
    best: dict[int, float] = {}
    for found in retrieved:
        ratio = bags[found.to_id].score(bags[found.from_id]) / bags[found.to_id].score(bags[found.to_id - 1])
        best[found.to_id] = max(best.get(found.to_id, 0.0), ratio)
    stages = judge_loops(tmp_path, RULE).stages
    told, alike = stages["normalised"].score, stages["hindsight"].score
    assert len(best) > PER_LAP // 2
    for k, ratio in best.items():
        assert np.isnan(told[k]) or told[k] <= ratio + 1e-12
        assert np.isnan(told[k]) or told[k] == pytest.approx(alike[k] / bags[k].score(bags[k - 1]))
    assert np.isfinite(told).sum() == np.isfinite(stages["appearance"].score).sum()
    assert np.nanmax(told) == pytest.approx(max(best[k] for k in np.flatnonzero(np.isfinite(told))))

    expected = {k: bags[k].score(bags[k - 1]) for k in np.flatnonzero(np.isfinite(told))}
    middle = float(np.median(list(expected.values())))
    monkeypatch.setattr("vislam.runs.offline.loop_evaluation._MIN_EXPECTED", middle)
    kept = np.flatnonzero(np.isfinite(judge_loops(tmp_path, RULE).stages["normalised"].score))
    assert kept.tolist() == [k for k, value in expected.items() if value >= middle]


def test_what_was_proposed_is_compared_with_what_is_truly_near(finished: Path, tmp_path: Path) -> None:
    for path in finished.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before = evaluate_loops(tmp_path, RULE)
    found, told = before["found"], before["proposals"]["appearance"]
    assert found["near"] >= found["retrieved"] >= found["proposed"] > 0.8 * found["near"]
    assert found["proposed"] >= found["posed"] >= found["accepted"] > 0
    assert 0.5 * told["verified"] < told["near"] <= told["verified"]
    far = row(from_id=0, to_id=PER_LAP + PER_LAP // 2, source="appearance", decision="rejected", reason="made up")
    unasked = replace(far, reason="not verified: 5 verifications per keyframe are spent")
    (tmp_path / "loops.csv").write_text(loops_text([*read_loops(tmp_path / "loops.csv"), far, unasked]))
    after = evaluate_loops(tmp_path, RULE)
    assert after["proposals"]["appearance"] == {"verified": told["verified"] + 1, "near": told["near"]}
    assert after["found"] == found
    (tmp_path / "retrieved.csv").write_text(retrieved_text([]))
    assert evaluate_loops(tmp_path, RULE)["found"] == {**found, "retrieved": 0}
    strict = replace(RULE, near_m=0.0)
    assert evaluate_loops(tmp_path, strict)["found"]["near"] == 0


def test_a_truth_with_few_poses_is_interpolated(finished: Path, tmp_path: Path) -> None:
    for path in finished.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    truth = read_tum(finished / "trajectory_truth.tum")
    halfway = [interpolate(a, b, 0.5) for a, b in itertools.pairwise(truth.T_world_body)]
    between = Trajectory(truth.t_ns[:-1] + 100_000_000, np.array(halfway))
    write_tum(between, tmp_path / "trajectory_truth.tum")
    answer = evaluate_loops(tmp_path, RULE)
    assert answer["keyframes"] == 2 * PER_LAP - 2  # all but the ends
    assert answer["edges"]["gross"] == 0
    with pytest.raises(DataError, match="covers none of"):
        evaluate_loops(tmp_path, replace(RULE, max_truth_gap_s=0.1))


def test_a_wrong_edge_is_counted_where_it_is(finished: Path, tmp_path: Path) -> None:
    for path in finished.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before = evaluate_loops(tmp_path, RULE)
    rows = read_loops(tmp_path / "loops.csv")
    spoilt = row(
        from_id=2, to_id=PER_LAP + 20, inliers=1000.0, T_from_to=np.eye(4), weight=0.9, decision="accepted",
        reason="made up",
    )  # fmt: skip
    (tmp_path / "loops.csv").write_text(loops_text([*rows, spoilt]))
    after = evaluate_loops(tmp_path, RULE)
    assert after["edges"]["gross"] == before["edges"]["gross"] + 1
    assert after["edges"]["worst"][0]["reason"] == "made up"
    assert after["stages"]["graph"]["wrong"] == 1
    assert after["stages"]["graph"]["recall_at_full_precision"] == 0.0  # the wrong one is the surest of all
    assert after["stages"]["appearance"] == before["stages"]["appearance"]


def test_what_is_missing_is_named(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no true trajectory"):
        evaluate_loops(tmp_path, RULE)
    (tmp_path / "trajectory_truth.tum").write_bytes((finished / "trajectory_truth.tum").read_bytes())
    with pytest.raises(DataError, match="no session"):
        evaluate_loops(tmp_path, RULE)
    late = Trajectory(np.array([10**15, 10**15 + 10**8]), np.tile(np.eye(4), (2, 1, 1)))
    for name in ("session.db", "loops.csv", "retrieved.csv"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    write_tum(late, tmp_path / "trajectory_truth.tum")
    with pytest.raises(DataError, match="covers none of"):
        evaluate_loops(tmp_path, RULE)


def test_the_experiment_writes_what_came_out_and_what_failed(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("made_0", "made_1"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "metrics.json").write_text("{}")
    for path in finished.iterdir():
        (tmp_path / "runs" / "made_0" / path.name).write_bytes(path.read_bytes())
    script = Path(__file__).parents[2] / "experiments" / "loop_precision_recall.py"
    arguments = ["--sources", "sim:made", "--seeds", "2", "--reuse", "--out", str(tmp_path), "--", "--seed", "1"]
    monkeypatch.setattr("sys.argv", [str(script), *arguments])
    runpy.run_path(str(script), run_name="__main__")
    table = (tmp_path / "table.md").read_text().splitlines()
    assert len(table) == 2 + 7 + 1
    assert table[2].startswith("| made | 1 | ")
    assert table[-2].endswith(" m |")
    assert "seed 1" in table[-1] and "no true trajectory" in table[-1]
    assert "precision, made" in (tmp_path / "curves.svg").read_text()
    assert json.loads((tmp_path / "results.json").read_text())["made"]["runs"] == 1
