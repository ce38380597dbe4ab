"""Up from surfaces: floors and table tops face it, walls stand along it, and people hold cameras without roll.

Directions in which many surfaces look are candidates, and so is what stands upright on two of them, for who never saw
the floor. Each is judged by three things: how the cameras were held against it (pitch is common, roll is not), which
way its surfaces look (floors and tables are seen from above, the wall ahead is seen from the front), and how much of
what was seen lies across or along it. The best one is made exact by all surfaces near it, robustly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.angles import angle_deg
from vislam.core.geometry import tangent_basis
from vislam.core.messages import Array
from vislam.core.up import Up
from vislam.mapping.upright.normals import REACHES, View

_CAP_DEG = 5.0  # surfaces within it belong to a direction; noise of normals is 2 to 3 degrees
_APART_DEG = 15.0  # directions nearer than this are one
_GRID = 2000  # directions of the hemisphere that are tried, 3 degrees apart
_MOST_NORMALS = 60_000  # in all
_MOST_FOR_PEAKS = 10_000  # that directions are looked for among
_MOST_PEAKS = 8
_PEAK_TIMES = 5.0  # as many surfaces as chance would put there
_CHANCE_CAP = 1.0 - np.cos(np.deg2rad(_CAP_DEG))  # share of all axial directions within the cap
_CHANCE_BAND = np.sin(np.deg2rad(_CAP_DEG))  # share within as much of the plane across a direction
_CROSS_DEG = 60.0  # walls have to differ by so much to stand for what is upright on both
_KERNEL_DEG = 1.5  # Cauchy's, of the last refinement
_MANY = 0.05  # share of surfaces from which on more of them say nothing new
_LEAST_NORMALS = 500
_LEAST_SCORE = 0.55  # below, a camera was not held in any usual way against any direction
_LEAST_LEAD = 0.20  # of the best over the next direction; less is a toss-up
_SURE_LEAD = 0.60  # from here on it is certain
_SYSTEMATIC_DEG = 0.3  # floors and depth cameras are no better
_BLOCKS = 8  # parts of a run that are asked one by one, for the sigma


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    normals: Array  # [N, 3]
    rights: Array  # [K, 3] of images
    upwards: Array  # [K, 3]


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    direction: Array  # [3], up if this is the one
    score: float
    level: float  # share of surfaces that lie across it
    upright: float  # share of surfaces that stand along it


def surest_up(views: Callable[[int], Sequence[View]]) -> Up:
    """Return which way is up by the surfaces of keyframes, by normals over as many pixels as make it surest.

    `views` gives the keyframes by the reach of their normals: noise of a stereo camera's depth hides floors from narrow
    ones. Wider ones may make an answer exact, not another one. Deterministic.
    """
    first, *wider = (up_of_planes(views(reach)) for reach in REACHES)
    return min((first, *(up for up in wider if _refines(up, first))), key=lambda up: up.sigma_deg or 0.0)


def _refines(up: Up, first: Up) -> bool:
    """Return whether the two agree; neither does where one is unknown."""
    if up.direction is None or first.direction is None:
        return False
    return angle_deg(up.direction, first.direction) < _APART_DEG


def up_of_planes(views: Sequence[View]) -> Up:
    """Return which way is up by the surfaces of keyframes; unknown where they do not show it. Deterministic."""
    evidence = _gathered(views)
    if len(evidence.normals) < _LEAST_NORMALS:
        return _unknown(f"{len(views)} keyframes with depth show {len(evidence.normals)} flat places, too few")
    peaks = _peaks(evidence.normals)
    if not peaks:
        return _unknown("no direction stands out among the surfaces: there is no floor, table or wall in sight")
    judged = sorted((_judge(axis, evidence) for axis in _with_crosses(peaks)), key=lambda one: -one.score)
    best = judged[0]
    rivals = [one.score for one in judged[1:] if abs(one.direction @ best.direction) < np.cos(np.deg2rad(_APART_DEG))]
    lead = best.score - max(rivals, default=best.score - 1.0)
    if best.score < _LEAST_SCORE:
        return _unknown(f"the cameras were held in no usual way against any surface (score {best.score:.2f})")
    if lead < _LEAST_LEAD:
        return _unknown(f"two directions of surfaces could be up as well (scores differ by {lead:.2f})")
    up = _refined(best.direction, evidence.normals)
    if up is None:
        return _unknown("the surfaces near the best direction do not make it exact")
    sigma = _sigma_deg(up, views)
    seen = f"{best.level:.0%} of the surfaces lie level, {best.upright:.0%} stand upright"
    return Up("planes", up, sigma, min(1.0, lead / _SURE_LEAD), f"{seen}, of {len(views)} keyframes with depth")


def _unknown(reason: str) -> Up:
    return Up.unknown(f"the surfaces do not show it: {reason}")


def _gathered(views: Sequence[View]) -> _Evidence:
    if not views:
        return _Evidence(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    normals = np.concatenate([view.normals for view in views]).astype(np.float64)
    normals = normals[:: max(1, -(-len(normals) // _MOST_NORMALS))]
    return _Evidence(normals, np.array([view.right for view in views]), np.array([view.upward for view in views]))


def _hemisphere() -> NDArray[np.float32]:
    """Return directions [_GRID, 3] spread evenly over half of the sphere (Fibonacci's lattice)."""
    k = np.arange(_GRID) + 0.5
    z: Array = k / _GRID
    turn: Array = k * np.pi * (1.0 + np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z]).astype(np.float32)


