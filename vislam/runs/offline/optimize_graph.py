"""A pose-graph file optimised and what its folder gets of it: the library's side of `vislam posegraph FILE`."""

import time
from dataclasses import asdict, dataclass, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vislam.batch.posegraph.certificate import Certificate, certify
from vislam.batch.posegraph.cholesky import Factor
from vislam.batch.posegraph.domains import Team
from vislam.batch.posegraph.files import read_pose_graph
from vislam.batch.posegraph.g2o import write_g2o
from vislam.batch.posegraph.noise import NoiseOfKind, noise_of_kinds, rescaled
from vislam.batch.posegraph.optimize import PoseGraphSolution, as_stated, optimize_pose_graph
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import Progress
from vislam.batch.posegraph.uncertainty import Uncertainty, uncertainty_if_any
from vislam.config import PoseGraphConfig
from vislam.core.collector import paused
from vislam.core.errors import UsageError
from vislam.core.files import storage, write_json, write_lines
from vislam.core.geometry import quaternion_xyzw_from_rotation
from vislam.core.messages import Array
from vislam.trajectory import Trajectory, write_kitti, write_tum

_BETTER = 4  # minima that are looked at, each lower than the one before
_RESCALINGS, _RESCALED = 6, 0.02  # rounds of rescaling at most, and how near to 1 all factors end
_MAX_ID_S = 9_000_000_000  # an id beyond does not fit into a stamp of nanoseconds


@dataclass(frozen=True, slots=True, eq=False)
class OptimizedGraph:
    """A pose graph, its optimum, and the summary that summary.json holds."""

    problem: PoseGraphProblem
    solution: PoseGraphSolution
    summary: dict[str, Any]
    certificate: Certificate | None
    noise: tuple[NoiseOfKind, ...]  # what residuals show of the stated noise
    uncertainty: Uncertainty | None  # None where nothing asked for it, or it cannot be had


def optimize_graph_file(
    path: Path, out: Path, config: PoseGraphConfig, progress: Progress | None = None, team: Team | None = None
) -> OptimizedGraph:
    """Optimise a g2o, TORO or iSAM file and write optimized.g2o, the trajectory in other formats and summary.json.

    Everything is computed before anything is written. `team`: see `optimize_pose_graph`. Raises DataError, UsageError,
    StorageError.
    """
    begun = time.perf_counter()
    problem = read_pose_graph(path, config.repair_information, config.isam_noise)
    solution = optimize_pose_graph(problem, config, progress, team)
    noise: tuple[NoiseOfKind, ...] = ()
    if config.rescale_noise:
        problem, solution, noise = _rescaled(problem, solution, config, progress)
    certificate, uncertainty, covariances = None, None, None
    if config.certify:
        solution, certificate = _certified(problem, solution)
    if config.covariances:
        uncertainty = Uncertainty(problem, solution.poses, solution.weights)
        covariances = uncertainty.of_all()
    if config.noise and not config.rescale_noise:
        uncertainty = uncertainty or uncertainty_if_any(problem, solution.poses, solution.weights)
        noise = _noise(problem, solution, None if uncertainty is None else uncertainty.factor)
    with storage(out):
        out.mkdir(parents=True, exist_ok=True)
    write_g2o(problem, out / "optimized.g2o", solution.poses)
    _write_trajectories(problem, solution.poses, out)
    _write_edges(problem, solution, out / "edges.csv")
    if covariances is not None:
        _write_covariances(problem, covariances, out / "covariances.csv")
    if problem.is_point.any():
        _write_landmarks(problem, solution.poses, covariances, out / "landmarks.csv")
    summary = summarise(problem, solution) | {"source": str(path), "config": asdict(config)}
    summary["noise"] = [{k: _finite(v) for k, v in asdict(kind).items()} for kind in noise]
    summary["certificate"] = None if certificate is None else certificate_entry(certificate)
    summary["wall_s"] = time.perf_counter() - begun
    write_json(out / "summary.json", summary)
    return OptimizedGraph(problem, solution, summary, certificate, noise, uncertainty)


