"""`--robust auto` beside each route that could have been asked for, on graphs with and without false loops.

    python experiments/robust_routes.py [FILE ...] [--simulated NAME ...] [--false 0 0.1 0.5 0.8] [--groups 1 10]
        [--out routes.json]

Simulated graphs have exact truth: grids, a torus, a sphere, a city, rings that close once or twice, and trees of rings,
in the plane and in space. The truth of a file is the optimum of all its edges, which are all taken as true. False loops
look like one place: groups of them agree with each other, errors and noise are those of true loops of the graph. A row
has the ATE of each route, true loops kept and false ones, and CPU seconds; `auto` fails it where a route is better by
more than 5 % of ATE and a thousandth of the extent and keeps as few false loops, or keeps more true loops and as few
false ones. Thresholds of `auto` were chosen on seed 0 of these graphs and on the files of the data folder.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from vislam import VislamError
from vislam.batch import (
    PoseGraphProblem,
    SimulatedGraph,
    false_loops,
    measured_graph,
    optimize_pose_graph,
    read_pose_graph,
    simulate_graph,
)
from vislam.config import GraphWorldConfig, PoseGraphConfig
from vislam.core.geometry import align_points

ROUTES = ("none", "cauchy", "geman-mcclure", "dcs", "gnc", "auto")
BETTER, OF_EXTENT = 1.05, 1e-3  # of ATE, by which a route is better than auto
APART = 0.3  # of the extent, at most 10 m: between the places of false loops


def ring(d: int, laps: int, poses: int, height_m: float) -> np.ndarray:
    """Return poses [N, d + 1, d + 1] a metre apart on a ring, which rises and falls in space."""
    angle = 2.0 * np.pi * laps * np.arange(poses) / poses
    radius = poses / laps / (2.0 * np.pi)
    return along(np.column_stack([radius * np.sin(angle), -radius * np.cos(angle), height_m * np.sin(2 * angle)]), d)


def tree(d: int, rings: int, poses: int) -> np.ndarray:
    """Return poses on a ring that leaves at equal distances for small rings outside it and comes back to itself."""
    around = 40
    main = poses - rings * around
    radius, small = main / (2.0 * np.pi), around / (2.0 * np.pi)
    parts = []
    for k in range(rings):
        angle = 2.0 * np.pi * (k + np.arange(main // rings) / (main // rings)) / rings
        parts.append(radius * np.column_stack([np.sin(angle), -np.cos(angle), 0.0 * angle]))
        end = 2.0 * np.pi * (k + 1) / rings
        out, turn = np.array([np.sin(end), -np.cos(end), 0.0]), 2.0 * np.pi * np.arange(around + 2) / around
        ahead = np.array([np.cos(end), np.sin(end), 0.0])
        lift = np.array([0.0, 0.0, small if d == 3 else 0.0]) / 2.0
        parts.append(
            (radius + small) * out
            + small * (np.sin(turn)[:, None] * ahead - np.cos(turn)[:, None] * out)
            + (1.0 - np.cos(turn))[:, None] * lift
        )
    angle = 2.0 * np.pi * np.arange(20) / main
    parts.append(radius * np.column_stack([np.sin(angle), -np.cos(angle), 0.0 * angle]))
    return along(np.concatenate(parts), d)


def along(positions: np.ndarray, d: int) -> np.ndarray:
    """Return poses [N, d + 1, d + 1] at positions [N, 3], x along the path."""
    ahead = np.diff(positions, axis=0, append=2.0 * positions[-1:] - positions[-2:-1])[:, :2]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    T = np.zeros((len(positions), d + 1, d + 1))
    T[:, :2, 0], T[:, 0, 1], T[:, 1, 1] = ahead, -ahead[:, 1], ahead[:, 0]
    T[:, 2, 2] = 1.0
    T[:, :d, d], T[:, d, d] = positions[:, :d], 1.0
    return T


def lawn(poses: int) -> np.ndarray:
    """Return poses in the plane that go up and down lanes a metre apart."""
    side = round(poses**0.5)
    row, column = np.divmod(np.arange(side * side), side)
    return along(np.column_stack([np.where(row % 2, side - 1 - column, column), row, 0 * row]).astype(float), 2)


PATHS = {
    "lawn": lambda: lawn(400),
    "ring-once": lambda: ring(2, 1, 400, 0.0),
    "ring-twice": lambda: ring(2, 2, 600, 0.0),
    "ring3d-once": lambda: ring(3, 1, 400, 4.0),
    "ring3d-twice": lambda: ring(3, 2, 600, 4.0),
    "tree": lambda: tree(2, 6, 600),
    "tree3d": lambda: tree(3, 6, 600),
}
SHAPES = {"grid3d": 512, "torus": 500, "sphere": 500, "manhattan": 600, "manhattan-long": 1500}
NOISE = {"ring-once": 0.3, "ring3d-once": 0.3}  # of the usual sigmas: nothing but its end holds such a ring


def simulated(name: str, fraction: float, group: int, seed: int) -> SimulatedGraph:
    """Return the simulated graph of a name."""
    scale = NOISE.get(name, 1.0)
    world = GraphWorldConfig(
        poses=SHAPES.get(name, 2), loops_per_pose=0.5, outlier_fraction=fraction, alias_group=group, seed=seed,
        rotation_sigma_deg=scale, translation_sigma_m=0.05 * scale,
    )  # fmt: skip
    if name in SHAPES:
        return simulate_graph("manhattan" if name.startswith("manhattan") else name, world)
    truth, rng = PATHS[name](), np.random.default_rng(seed)
    d = truth.shape[1] - 1
    near = np.linalg.norm(truth[:, None, :d, d] - truth[None, :, :d, d], axis=2) < 2.0
    loops = np.argwhere(np.triu(near, 20))
    return measured_graph(truth, rng.permutation(loops)[: max(6, len(truth) // 6)], world, rng)


def spoilt(problem: PoseGraphProblem, truth: np.ndarray, fraction: float, group: int, seed: int) -> SimulatedGraph:
    """Return a file's graph with false loops, which err against what they claim as true ones err."""
    rng = np.random.default_rng(seed)
    loops = np.flatnonzero(is_loop(problem))
    count = round(fraction / (1.0 - fraction) * len(loops))
    apart_m = min(10.0, APART * extent(truth))
    ends, shift = false_loops(truth, count, group, rng, apart_m)
    like = rng.choice(loops, count)
    missed = np.linalg.inv(truth[problem.edges[like, 0]]) @ truth[problem.edges[like, 1]]
    moved = np.linalg.inv(missed) @ problem.measurements[like]
    between = np.linalg.inv(truth[ends[:, 0]]) @ shift @ truth[ends[:, 1]] @ moved
    edges = np.concatenate([problem.edges, ends])
    measurements = np.concatenate([problem.measurements, between])
    information = np.concatenate([problem.information, problem.information[like]])
    more = replace(
        problem, edges=edges, measurements=measurements, information=information, is_position=np.zeros(0, dtype=bool)
    )
    return SimulatedGraph(more, truth, np.arange(len(edges)) >= len(problem.edges))


