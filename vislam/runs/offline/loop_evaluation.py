"""How good the loops of a finished run are, stage by stage, against its truth."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopTruthConfig
from vislam.core.errors import DataError
from vislam.core.files import csv_text, write_json, write_text
from vislam.core.messages import Array, LoopDecision, RetrievedKeyframe
from vislam.loop import (
    DOUBTFUL,
    RIGHT,
    WRONG,
    BagOfWords,
    Detections,
    LoopRow,
    TruePlaces,
    Vocabulary,
    bootstrap_interval,
    precision_recall,
    read_loops,
    read_retrieved,
    seed_vocabulary,
    true_places,
)
from vislam.runs.session import Session, StoredKeyframe
from vislam.trajectory import Trajectory, associate, read_trajectory

_NOMINAL_DEPTH_M = 3.0  # of features without depth, to know what two views share
EVALUATION, EDGE_ERRORS = "loops_eval.json", "loops_eval.csv"
_MAX_POINTS = 400  # of a curve that is stored
_MAX_WORST = 20  # edges that are listed
_TEMPORAL = 1  # keyframes before that must have pointed at the same place
_MIN_EXPECTED = 0.005  # similarity to the keyframe before; below it, a ratio is meaningless (Galvez-Lopez 2012)

Answer = tuple[int, float, int]  # row of the keyframe, score, verdict


@dataclass(frozen=True, slots=True, eq=False)
class JudgedEdge:
    """An edge that is in the graph at the end, and by how much it is off."""

    row: LoopRow
    error_m: float
    error_deg: float
    is_gross: bool
    is_apart: bool  # far enough in time to be a loop


@dataclass(frozen=True, slots=True, eq=False)
class JudgedLoops:
    """The loops of a run, or of several, each with its verdict."""

    revisits: NDArray[np.bool_]  # [N] which keyframes see again what an earlier one saw
    stages: dict[str, Detections]  # the best answer of each stage for each keyframe
    edges: list[JudgedEdge]
    proposals: dict[str, tuple[int, int]]  # by source: how many candidates were verified, how many are truly near
    found: dict[str, int]  # keyframes with a truly near one long before, and at how many each step had a right one


def evaluate_loops(run: Path, rule: LoopTruthConfig, reference: Path | None = None) -> dict[str, Any]:
    """Compare the loops of a run with the truth, write what came out into its folder and return the summary.

    `loops_eval.json` holds the summary, `loops_eval.csv` the error of every edge. Raises DataError when the folder
    lacks what is needed.
    """
    judged = judge_loops(run, rule, reference)
    answer = summarise(judged, rule)
    write_json(run / EVALUATION, answer)
    rows = [
        [e.row.from_id, e.row.to_id, f"{e.error_m:.6g}", f"{e.error_deg:.6g}", int(e.is_gross), int(e.is_apart)]
        for e in judged.edges
    ]
    write_text(run / EDGE_ERRORS, csv_text(("from_id", "to_id", "error_m", "error_deg", "gross", "apart"), rows))
    return answer


def judge_loops(run: Path, rule: LoopTruthConfig, reference: Path | None = None) -> JudgedLoops:
    """Judge every stage of loop closing by the truth.

    Stages: what retrieval alone answers (`appearance`), the same scored in the run's last words (`hindsight`), that
    over the similarity to the keyframe before (`normalised`), of the first the places that persisted from the
    keyframe before (`temporal`), verified relative poses (`geometry`), those that the detector accepted (`checks`),
    and those that are in the graph at the end (`graph`). One answer per keyframe and stage: its best; scores are
    similarity or its ratio for the first four, inliers for the others. Raises DataError when the folder lacks what is
    needed.
    """
    truth_path = reference or run / "trajectory_truth.tum"
    if not truth_path.is_file():
        raise DataError(f"{run} has no true trajectory; give --reference FILE")
    places = _places(run / "session.db", read_trajectory(truth_path), rule)
    rows = [row for row in read_loops(run / "loops.csv") if _rows_of(places, row) is not None]
    retrieved = read_retrieved(run / "retrieved.csv")
    hindsight, normalised = _rescored(run / "session.db", retrieved)
    stages = {
        "appearance": _retrieved(retrieved, places, 0),
        "hindsight": _retrieved(hindsight, places, 0),
        "normalised": _retrieved(normalised, places, 0),
        "temporal": _retrieved(retrieved, places, _TEMPORAL),
        "geometry": _verified(rows, places, lambda row: True),
        "checks": _verified(rows, places, lambda row: row.was_offered or row.decision == LoopDecision.ACCEPTED),
        "graph": _verified(rows, places, lambda row: row.decision == LoopDecision.ACCEPTED),
    }
    tried = [row for row in rows if "not verified" not in row.reason]
    found = _found(tried, retrieved, places)
    return JudgedLoops(places.revisits, stages, _judged_edges(rows, places), _proposals(tried, places), found)


def summarise(judged: JudgedLoops, rule: LoopTruthConfig) -> dict[str, Any]:
    """Return the rule, the figures and curves of every stage, and the errors of the edges, as plain data."""
    return {
        "rule": asdict(rule),
        "keyframes": len(judged.revisits),
        "revisits": int(judged.revisits.sum()),
        "stages": {name: _stage(found, judged.revisits, rule) for name, found in judged.stages.items()},
        "edges": _edges(judged.edges),
        "proposals": {source: {"verified": n, "near": near} for source, (n, near) in judged.proposals.items()},
        "found": judged.found,
    }


def _places(session_path: Path, truth: Trajectory, rule: LoopTruthConfig) -> TruePlaces:
    """Return the keyframes that the truth covers."""
    with Session(session_path) as session:
        rig = session.rig()
        if rig.is_blind:
            raise DataError(f"{session_path}: the run had no camera, so that there are no loops to judge")
        first_id = session.first_id  # the truth of older recordings, in whose map a run begins, is not at hand
        stored = [keyframe for keyframe in session.keyframes() if keyframe.id >= first_id]
    t_ns = np.array([keyframe.t_ns for keyframe in stored], dtype=np.int64)
    poses = np.array([keyframe.T_map_body for keyframe in stored]).reshape(-1, 4, 4)
    pairs = associate(Trajectory(t_ns, poses), truth, max_gap_s=rule.max_truth_gap_s)
    kept = [keyframe for keyframe, covered in zip(stored, np.isin(t_ns, pairs.t_ns), strict=True) if covered]
    if not kept:
        raise DataError(f"{session_path}: the truth covers none of {len(stored)} keyframes; do they use one clock?")
    ids = np.array([keyframe.id for keyframe in kept], dtype=np.int64)
    seen = [_seen(keyframe, rig, _NOMINAL_DEPTH_M) for keyframe in kept]
    with_depth = np.array([_knows_depth(keyframe) for keyframe in kept], dtype=np.bool_)
    return true_places(ids, pairs.t_ns, pairs.reference, seen, with_depth, rig, rule)


def _knows_depth(keyframe: StoredKeyframe) -> bool:
    return keyframe.points_body_m is not None and bool(np.isfinite(keyframe.points_body_m).any())


def _seen(keyframe: StoredKeyframe, rig: Any, nominal_depth_m: float) -> Array:
    """Return points [P, 3] in the body frame that a keyframe sees; without depth, features pushed to a nominal one."""
    if keyframe.points_body_m is not None:
        known = np.isfinite(keyframe.points_body_m).all(axis=1)
        if known.any():
            return np.asarray(keyframe.points_body_m[known], dtype=np.float64)
    rays = rig.cameras[0].unproject(keyframe.keypoints_px)
    T = rig.T_body_cams[0]
    points = rays[np.isfinite(rays).all(axis=1)] * nominal_depth_m
    return np.asarray(points @ T[:3, :3].T + T[:3, 3], dtype=np.float64)


def _rows_of(places: TruePlaces, pair: Any) -> tuple[int, int] | None:
    a, b = places.row(pair.from_id), places.row(pair.to_id)
    return None if a is None or b is None else (a, b)


def _retrieved(retrieved: Sequence[RetrievedKeyframe], places: TruePlaces, persistence: int) -> Detections:
    """Return the best answer of retrieval; with `persistence`, of the places that lasted for this many keyframes."""
    answers: list[Answer] = []
    for found in retrieved:
        pair = _rows_of(places, found)
        if pair is not None and places.apart[pair] and found.consistency >= persistence:
            score = found.score if persistence == 0 else found.island_score
            answers.append((pair[1], score, places.image_verdict(*pair)))
    return _best(answers, len(places.ids))


def _rescored(
    session_path: Path, retrieved: Sequence[RetrievedKeyframe]
) -> tuple[list[RetrievedKeyframe], list[RetrievedKeyframe]]:
    """Return what retrieval answered with its similarity in the run's last words, and that normalised.

    Normalised is the score of Galvez-Lopez and Tardos 2012, eq. 2: similarity over that of the keyframe to the one
    before it, the most that its view can reach. Keyframes that do not even look like that one have no such
    answer. A run that trained no words is scored in those that come with vislam.
    """
    asked = {found.to_id for found in retrieved}
    wanted = asked | {found.from_id for found in retrieved}
    bags: dict[int, BagOfWords] = {}
    expected: dict[int, float] = {}
    with Session(session_path) as session:
        trained = session.words()
        words = seed_vocabulary() if trained is None else Vocabulary.from_bytes(trained.data, f"of {session_path}")
        before: BagOfWords | None = None
        for keyframe in session.keyframes():
            bag = words.transform(keyframe.descriptors)
            if keyframe.id in wanted:
                bags[keyframe.id] = bag
            if keyframe.id in asked and before is not None:
                expected[keyframe.id] = bag.score(before)
            before = bag
    known = [found for found in retrieved if found.from_id in bags and found.to_id in bags]
    alike = [replace(found, score=bags[found.from_id].score(bags[found.to_id])) for found in known]
    return alike, [
        replace(found, score=found.score / expected[found.to_id])
        for found in alike
        if expected.get(found.to_id, 0.0) >= _MIN_EXPECTED
    ]


def _verified(rows: list[LoopRow], places: TruePlaces, chosen: Callable[[LoopRow], bool]) -> Detections:
    """Return the best verified answer among the chosen rows: the one with most inliers, judged by its pose."""
    answers: list[Answer] = []
    for row in rows:
        pair = _rows_of(places, row)
        if pair is not None and row.T_from_to is not None and places.apart[pair] and chosen(row):
            gross = places.is_gross(places.pose_error(*pair, row.T_from_to))
            answers.append((pair[1], row.inliers, WRONG if gross else RIGHT))
    return _best(answers, len(places.ids))


def _proposals(tried: Sequence[LoopRow], places: TruePlaces) -> dict[str, tuple[int, int]]:
    """Return by source how many candidates were verified, and how many of them are truly near."""
    out: dict[str, tuple[int, int]] = {}
    for row in tried:
        pair = _rows_of(places, row)
        if pair is not None:
            count, near = out.get(row.source, (0, 0))
            out[row.source] = (count + 1, near + int(places.near[pair]))
    return out


def _found(
    tried: Sequence[LoopRow], retrieved: Sequence[RetrievedKeyframe], places: TruePlaces
) -> dict[str, int]:  # fmt: skip
    """Return at how many keyframes that have a truly near one long before each step came upon one that is right."""
    near = places.near & places.apart & np.tri(len(places.ids), k=-1, dtype=np.bool_)
    steps = {name: np.zeros(len(places.ids), np.bool_) for name in ("retrieved", "proposed", "posed", "accepted")}
    for seen in retrieved:
        pair = _rows_of(places, seen)
        if pair is not None and near[pair[1], pair[0]]:
            steps["retrieved"][pair[1]] = True
    for row in tried:
        pair = _rows_of(places, row)
        if pair is None or not places.apart[pair]:
            continue
        steps["proposed"][pair[1]] |= near[pair[1], pair[0]]
        if row.T_from_to is not None and not places.is_gross(places.pose_error(*pair, row.T_from_to)):
            steps["posed"][pair[1]] = True
            steps["accepted"][pair[1]] |= row.decision == LoopDecision.ACCEPTED
    has_near = near.any(axis=1)
    return {"near": int(has_near.sum()), **{name: int((has_near & hit).sum()) for name, hit in steps.items()}}


def _best(answers: Iterable[Answer], count: int) -> Detections:
    score, verdict = np.full(count, np.nan), np.full(count, DOUBTFUL, dtype=np.int64)
    for k, value, judged in answers:
        if not score[k] >= value:
            score[k], verdict[k] = value, judged
    return Detections(score, verdict)


def _stage(found: Detections, revisits: Any, rule: LoopTruthConfig) -> dict[str, Any]:
    curve = precision_recall(found, revisits)
    low, high = bootstrap_interval(found, revisits, rule)
    step = max(1, -(-len(curve.recall) // _MAX_POINTS))
    kept = np.unique(np.append(np.arange(0, len(curve.recall), step), len(curve.recall) - 1))[-_MAX_POINTS - 1 :]
    kept = kept[kept >= 0]
    return {
        "answers": int(np.isfinite(found.score).sum()),
        "wrong": int((found.verdict == WRONG).sum()),
        "precision": float(curve.precision[-1]) if len(curve.precision) else None,
        "recall": float(curve.recall[-1]) if len(curve.recall) else 0.0,
        "recall_at_full_precision": curve.recall_at_full_precision,
        "interval": [low, high],
        "curve": {name: getattr(curve, name)[kept].tolist() for name in ("threshold", "precision", "recall")},
    }


def _judged_edges(rows: list[LoopRow], places: TruePlaces) -> list[JudgedEdge]:
    """Return all edges that are in the graph at the end, near ones included."""
    out = []
    for row in rows:
        pair = _rows_of(places, row)
        if row.decision == LoopDecision.ACCEPTED and row.T_from_to is not None and pair is not None:
            error = places.pose_error(*pair, row.T_from_to)
            out.append(JudgedEdge(row, *error, places.is_gross(error), bool(places.apart[pair])))
    return out


def _edges(edges: list[JudgedEdge]) -> dict[str, Any]:
    """Return counts, the spread of the errors and the worst edges."""
    metres = np.array([edge.error_m for edge in edges])
    degrees = np.array([edge.error_deg for edge in edges])

    def spread(values: Array) -> dict[str, float | None]:
        known = map(float, np.percentile(values, [50.0, 95.0, 100.0])) if len(values) else [None] * 3
        return dict(zip(("median", "p95", "max"), known, strict=True))

    worst = sorted(edges, key=lambda edge: (-edge.is_gross, -edge.error_m))[:_MAX_WORST]
    return {
        "accepted": len(edges),
        "apart": sum(edge.is_apart for edge in edges),
        "gross": sum(edge.is_gross for edge in edges),
        "error_m": spread(metres),
        "error_deg": spread(degrees),
        "errors_m": np.sort(metres)[:: -(-max(len(metres), 1) // _MAX_POINTS)].tolist(),
        "worst": [
            {
                "from_id": edge.row.from_id, "to_id": edge.row.to_id, "error_m": edge.error_m,
                "error_deg": edge.error_deg, "inliers": edge.row.inliers, "sigma_m": edge.row.sigma_m,
                "gross": edge.is_gross, "reason": edge.row.reason,
            }
            for edge in worst
        ],
    }  # fmt: skip