def _noise(problem: PoseGraphProblem, solution: PoseGraphSolution, factor: Factor | None) -> tuple[NoiseOfKind, ...]:
    """Return what residuals show of the stated noise; nothing where the factor does not fit."""
    try:  # landmarks and priors are no odometry and no loops
        return noise_of_kinds(problem, solution.poses, solution.weights, factor) if problem.of_poses else ()
    except UsageError:
        return ()


def _rescaled(
    problem: PoseGraphProblem, solution: PoseGraphSolution, config: PoseGraphConfig, progress: Progress | None
) -> tuple[PoseGraphProblem, PoseGraphSolution, tuple[NoiseOfKind, ...]]:
    """Return problem and solution rescaled by what residuals show of the stated noise, and what they then show."""
    if not problem.of_poses:
        raise UsageError("--rescale-noise knows no landmarks and no priors, which this graph has; leave it away")
    noise = noise_of_kinds(problem, solution.poses, solution.weights)
    weights, applied = solution.weights, {kind.kind: 1.0 for kind in noise}
    for _ in range(_RESCALINGS):
        applied |= {k.kind: applied[k.kind] * k.factor for k in noise if np.isfinite(k.factor)}
        problem = rescaled(problem, noise)
        solved = optimize_pose_graph(
            problem.with_edges(weights != 0.0).with_poses(solution.poses),
            replace(config, robust="none", start="file"), progress,
        )  # fmt: skip
        solution = replace(
            solution, poses=solved.poses, costs=solved.costs, converged=solved.converged, start=solved.start
        )
        noise = noise_of_kinds(problem, solution.poses, weights)
        if all(abs(kind.factor - 1.0) < _RESCALED or not np.isfinite(kind.factor) for kind in noise):
            break
    return problem, solution, tuple(replace(kind, applied=applied[kind.kind]) for kind in noise)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _certified(problem: PoseGraphProblem, solution: PoseGraphSolution) -> tuple[PoseGraphSolution, Certificate]:
    """Return the certificate, and with it the better solution where the search for it came across one."""
    certificate = certify(problem, solution.poses, solution.weights)
    for _ in range(_BETTER):
        if certificate.better is None:
            break
        note = f"a minimum of chi2 {certificate.chi2:.9g} was left for a lower one that the certificate's check found"
        poses, certificate = certificate.better, certify(problem, certificate.better, solution.weights)
        notes, costs = (*solution.notes, note), (*solution.costs, certificate.chi2)
        solution = replace(solution, poses=poses, costs=costs, notes=notes)
    return solution, certificate


def certificate_entry(certificate: Certificate) -> dict[str, Any]:
    """Return a certificate for summary.json; what could not be computed is None."""
    entry = {f.name: getattr(certificate, f.name) for f in fields(certificate) if f.name != "better"}
    return {name: None if isinstance(v, float) and not np.isfinite(v) else v for name, v in entry.items()}


def summarise(problem: PoseGraphProblem, solution: PoseGraphSolution) -> dict[str, Any]:
    """Return what an optimisation came to, for summary.json and --json."""
    stated = as_stated(problem, solution.weights)
    return {
        "dimension": problem.dimension,
        "poses": int(problem.is_pose.sum()),
        "landmarks": int(problem.is_point.sum()),
        "edges": len(problem.edges),
        "parts": solution.parts,
        "start": solution.start_name,
        "start_chi2": {name: cost if np.isfinite(cost) else None for name, cost in solution.start_costs.items()},
        "chi2_file": None if stated is None else stated[1],
        "chi2_before": solution.costs[0],
        "chi2_after": solution.costs[-1],
        "iterations": len(solution.costs) - 1,
        "converged": solution.converged,
        "robust": solution.robust_reason or None,
        "undecided": [problem.ids[problem.edges[e]].tolist() for e in solution.undecided],
        "rejected": [problem.ids[problem.edges[e]].tolist() for e in solution.rejected.tolist()],
        "solve_s": solution.solve_s,
        "warnings": list(solution.notes),
    }