def is_loop(problem: PoseGraphProblem) -> np.ndarray:
    """Return which edges [E] do not join successive ids."""
    return np.abs(np.diff(problem.edges, axis=1)[:, 0]) != 1


def extent(poses: np.ndarray) -> float:
    """Return the longest side of the box around poses [N, d + 1, d + 1]."""
    return float(np.ptp(poses[:, :-1, -1], axis=0).max())


def ate_m(poses: np.ndarray, truth: np.ndarray) -> float:
    """Return the rms distance of positions after the rigid alignment."""
    a, b = (np.pad(T[:, :-1, -1], ((0, 0), (0, 4 - T.shape[1]))) for T in (poses, truth))
    T = align_points(a, b)
    return float(np.sqrt(np.mean(np.sum((a @ T[:3, :3].T + T[:3, 3] - b) ** 2, axis=1))))


def row(graph: SimulatedGraph) -> dict[str, dict[str, float | str]]:
    """Return what each route came to on a graph."""
    loops = is_loop(graph.problem)
    out: dict[str, dict[str, float | str]] = {}
    for route in ROUTES:
        begun = time.process_time()
        solution = optimize_pose_graph(graph.problem, PoseGraphConfig(robust=route))
        kept = solution.weights != 0.0
        out[route] = {
            "ate_m": ate_m(solution.poses, graph.truth),
            "true_kept": int((kept & loops & ~graph.outlier).sum()), "true": int((loops & ~graph.outlier).sum()),
            "false_kept": int((kept & graph.outlier).sum()), "false": int(graph.outlier.sum()),
            "cpu_s": time.process_time() - begun, "undecided": len(solution.undecided),
            "reason": solution.robust_reason,
        }  # fmt: skip
    return out


