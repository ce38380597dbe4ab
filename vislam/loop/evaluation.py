"""Loops against the truth: which pairs are revisits, how far each edge is off, precision and recall.

What a loop is worth is the error of its relative pose; whether its two images show the same place (the rule of most
papers) is what can be asked of retrieval, which has no pose. Recall at full precision depends on both rules, so they
are part of every answer (`LoopTruthConfig`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopTruthConfig
from vislam.core.camera import Rig
from vislam.core.geometry import invert, invert_many, so3_log, transform_points
from vislam.core.messages import Array
from vislam.loop.candidates import overlaps, view_bounds

_DOUBTFUL_OVERLAP = 0.05  # between this and min_overlap a retrieved image is neither right nor wrong
_RESAMPLES = 1000  # of the bootstrap
_BLOCK_KEYFRAMES = 10  # drawn together, because what follows each other errs alike
_CONFIDENCE = 0.95
_PROBES = 64  # points per keyframe that are looked for in the other views
RIGHT, DOUBTFUL, WRONG = 1, 0, -1  # verdicts


@dataclass(frozen=True, eq=False)
class TruePlaces:
    """Keyframes with their true poses, and which of them truly see the same."""

    ids: NDArray[np.int64]  # [N]
    t_ns: NDArray[np.int64]  # [N]
    T_world_body: Array  # [N, 4, 4]
    overlap: Array  # [N, N], 0..1, symmetric
    apart: NDArray[np.bool_]  # [N, N] far enough in time to be a loop
    with_depth: NDArray[np.bool_]  # [N] a relative pose with such an end has a scale
    rule: LoopTruthConfig

    def row(self, keyframe_id: int) -> int | None:
        """Return the place of a keyframe in the arrays; None: the truth does not cover it."""
        k = int(np.searchsorted(self.ids, keyframe_id))
        return k if k < len(self.ids) and self.ids[k] == keyframe_id else None

    @property
    def revisits(self) -> NDArray[np.bool_]:
        """Which keyframes [N] see again what an earlier one saw long before."""
        earlier = np.tri(len(self.ids), k=-1, dtype=np.bool_)
        return np.asarray((self.apart & earlier & (self.overlap > self.rule.min_overlap)).any(axis=1), dtype=np.bool_)

    @cached_property
    def near(self) -> NDArray[np.bool_]:
        """Which pairs [N, N] are truly near: in place, in heading, and in what they see."""
        positions, rotations = self.T_world_body[:, :3, 3], self.T_world_body[:, :3, :3]
        apart_m = np.linalg.norm(positions[:, None] - positions[None], axis=2)
        cosine = 0.5 * (np.einsum("aij,bij->ab", rotations, rotations) - 1.0)
        turned_deg = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
        near = (apart_m < self.rule.near_m) & (turned_deg < self.rule.near_deg)
        return np.asarray(near & (self.overlap > self.rule.min_overlap), dtype=np.bool_)

    def image_verdict(self, a: int, b: int) -> int:
        """Say whether two rows show the same place, by how much their views overlap."""
        if self.overlap[a, b] > self.rule.min_overlap:
            return RIGHT
        return DOUBTFUL if self.overlap[a, b] > _DOUBTFUL_OVERLAP else WRONG

    def pose_error(self, a: int, b: int, T_a_b: Array) -> tuple[float, float]:
        """Return the error of a measured relative pose in m and degrees; a unit direction is given the true length."""
        true = invert(self.T_world_body[a]) @ self.T_world_body[b]
        length = 1.0 if self.with_depth[a] or self.with_depth[b] else float(np.linalg.norm(true[:3, 3]))
        turn = so3_log(np.ascontiguousarray(T_a_b[:3, :3].T @ true[:3, :3]))
        return float(np.linalg.norm(length * T_a_b[:3, 3] - true[:3, 3])), float(np.rad2deg(np.linalg.norm(turn)))

    def is_gross(self, error: tuple[float, float]) -> bool:
        """Say whether an edge with this error in m and degrees would ruin a map."""
        return not (error[0] <= self.rule.gross_m and error[1] <= self.rule.gross_deg)


def true_places(
    ids: NDArray[np.int64], t_ns: NDArray[np.int64], T_world_body: Array, seen_body_m: list[Array],
    with_depth: NDArray[np.bool_], rig: Rig, rule: LoopTruthConfig,
) -> TruePlaces:  # fmt: skip
    """Compare all keyframes by their true poses.

    Args:
        ids: of the keyframes [N], ascending.
        t_ns: their times [N].
        T_world_body: their true poses [N, 4, 4].
        seen_body_m: per keyframe some points [P, 3] that it sees, in its body frame.
        with_depth: which keyframes [N] measured the depth of any.
        rig: the cameras.
        rule: when a pair is a revisit.

    The overlap of two views is the share of one's points that the other has in its image at a like distance and angle
    (`loop.candidates.overlaps`), the mean of both ways. Walls between are not known.
    """
    T_world_cams = T_world_body @ rig.T_body_cams[0]
    T_cam_worlds, bounds = np.ascontiguousarray(invert_many(T_world_cams)), view_bounds(rig.cameras[0])
    overlap = np.zeros((len(ids), len(ids)))
    for k, points in enumerate(seen_body_m):
        if len(points):
            chosen = transform_points(T_world_body[k], points[:: -(-len(points) // _PROBES)])
            overlap[k] = overlaps(np.ascontiguousarray(chosen), T_world_cams[k, :3, 3], T_cam_worlds, bounds)
    seconds = np.abs(t_ns[:, None] - t_ns[None, :]) * 1e-9
    apart = (seconds >= rule.min_apart_s) | (np.abs(ids[:, None] - ids[None, :]) > rule.min_apart_keyframes)
    return TruePlaces(ids, t_ns, T_world_body, 0.5 * (overlap + overlap.T), apart, with_depth, rule)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """The best answer of a stage for each keyframe; score NaN: none."""

    score: Array  # [N] higher is surer
    verdict: NDArray[np.int64]  # [N] RIGHT, DOUBTFUL or WRONG


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Precision and recall over falling thresholds, one point per distinct score."""

    threshold: Array  # [K]
    precision: Array  # [K], 1 where nothing right or wrong is above the threshold
    recall: Array  # [K]

    @property
    def recall_at_full_precision(self) -> float:
        """The largest recall without a single wrong answer."""
        pure = self.precision >= 1.0
        return float(self.recall[pure].max(initial=0.0))


