"""What readers of pose-graph files share: poses and edges as lines gave them become a checked PoseGraphProblem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.messages import Array

_NORM_TOLERANCE = 0.02  # files round quaternions to as few as 4 decimals
_FARTHEST_M = 1e15  # beyond, a double knows no metre
_INFORMATION = (
    1e-24,
    1e24,
)  # largest entry, 1/rad^2, 1/m^2: what is outside is meaningless, or more than can be known
_REPAIRED = 1e-9  # of the largest eigenvalue: least of a repaired matrix
_NEGATIVE = 1e-6  # of the largest eigenvalue: what files' rounding makes of a zero one


@dataclass(frozen=True, slots=True, eq=False)
class PoseLines:
    """Poses as a file's lines gave them, in its order."""

    ids: Ids  # [M]
    poses: Array  # [M, d + 1, d + 1]
    lines: Ids  # [M]


@dataclass(frozen=True, slots=True, eq=False)
class EdgeLines:
    """Edges as a file's lines gave them, in its order."""

    ids: Ids  # [E, 2]
    measurements: Array  # [E, d + 1, d + 1]
    information: Array  # [E, k, k] rotation, then translation
    lines: Ids  # [E]


def poses_from_quaternions(path: Path, positions: Array, q_xyzw: Array, lines: Ids) -> Array:
    """Return transforms [M, 4, 4] of positions [M, 3] and quaternions [M, 4]; these may be off norm 1 by rounding.

    Raises DataError with the line of a quaternion of another norm.
    """
    squared = np.einsum("ij,ij->i", q_xyzw, q_xyzw)
    off = ~(np.abs(squared - 1.0) < 2.0 * _NORM_TOLERANCE)
    if off.any():
        i = int(np.argmax(off))
        raise DataError(f"{path}:{lines[i]}: the quaternion has norm {np.sqrt(squared[i]):.4g} instead of 1")
    poses = np.empty((len(positions), 4, 4))
    _fill_poses(np.ascontiguousarray(positions), np.ascontiguousarray(q_xyzw), poses)
    return poses


def poses_from_angles(xy: Array, angles_rad: Array) -> Array:
    """Return transforms [M, 3, 3] of positions [M, 2] and headings [M]."""
    poses = np.zeros((len(xy), 3, 3))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angles_rad)
    poses[:, 1, 0] = np.sin(angles_rad)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, :2, 2] = xy
    poses[:, 2, 2] = 1.0
    return poses


