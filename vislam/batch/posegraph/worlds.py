"""Pose graphs of any size with known truth: lattice, torus and sphere in space, a Manhattan world in the plane.

They are the shapes that the field compares on (Carlone et al., ICRA 2015; Olson et al., ICRA 2006): a path winds over
the shape in steps of a metre, and loops join poses that are near each other. The error of a measurement against the
truth is drawn from the noise that its information states, so at the truth chi2 is about the number of measured numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.batch.posegraph.arithmetic import retract_2d, retract_3d
from vislam.batch.posegraph.g2o import write_g2o
from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.batch.posegraph.starts import odometry_start
from vislam.config import GraphWorldConfig
from vislam.core.errors import UsageError
from vislam.core.files import write_text
from vislam.core.geometry import invert_many
from vislam.core.messages import Array
from vislam.trajectory import Trajectory, write_tum

Shape = Literal["grid3d", "torus", "sphere", "manhattan"]

_MAX_POSES = 2_000_000
_MAX_EDGES = 20_000_000  # a measurement and its information take 420 bytes
_BLOCK_STEPS = 4  # steps before the Manhattan path may turn
_MAX_LOOP_M = 5.0  # farther apart no loop is made, however many were asked for
_FALSE_M = 10.0  # a false loop joins poses that are really this far apart at least


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedGraph:
    """A made pose graph: its start is odometry chained from the true first pose."""

    problem: PoseGraphProblem  # edges in the order of their later pose, odometry before loops
    truth: Array  # [N, d + 1, d + 1] T_world_pose
    outlier: NDArray[np.bool_]  # [E] false loops


def simulate_graph(shape: Shape, world: GraphWorldConfig) -> SimulatedGraph:
    """Make a pose graph; the same settings give the same numbers. Raises UsageError for what cannot be made."""
    _check(shape, world)
    rng = np.random.default_rng(world.seed)
    truth = _PATHS[shape](world.poses, rng)
    d = truth.shape[1] - 1
    loops = _near_pairs(truth[:, :d, d], round(world.loops_per_pose * world.poses), rng)
    return measured_graph(truth, loops, world, rng)


def measured_graph(truth: Array, loops: Ids, world: GraphWorldConfig, rng: np.random.Generator) -> SimulatedGraph:
    """Measure odometry along true poses [N, d + 1, d + 1] and true loops [L, 2] between them, and add false ones."""
    d = truth.shape[1] - 1
    odometry = np.column_stack([np.arange(len(truth) - 1), np.arange(1, len(truth))])
    count = round(world.outlier_fraction / (1.0 - world.outlier_fraction) * len(loops))
    false, shift = false_loops(truth, count, world.alias_group, rng)
    edges = np.concatenate([odometry, loops, false])
    between = invert_many(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    if len(false):
        between[-len(false) :] = invert_many(truth[false[:, 0]]) @ shift @ truth[false[:, 1]]
    sigma = _sigmas(world, d)
    measured = between @ invert_many(_pose(rng.normal(size=(len(edges), len(sigma))) * sigma, d))
    kind = np.repeat([0, 1, 2], [len(odometry), len(loops), len(false)])
    order = np.lexsort((edges[:, 0], kind, edges[:, 1]))
    problem = PoseGraphProblem(
        dimension=d,
        ids=np.arange(len(truth)),
        poses=np.concatenate([truth[:1], np.full_like(truth[1:], np.nan)]),
        fixed=np.zeros(len(truth), dtype=bool),
        edges=np.ascontiguousarray(edges[order]),
        measurements=np.ascontiguousarray(measured[order]),
        information=np.tile(np.diag(sigma**-2.0), (len(edges), 1, 1)),
    )
    chained = problem.with_poses(odometry_start(problem, problem.anchors()))
    return SimulatedGraph(chained, truth, kind[order] == 2)


def write_simulated(graph: SimulatedGraph, out: Path, truth: Path | None = None, outliers: Path | None = None) -> None:
    """Write the graph, true poses (TUM, the id as seconds) and false loops (CSV of ids). Raises StorageError."""
    write_g2o(graph.problem, out)
    ids = graph.problem.ids
    if truth is not None:
        d = graph.problem.dimension
        poses = np.tile(np.eye(4), (len(ids), 1, 1))
        poses[:, :d, :d], poses[:, :d, 3] = graph.truth[:, :d, :d], graph.truth[:, :d, d]
        write_tum(Trajectory(ids * 1_000_000_000, poses), truth)
    if outliers is not None:
        false = ids[graph.problem.edges[graph.outlier]].tolist()
        write_text(outliers, "from_id,to_id\n" + "".join(f"{i},{j}\n" for i, j in false))


def _check(shape: str, world: GraphWorldConfig) -> None:
    if shape not in get_args(Shape):
        raise UsageError(f"no graph '{shape}'; there are: {', '.join(get_args(Shape))}")
    if not 2 <= world.poses <= _MAX_POSES:
        raise UsageError(f"{world.poses} poses: a graph has between 2 and {_MAX_POSES} of them")
    if not 0.0 <= world.loops_per_pose * world.poses <= _MAX_EDGES:
        raise UsageError(f"{world.loops_per_pose:g} loops per pose: between 0 and {_MAX_EDGES} loops in all, please")
    sigmas = (world.rotation_sigma_deg, world.translation_sigma_m, world.anisotropy)
    if not all(1e-9 <= value <= 1e3 for value in sigmas):
        raise UsageError(f"sigmas and anisotropy are {sigmas}; each must lie between 1e-9 and 1000")
    if not (0.0 <= world.outlier_fraction <= 0.95 and 1 <= world.alias_group <= world.poses):
        raise UsageError(
            f"outlier fraction {world.outlier_fraction:g} in groups of {world.alias_group}: the fraction goes from 0 "
            "to 0.95, a group from 1 loop to as many as there are poses"
        )
    if world.seed < 0:
        raise UsageError(f"seed {world.seed}: a seed is not negative")


def _sigmas(world: GraphWorldConfig, d: int) -> Array:
    """Return the sigmas of a tangent: rotation, then translation."""
    turn, step, along = np.radians(world.rotation_sigma_deg), world.translation_sigma_m, world.anisotropy
    return np.array(
        [turn * along, step * along, step] if d == 2 else [turn, turn, turn * along, step * along, step, step]
    )


def _pose(xi: Array, d: int) -> Array:
    """Return the poses [M, d + 1, d + 1] with the logarithms xi [M, k]."""
    still = np.tile(np.eye(d + 1), (len(xi), 1, 1))
    out = np.empty_like(still)
    (retract_2d if d == 2 else retract_3d)(still, np.arange(len(xi)), xi, out)
    return out


def _near_pairs(positions: Array, wanted: int, rng: np.random.Generator) -> Ids:
    """Return up to `wanted` pairs (earlier, later) [L, 2] of poses that are near but not next to each other."""
    if wanted == 0:
        return np.empty((0, 2), dtype=np.int64)
    tree, radius = cKDTree(positions), 1.05
    while radius < _MAX_LOOP_M and (tree.count_neighbors(tree, radius) - 3 * len(positions)) // 2 < wanted:
        radius = min(radius * np.sqrt(2.0), _MAX_LOOP_M)
    found = (tree.count_neighbors(tree, radius) - len(positions)) // 2
    if found > 4 * _MAX_EDGES:
        raise UsageError(f"{found} pairs of poses within {radius:.1f} m are too many to choose loops from; fewer poses")
    pairs = tree.query_pairs(radius, output_type="ndarray").astype(np.int64)
    pairs.sort(axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > 1]
    pairs = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]
    return pairs if len(pairs) <= wanted else pairs[np.sort(rng.choice(len(pairs), wanted, replace=False))]


def false_loops(
    truth: Array, count: int, size: int, rng: np.random.Generator, apart_m: float = _FALSE_M
) -> tuple[Ids, Array]:
    """Return pairs [count, 2] that look like one place, and the world's motion [count, d + 1, d + 1] of each.

    Those of a group of `size` join successive poses and agree; all poses [N, d + 1, d + 1] joined are `apart_m` apart.
    Raises UsageError where the poses have no room for them.
    """
    n, d = len(truth), truth.shape[1] - 1
    groups = -(-count // size)
    if size > n:
        raise UsageError(f"{n} poses have no room for false loops in groups of {size}")
    starts = np.sort(rng.integers(0, n - size + 1, size=(8 * groups + 64, 2)), axis=1)
    ends = starts[:, None, :] + np.arange(size)[None, :, None]  # [C, group, 2]
    apart = np.linalg.norm(truth[ends[..., 0], :d, d] - truth[ends[..., 1], :d, d], axis=2).min(axis=1)
    good = (apart > apart_m) & (starts[:, 1] - starts[:, 0] >= size)
    starts, ends = starts[good][:groups], ends[good][:groups]
    if len(starts) < groups:
        raise UsageError(
            f"{n} poses have no room for {count} false loops in groups of {size} between places {apart_m:g} m apart; "
            "more poses, or fewer of them"
        )
    shift = truth[starts[:, 0]] @ invert_many(truth[starts[:, 1]])
    return ends.reshape(-1, 2)[:count], np.repeat(shift, size, axis=0)[:count]


def _framed(positions: Array, up: Array) -> Array:
    """Return poses [N, 4, 4] at positions [N, 3] with x along the path and z near `up` [N, 3]."""
    ahead = np.diff(positions, axis=0, append=positions[-1:] * 2.0 - positions[-2:-1])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    left = np.cross(up, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    T = np.zeros((len(positions), 4, 4))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2], T[:, :3, 3] = ahead, left, np.cross(ahead, left), positions
    T[:, 3, 3] = 1.0
    return T


def _grid3d(n: int, _: np.random.Generator) -> Array:
    side = 1
    while side**3 < n:
        side += 1
    row, column = np.divmod(np.arange(n), side)
    layer, line = np.divmod(row, side)
    x = np.where(row % 2 == 0, column, side - 1 - column)
    y = np.where(layer % 2 == 0, line, side - 1 - line)
    positions = np.column_stack([x, y, layer]).astype(np.float64)
    climbing = np.diff(positions[:, 2], append=positions[-1:, 2]) > 0.0
    return _framed(positions, np.where(climbing[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))


def _sphere(n: int, _: np.random.Generator) -> Array:
    """Wind from pole to pole with a metre between turns; equal steps of height are equal steps along the path."""
    radius = np.sqrt(n / (4.0 * np.pi))
    polar = np.arccos(1.0 - (2.0 * np.arange(n) + 1.0) / n)
    azimuth = 2.0 * np.pi * radius * polar
    up = np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    return _framed(radius * up, up)


def _torus(n: int, _: np.random.Generator) -> Array:
    """Wind around a tube, which is bent to a ring of three times its radius; a metre between turns in the mean."""
    tube = np.sqrt(n / 12.0) / np.pi
    around, along = np.arange(n) / tube, 2.0 * np.pi * np.arange(n) / n
    up = np.column_stack([np.cos(around) * np.cos(along), np.cos(around) * np.sin(along), np.sin(around)])
    centre = 3.0 * tube * np.column_stack([np.cos(along), np.sin(along), np.zeros(n)])
    return _framed(centre + tube * up, up)


def _manhattan(n: int, rng: np.random.Generator) -> Array:
    turns = np.zeros(n, dtype=np.int64)
    corners = turns[_BLOCK_STEPS::_BLOCK_STEPS]
    corners[:] = rng.integers(-1, 2, size=len(corners))
    heading = np.cumsum(turns) % 4
    ahead = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    T = np.zeros((n, 3, 3))
    T[:, :2, 0], T[:, :2, 1] = ahead[heading], ahead[(heading + 1) % 4]
    T[1:, :2, 2] = np.cumsum(ahead[heading[:-1]], axis=0)
    T[:, 2, 2] = 1.0
    return T


_PATHS: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "grid3d": _grid3d, "torus": _torus, "sphere": _sphere, "manhattan": _manhattan,
}  # fmt: skip
