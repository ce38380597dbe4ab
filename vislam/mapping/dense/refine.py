"""Poses of all keyframes at once, by the depth images of those that see the same surfaces.

Multiway registration (Choi, Zhou and Koltun, "Robust reconstruction of indoor scenes", CVPR 2015), but with the
equations of all pairs rebuilt at the poses of all keyframes in every step, so no pair's own optimum is trusted.
The poses that came in are priors, of each keyframe and of each against the one before: what surfaces do not show stays.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from vislam.core.geometry import invert, se3_adjoint, se3_exp, se3_log
from vislam.core.messages import Array
from vislam.mapping.cloud.store import KeyframeStore
from vislam.mapping.dense.pairs import Equations, Seen, equations, overlap, seen_in
from vislam.mapping.depth.image import DepthView
from vislam.mapping.mesh.posed import PosedView, posed_views

_MOST = 1000  # keyframes: 300 kB each, and every two are looked at
_COLUMNS = 160  # of the grid that planes are on
_GATES_M = (0.10, 0.07, 0.05, 0.04, 0.03, 0.03)  # by step, coarse to fine
_STEPS_PX = (4, 4, 2, 2, 2, 2)  # of the grid, between samples
_LOOK_PX = 8  # between samples that show whether two views overlap
_LEAST_OVERLAP = 0.3  # share of a view's samples that meet the other's surfaces
_REACH_M = 3.0  # between two cameras that are asked
_PARTNERS = 12  # of a keyframe among older ones, evenly over time
_SAME_WAY = 0.3  # cosine between two views' axes
_LEAST_GAIN = 0.02  # of the cost; poses that fit so well already are left alone
_BEFORE = 2  # keyframes just before that are always among them
_SIGMA_STEP = np.array([0.01] * 3 + [0.01] * 3)  # rad, m: of the motion between two keyframes
_SIGMA_POSE = np.array([0.05] * 3 + [0.10] * 3)  # rad, m: of a keyframe in the map


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Poses that fit depth, and what was found.

    Attributes:
        T_map_view: [N, 4, 4].
        pairs: of views that see the same surfaces.
        cost_before: mean over pairs of squared distance in sigmas, at the poses that came in.
        cost_after: the same at the poses that come out.
    """

    T_map_view: Array
    pairs: int
    cost_before: float
    cost_after: float


def refined_poses(
    store: KeyframeStore, T_map_body: Mapping[int, Array], view: DepthView
) -> tuple[dict[int, Array], dict[str, Any]]:
    """Return the poses of keyframes that fit their depth images to each other, and what was found.

    Args:
        store: with the depth images; keyframes without one keep their poses.
        T_map_body: poses [4, 4] as they are.
        view: of the depth images.

    Returns:
        All poses in the order of ids, empty where they are no gain; pairs and costs, or why it was refused.
    """
    poses = dict(sorted(T_map_body.items()))
    ids = [i for i in poses if (packed := store.packed(i)) is not None and packed.depth_png]
    if len(ids) > _MOST:
        return {}, {"refused": f"{len(ids)} keyframes with depth, more than {_MOST}"}
    found = refined(posed_views(((store.scan(i), poses[i]) for i in ids), view))
    report = {"pairs": found.pairs, "cost_before": found.cost_before, "cost_after": found.cost_after}
    if not found.cost_after < found.cost_before:
        return {}, report
    T_refined = found.T_map_view @ invert(view.T_body_view)
    return poses | dict(zip(ids, T_refined, strict=True)), report


def refined(views: Iterable[PosedView]) -> Refined:
    """Return the poses that fit the depth of all views best; those that came in where that is no gain.

    Views are in the order of time and have pictures of one size.
    """
    seen, start = [], []
    for view in views:
        step = max(1, round(view.depth_m.shape[1] / _COLUMNS))
        seen.append(seen_in(view.depth_m, view.K, step, view.max_range_m))
        start.append(view.T_map_view)
    T0 = np.array(start, np.float64).reshape(-1, 4, 4)
    pairs = overlapping(seen, T0)
    if not pairs:
        return Refined(T0, 0, 0.0, 0.0)
    T = T0.copy()
    for gate_m, step in zip(_GATES_M, _STEPS_PX, strict=True):
        systems = [equations(seen[a], seen[b], invert(T[b]) @ T[a], gate_m, step) for a, b in pairs]
        T = _moved(T, T0, pairs, systems)
    before, after = (_cost(seen, pairs, poses) for poses in (T0, T))
    is_better = after < (1.0 - _LEAST_GAIN) * before
    return Refined(T if is_better else T0, len(pairs), before, after if is_better else before)