def verdict(routes: dict[str, dict[str, float]], extent_m: float) -> str:
    """Return by what auto is worse than a route; empty where it is not."""
    auto, failures = routes["auto"], []
    for name in ROUTES[:-1]:
        other = routes[name]
        if other["ate_m"] * BETTER + OF_EXTENT * extent_m < auto["ate_m"]:
            failures.append(f"{name} {other['ate_m']:.3g} m")
        elif other["false_kept"] <= auto["false_kept"] and other["true_kept"] > auto["true_kept"]:
            failures.append(f"{name} keeps {other['true_kept'] - auto['true_kept']} more")
    return "; ".join(failures)


def main() -> None:
    """Print a row per graph, and write the JSON after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument("--simulated", nargs="*", default=[], metavar="NAME", help="all: every one of them")
    parser.add_argument("--false", nargs="+", type=float, default=[0.0, 0.1, 0.5, 0.8], metavar="SHARE")
    parser.add_argument("--groups", nargs="+", type=int, default=[1, 10])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("routes.json"))
    options = parser.parse_args()
    names = [*PATHS, *SHAPES] if options.simulated == ["all"] else options.simulated
    out: dict[str, object] = {}
    print(f"seed {options.seed}; ATE [m] (false loops kept/true loops lost) of " + ", ".join(ROUTES))
    for name in [*options.files, *names]:
        if isinstance(name, Path):
            problem = read_pose_graph(name)
            truth = optimize_pose_graph(problem).poses
        for fraction in options.false:
            for group in options.groups if fraction > 0.0 else [1]:
                try:
                    if isinstance(name, Path):
                        graph = spoilt(problem, truth, fraction, group, options.seed)
                    else:
                        graph = simulated(name, fraction, group, options.seed)
                except VislamError as e:
                    print(f"{name} {fraction:g} x{group}: left out, {e}")
                    continue
                routes = row(graph)
                key = f"{name.stem if isinstance(name, Path) else name} {fraction:.0%} x{group}"
                fails = verdict(routes, extent(graph.truth))
                out[key] = {"routes": routes, "fails": fails}
                cells = " ".join(
                    f"{r['ate_m']:.3g}({r['false_kept']}/{r['true'] - r['true_kept']})" for r in routes.values()
                )
                dearest = max(r["cpu_s"] for n, r in routes.items() if n != "auto")
                print(
                    f"{key}: {cells} CPU x{routes['auto']['cpu_s'] / dearest:.2g} {'FAILS: ' + fails if fails else ''}",
                    flush=True,
                )
                options.out.write_text(json.dumps(out, indent=1))
    bad = sum(bool(entry["fails"]) for entry in out.values())
    print(f"auto is worse than a route on {bad} of {len(out)} graphs")


if __name__ == "__main__":
    main()