def _in_space(problem: PoseGraphProblem, poses: Array) -> Array:
    """Return transforms [N, 4, 4]; those of the plane at height zero."""
    if problem.dimension == 3:
        return poses
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :2, :2], out[:, :2, 3] = poses[:, :2, :2], poses[:, :2, 2]
    return out


@paused()
def _write_trajectories(problem: PoseGraphProblem, poses: Array, out: Path) -> None:
    """Write poses.csv, trajectory.tum (a pose's id is its time in seconds) and trajectory_kitti.txt."""
    T, ids = _in_space(problem, poses)[problem.is_pose], problem.ids[problem.is_pose]
    q = quaternion_xyzw_from_rotation(T[:, :3, :3])
    row = "%d," + ",".join(["%.15g"] * 7)
    lines = (row % (i, *p, *o) for i, p, o in zip(ids.tolist(), T[:, :3, 3].tolist(), q.tolist(), strict=True))
    write_lines(out / "poses.csv", chain(["id,x_m,y_m,z_m,qx,qy,qz,qw"], lines))
    fits = int(ids.max(initial=0)) <= _MAX_ID_S
    stamps = (ids if fits else np.arange(len(ids))) * 1_000_000_000
    trajectory = Trajectory(stamps, T)
    write_tum(trajectory, out / "trajectory.tum")
    write_kitti(trajectory, out / "trajectory_kitti.txt")


def _write_covariances(problem: PoseGraphProblem, covariances: Array, path: Path) -> None:
    """Write the upper triangle, in rows, of each pose's covariance: rotation, then translation, on the body side."""
    axes = ("yaw", "x", "y") if problem.dimension == 2 else ("rx", "ry", "rz", "x", "y", "z")
    a, b = np.triu_indices(len(axes))
    header = ",".join(["id", *(f"{axes[i]}_{axes[j]}" for i, j in zip(a, b, strict=True))])
    row = "%d," + ",".join(["%.9g"] * len(a))
    own = problem.is_pose
    lines = (row % (i, *u) for i, u in zip(problem.ids[own].tolist(), covariances[own][:, a, b].tolist(), strict=True))
    write_lines(path, chain([header], lines))


def _write_landmarks(problem: PoseGraphProblem, poses: Array, covariances: Array | None, path: Path) -> None:
    """Write positions of landmarks, with the upper triangles, in rows, of their covariances in the world's axes."""
    d, at = problem.dimension, np.flatnonzero(problem.is_point)
    axes, (a, b) = "xyz"[:d], np.triu_indices(d)
    header, columns = ["id", *(f"{axis}_m" for axis in axes)], [poses[at, :d, d]]
    if covariances is not None:
        header += [f"{axes[i]}_{axes[j]}" for i, j in zip(a, b, strict=True)]
        columns.append(covariances[at][:, -d:, -d:][:, a, b])
    row = "%d" + ",%.15g" * d + ",%.9g" * (len(header) - 1 - d)
    values = np.column_stack(columns).tolist()
    lines = (row % (i, *v) for i, v in zip(problem.ids[at].tolist(), values, strict=True))
    write_lines(path, chain([",".join(header)], lines))


@paused()
def _write_edges(problem: PoseGraphProblem, solution: PoseGraphSolution, path: Path) -> None:
    """Write which edges were kept, with their chi2 before and after."""
    names = np.array([str(i) for i in problem.ids.tolist()], dtype=object)
    if problem.world >= 0:
        names[problem.world] = "world"
    columns = zip(
        names[problem.edges].tolist(),
        problem.edge_chi2(solution.start).tolist(),
        problem.edge_chi2(solution.poses).tolist(),
        solution.weights.tolist(),
        strict=True,
    )
    lines = (f"{a},{b},{before:.9g},{after:.9g},{kept:.0f}" for (a, b), before, after, kept in columns)
    write_lines(path, chain(["from,to,chi2_before,chi2_after,kept"], lines))