def overlapping(seen: list[Seen], T_map_view: Array) -> list[tuple[int, int]]:
    """Return pairs (newer, older) of views that see the same surfaces."""
    pairs: list[tuple[int, int]] = []
    for a in range(len(seen)):
        is_near = T_map_view[:a, :3, 2] @ T_map_view[a, :3, 2] > _SAME_WAY
        is_near &= np.linalg.norm(T_map_view[:a, :3, 3] - T_map_view[a, :3, 3], axis=1) < _REACH_M
        found = []
        for b in np.flatnonzero(is_near).tolist():
            T_b_a = invert(T_map_view[b]) @ T_map_view[a]
            if overlap(seen[a], seen[b], T_b_a, _GATES_M[0], _LOOK_PX) > _LEAST_OVERLAP:
                found.append(b)
        near, far = [b for b in found if b >= a - _BEFORE], [b for b in found if b < a - _BEFORE]
        chosen = np.unique(np.linspace(0, len(far) - 1, min(_PARTNERS - _BEFORE, len(far))).round().astype(int))
        pairs += [(a, far[k]) for k in chosen] + [(a, b) for b in near]
    return pairs


def _cost(seen: list[Seen], pairs: list[tuple[int, int]], T: Array) -> float:
    systems = [equations(seen[a], seen[b], invert(T[b]) @ T[a], _GATES_M[-1], _STEPS_PX[0]) for a, b in pairs]
    return float(np.mean([pair.cost for pair in systems]))


def _moved(T: Array, T0: Array, pairs: list[tuple[int, int]], systems: list[Equations]) -> Array:
    """Return the poses [N, 4, 4] after one step of Gauss-Newton, each moved in its own frame."""
    blocks: list[tuple[int, int, Array]] = []
    g = np.zeros((len(T), 6))
    # a pair moves a against b: in a's frame, b's motion comes in by the adjoint
    for (a, b), pair in zip(pairs, systems, strict=True):
        _add(blocks, g, (a, b), pair.H, pair.g, se3_adjoint(invert(T[a]) @ T[b]))
    for k in range(len(T)):
        H = np.diag(_SIGMA_POSE**-2)
        blocks.append((k, k, H))
        g[k] += H @ se3_log(invert(T0[k]) @ T[k])
    for a in range(1, len(T)):
        H = np.diag(_SIGMA_STEP**-2)
        error = se3_log(invert(invert(T0[a - 1]) @ T0[a]) @ (invert(T[a - 1]) @ T[a]))
        _add(blocks, g, (a, a - 1), H, H @ error, se3_adjoint(invert(T[a]) @ T[a - 1]))
    at = np.array([(i, j) for i, j, _ in blocks])
    row, column = np.meshgrid(np.arange(6), np.arange(6), indexing="ij")
    rows, columns = 6 * at[:, :1] + row.ravel(), 6 * at[:, 1:] + column.ravel()
    values = np.array([block for _, _, block in blocks]).reshape(len(blocks), 36)
    whole = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(g.size, g.size)).tocsc()
    x = spsolve(whole, -g.ravel()).reshape(-1, 6)
    return np.array([pose @ se3_exp(step) for pose, step in zip(T, x, strict=True)])


def _add(
    blocks: list[tuple[int, int, Array]], g: Array, pair: tuple[int, int], H: Array, gradient: Array, adjoint: Array
) -> None:
    a, b = pair
    blocks += [(a, a, H), (a, b, -H @ adjoint), (b, a, -adjoint.T @ H), (b, b, adjoint.T @ H @ adjoint)]
    g[a] += gradient
    g[b] -= adjoint.T @ gradient