def symmetric(upper: Array, order: tuple[int, ...]) -> Array:
    """Return matrices [M, k, k] of their upper triangles [M, k (k + 1) / 2] in rows, moved so that `order` comes first.

    `order[a]` is the place that the file gives to our a-th component.
    """
    k = len(order)
    place = np.empty((k, k), dtype=np.int64)
    place[np.triu_indices(k)] = np.arange(k * (k + 1) // 2)
    place = np.triu(place) + np.triu(place, 1).T
    return np.ascontiguousarray(upper[:, place[np.ix_(order, order)]])


def problem_from_lines(
    path: Path,
    dimension: int,
    poses: PoseLines,
    edges: EdgeLines,
    fixed_ids: tuple[tuple[int, int], ...] = (),
    passed_lines: tuple[str, ...] = (),
    repair: bool = False,
) -> PoseGraphProblem:
    """Return the checked problem; `fixed_ids` are (line, id). With `repair` negative information is made positive.

    A pose that only edges name has no initial value. A pose that is given twice alike counts once, several edges
    between two poses all count; `notes` state it. Raises DataError with the line for a pose given twice with different
    values, an edge from a pose to itself, information that is negative or zero, and a fixed pose that is none.
    """
    notes: list[str] = []
    _check_reach(path, poses.poses, poses.lines)
    _check_reach(path, edges.measurements, edges.lines)
    _check_information(path, edges)
    poses = _without_repetition(path, poses, notes)
    ids = np.unique(np.concatenate([poses.ids, edges.ids.ravel()]))
    if not len(ids):
        raise DataError(f"{path} holds no poses; is it a pose graph?")
    start = np.full((len(ids), dimension + 1, dimension + 1), np.nan)
    start[np.searchsorted(ids, poses.ids)] = poses.poses
    loops = edges.ids[:, 0] == edges.ids[:, 1]
    if loops.any():
        i = int(np.argmax(loops))
        raise DataError(f"{path}:{edges.lines[i]}: an edge from pose {edges.ids[i, 0]} to itself; remove the line")
    edges = _with_sound_information(path, edges, repair, notes)
    fixed = np.zeros(len(ids), dtype=np.bool_)
    for line, pose_id in fixed_ids:
        at = int(np.searchsorted(ids, pose_id))
        if at == len(ids) or ids[at] != pose_id:
            raise DataError(f"{path}:{line}: pose {pose_id} is to be fixed, but there is none")
        fixed[at] = True
    missing = ids[np.isnan(start[:, 0, 0])]
    if len(missing):
        notes.append(f"{len(missing)} of {len(ids)} poses have no initial value (the first: {missing[0]})")
    if len(passed_lines):
        notes.append(f"{len(passed_lines)} lines of parameters are kept as they are")
    problem = PoseGraphProblem(
        dimension, ids, start, fixed, np.searchsorted(ids, edges.ids), edges.measurements, edges.information,
        passed_lines, tuple(notes + _notes_on_edges(edges.ids)),
    )  # fmt: skip
    return problem


def _check_reach(path: Path, poses: Array, lines: Ids) -> None:
    """Raise DataError with the line of a pose or measurement that is too far away to count with."""
    d = poses.shape[1] - 1
    near = np.isfinite(poses).all(axis=(1, 2)) & (np.abs(poses[:, :d, d]).max(axis=1, initial=0.0) <= _FARTHEST_M)
    if not near.all():
        i = int(np.argmin(near))
        far_m = float(np.abs(poses[i, :d, d]).max())
        raise DataError(f"{path}:{lines[i]}: {far_m:.3g} m are too far, {_FARTHEST_M:g} m at most; repair the line")


def _check_information(path: Path, edges: EdgeLines) -> None:
    """Raise DataError with the line of an edge whose information is too large or too small to count with."""
    low, high = _INFORMATION
    largest = np.abs(edges.information).max(axis=(1, 2), initial=0.0)
    good = (largest == 0.0) | ((largest >= low) & (largest <= high))  # zero is refused in words of its own
    if not good.all():
        i = int(np.argmin(good))
        raise DataError(
            f"{path}:{edges.lines[i]}: information of {largest[i]:.3g} cannot be used, {low:g} to {high:g} can; repair "
            "the line"
        )


def _without_repetition(path: Path, poses: PoseLines, notes: list[str]) -> PoseLines:
    if np.all(np.diff(poses.ids) > 0):
        return poses
    order = np.argsort(poses.ids, kind="stable")
    ids, values, lines = poses.ids[order], poses.poses[order], poses.lines[order]
    again = np.flatnonzero(np.diff(ids) == 0) + 1
    differs = again[np.any(values[again] != values[again - 1], axis=(1, 2))]
    if len(differs):
        i = int(differs[0])
        raise DataError(f"{path}:{lines[i]}: pose {ids[i]} was given other values in line {lines[i - 1]}; keep one")
    if len(again):
        notes.append(f"{len(again)} poses are given twice, with the same values (the first: {ids[again[0]]})")
    first = np.ones(len(ids), dtype=np.bool_)
    first[again] = False
    return PoseLines(ids[first], values[first], lines[first])


def _notes_on_edges(ids: Ids) -> list[str]:
    low, high = ids.min(axis=1, initial=2**62), ids.max(axis=1, initial=0)
    order = np.lexsort((high, low))
    again = (np.diff(low[order]) == 0) & (np.diff(high[order]) == 0)
    if not again.any():
        return []
    i = order[int(np.argmax(again))]
    return [f"{int(again.sum())} edges join poses that another one joins too (the first: {low[i]} and {high[i]})"]


def _with_sound_information(path: Path, edges: EdgeLines, repair: bool, notes: list[str]) -> EdgeLines:
    """Return edges whose information is positive semidefinite. Raises DataError for others, unless they are repaired.

    Repaired is by the nearest matrix, in Frobenius' norm, without eigenvalues below a billionth of the largest (Higham,
    "Computing a nearest symmetric positive semidefinite matrix", 1988). Information of zero cannot be repaired.
    """
    wrong, eigenvalues = _indefinite(edges.information)
    if not len(wrong):
        return edges
    empty = np.flatnonzero(eigenvalues[:, -1] <= 0.0)
    first = int(empty[0]) if repair and len(empty) else 0
    where, least = f"{path}:{edges.lines[wrong[first]]}", eigenvalues[first, 0]
    if not edges.information[wrong[first]].any():
        raise DataError(f"{where}: the information is zero: the edge has no effect; remove the line")
    least_is = f"its smallest eigenvalue is {least:.4g}"
    if repair and len(empty):
        raise DataError(f"{where}: the information is not positive in any direction: {least_is}; remove the line")
    if not repair:
        raise DataError(
            f"{where}: the information is not positive: {least_is}; so are {len(wrong)} of {len(edges.lines)} edges; "
            "--repair-information takes the nearest positive ones"
        )
    notes.append(
        f"the information of {len(wrong)} of {len(edges.lines)} edges was not positive (the first: line "
        f"{edges.lines[wrong[0]]}, {least_is}); the nearest positive definite one was taken"
    )
    values, vectors = np.linalg.eigh(edges.information[wrong])
    values = np.maximum(values, _REPAIRED * values[:, -1:])
    information = edges.information.copy()
    repaired = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    information[wrong] = 0.5 * (repaired + repaired.transpose(0, 2, 1))
    return replace(edges, information=information)


def _indefinite(information: Array) -> tuple[Ids, Array]:
    """Return which of the matrices [M, k, k] are zero or have a negative eigenvalue [W], and eigenvalues [W, k]."""
    suspects: Ids = np.flatnonzero(_not_definite(information))
    eigenvalues = np.asarray(np.linalg.eigvalsh(information[suspects]), dtype=np.float64)
    wrong = (eigenvalues[:, -1] <= 0.0) | (eigenvalues[:, 0] < -_NEGATIVE * eigenvalues[:, -1])
    return suspects[wrong], eigenvalues[wrong]


@njit(cache=True)
def _not_definite(information: Array) -> NDArray[np.bool_]:
    """Return which matrices [M, k, k] have no Cholesky factor."""
    out = np.zeros(len(information), dtype=np.bool_)
    k = information.shape[1]
    L = np.empty((k, k))
    for e in range(len(information)):
        for j in range(k):
            for i in range(j, k):
                s = information[e, i, j]
                for q in range(j):
                    s -= L[i, q] * L[j, q]
                if i > j:
                    L[i, j] = s / L[j, j]
                elif s > 0.0:
                    L[j, j] = np.sqrt(s)
                else:
                    out[e] = True
                    break
            if out[e]:
                break
    return out


@njit(cache=True)
def _fill_poses(positions: Array, q_xyzw: Array, out: Array) -> None:
    for i in range(len(out)):
        x, y, z, w = q_xyzw[i, 0], q_xyzw[i, 1], q_xyzw[i, 2], q_xyzw[i, 3]
        s = 2.0 / (x * x + y * y + z * z + w * w)
        T = out[i]
        T[0, 0], T[0, 1], T[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
        T[1, 0], T[1, 1], T[1, 2] = s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)
        T[2, 0], T[2, 1], T[2, 2] = s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)
        T[0, 3], T[1, 3], T[2, 3] = positions[i, 0], positions[i, 1], positions[i, 2]
        T[3, 0], T[3, 1], T[3, 2], T[3, 3] = 0.0, 0.0, 0.0, 1.0