def precision_recall(found: Detections, revisits: NDArray[np.bool_]) -> Curve:
    """Return the curve of a stage; `revisits` [N]: whether there is a loop to be found for a keyframe.

    Right answers count for precision wherever they are, for recall only at revisits. Doubtful ones count for neither.
    """
    known = np.flatnonzero(np.isfinite(found.score))
    order = known[np.argsort(-found.score[known], kind="stable")]
    score, verdict = found.score[order], found.verdict[order]
    last = np.append(score[1:] != score[:-1], True) if len(score) else np.empty(0, np.bool_)  # equal scores go together
    right, wrong = np.cumsum(verdict == RIGHT)[last], np.cumsum(verdict == WRONG)[last]
    hits = np.cumsum((verdict == RIGHT) & revisits[order])[last]
    decided = right + wrong
    precision = np.where(decided > 0, right / np.maximum(decided, 1), 1.0)
    return Curve(score[last], precision, hits / max(int(revisits.sum()), 1))


def bootstrap_interval(found: Detections, revisits: NDArray[np.bool_], rule: LoopTruthConfig) -> tuple[float, float]:
    """Return an interval of the recall at full precision: blocks of keyframes drawn with replacement, percentiles.

    Blocks, because neighbours err alike (Künsch 1989). A single wrong answer with a high score decides this figure,
    so intervals are wide, and rightly so. NaN without revisits.
    """
    count, size = len(revisits), max(1, _BLOCK_KEYFRAMES)
    if not revisits.any():
        return float("nan"), float("nan")
    rng = np.random.default_rng(rule.seed)
    blocks = -(-count // size)
    values = []
    for starts in rng.integers(0, count, (_RESAMPLES, blocks)):
        drawn = ((starts[:, None] + np.arange(size)) % count).ravel()[:count]
        if revisits[drawn].any():
            again = Detections(found.score[drawn], found.verdict[drawn])
            values.append(precision_recall(again, revisits[drawn]).recall_at_full_precision)
    tail = 50.0 * (1.0 - _CONFIDENCE)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)