def _peaks(normals: Array) -> list[Array]:
    """Return axes that many surfaces face, the most faced first."""
    grid, left = _hemisphere(), normals
    peaks: list[Array] = []
    least = _PEAK_TIMES * _CHANCE_CAP * len(normals)
    cap = np.cos(np.deg2rad(_CAP_DEG))
    while len(peaks) < _MOST_PEAKS and len(left) >= least:
        some = left[:: max(1, len(left) // _MOST_FOR_PEAKS)].astype(np.float32)
        counts = np.concatenate([np.count_nonzero(np.abs(some @ part.T) > cap, axis=0) for part in np.split(grid, 20)])
        counts = counts * (len(left) / len(some))
        if counts.max() < least:
            break
        axis = _centred(grid[int(counts.argmax())].astype(np.float64), left)
        peaks.append(axis)
        left = left[np.abs(left @ axis) < np.cos(np.deg2rad(_APART_DEG))]
    return peaks


def _centred(axis: Array, normals: Array) -> Array:
    """Return the mean of the surfaces that face an axis, found again and again around the newest mean."""
    for _ in range(10):
        along = normals @ axis
        near = normals[np.abs(along) > np.cos(np.deg2rad(_CAP_DEG))]
        if len(near) == 0:
            return axis
        mean: Array = np.asarray(np.sum(near * np.sign(near @ axis)[:, None], axis=0), dtype=np.float64)
        axis = np.asarray(mean / float(np.linalg.norm(mean)))
    return axis


def _with_crosses(peaks: list[Array]) -> list[Array]:
    """Return the axes, and what is upright on two of them and near none."""
    out = list(peaks)
    for i, a in enumerate(peaks):
        for b in peaks[:i]:
            cross = np.cross(a, b)
            length = float(np.linalg.norm(cross))
            if length < np.sin(np.deg2rad(_CROSS_DEG)):
                continue
            if all(abs(cross / length @ axis) < np.cos(np.deg2rad(_APART_DEG)) for axis in out):
                out.append(cross / length)
    return out


def _judge(axis: Array, evidence: _Evidence) -> _Judged:
    """Return an axis with its sign, and how well it would do as up: at most 1, plus a quarter for its surfaces."""
    held = float(np.mean(evidence.upwards @ axis))  # cosine of the pitch, without roll
    axis, held = (axis, held) if held >= 0.0 else (-axis, -held)
    roll = float(np.sqrt(np.mean((evidence.rights @ axis) ** 2)))
    along = evidence.normals @ axis
    cap, band = np.cos(np.deg2rad(_CAP_DEG)), _CHANCE_BAND
    level, upright = float(np.mean(np.abs(along) > cap)), float(np.mean(np.abs(along) < band))
    above, below = int(np.count_nonzero(along > cap)), int(np.count_nonzero(along < -cap))
    facing = (above - below) / max(above + below, 1) * min(1.0, level / _MANY)
    standing = float(np.clip((upright - band) / (1.0 - band), 0.0, 1.0))
    score = held - roll + 0.25 * facing + 0.25 * standing
    return _Judged(axis, score, level, upright)


def _refined(up: Array, normals: Array) -> Array | None:
    """Return the direction that level and upright surfaces agree on, None where they leave it open."""
    cap, band = np.cos(np.deg2rad(2.0 * _CAP_DEG)), np.sin(np.deg2rad(_CAP_DEG))
    kernel = np.deg2rad(_KERNEL_DEG)
    for _ in range(20):
        B, along = tangent_basis(up), normals @ up
        level, upright = normals[np.abs(along) > cap], normals[np.abs(along) < band]
        off = (level * np.sign(level @ up)[:, None]) @ B  # [N, 2] by how much it leans
        w = 1.0 / (1.0 + np.sum(off**2, axis=1) / kernel**2)
        lean, e = upright @ B, upright @ up  # e + lean @ step = 0
        v = 1.0 / (1.0 + (e / kernel) ** 2)
        H = np.sum(w) * np.eye(2) + (lean * v[:, None]).T @ lean
        if np.linalg.eigvalsh(H)[0] < _LEAST_NORMALS / 10:
            return None
        step = np.linalg.solve(H, w @ off - (v * e) @ lean)
        up = up + B @ step
        up = up / np.linalg.norm(up)
        if float(np.linalg.norm(step)) < 1e-6:
            break
    return np.asarray(up)


def _sigma_deg(up: Array, views: Sequence[View]) -> float:
    """Return how far parts of the run scatter about what all of them say.

    Not divided by their number: what bends a map is odometry's drift, which neighbouring parts share.
    """
    found = []
    for part in np.array_split(np.arange(len(views)), min(_BLOCKS, len(views))):
        normals = _gathered([views[i] for i in part]).normals
        one = _refined(up, normals) if len(normals) >= _LEAST_NORMALS else None
        if one is not None:
            found.append(angle_deg(one, up))
    scatter = float(np.sqrt(np.mean(np.square(found)) / 2.0)) if found else _CAP_DEG
    return float(np.hypot(scatter, _SYSTEMATIC_DEG))
