"""The report of an optimised pose graph: before and after, the cost, and what was found false."""

from pathlib import Path

import numpy as np

from vislam.batch.posegraph.certificate import Certificate
from vislam.batch.posegraph.optimize import PoseGraphSolution
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.uncertainty import Uncertainty, ellipses, uncertainty_if_any
from vislam.core.files import write_text
from vislam.core.messages import Array
from vislam.runs.report.drawing import Axis, Lines, drawing
from vislam.runs.report.html import (
    bullets,
    card,
    drawn,
    escape,
    folded,
    grid,
    note,
    number,
    section,
    stylesheet,
    table,
    tile,
)

_MAX_LINES = 3000  # edges drawn of a picture: more cannot be seen and only makes the file heavy
_REGIONS = 40  # poses whose uncertainty is drawn
_MAX_ROWS = 300  # rejected edges in the table; edges.csv has them all


def write_graph_report(
    problem: PoseGraphProblem,
    solution: PoseGraphSolution,
    name: str,
    path: Path,
    certificate: Certificate | None = None,
    stated: tuple[Array, float] | None = None,
    uncertainty: Uncertainty | None = None,
) -> None:
    """Write report.html of an optimised pose graph. Raises StorageError.

    Where the problem came from a file, `stated` is what it states of the poses [N, d + 1, d + 1] and their cost, which
    the page then shows as what was before; else it shows the start. `uncertainty`: the solution's, if it is known.
    """
    before, cost_before, of = (
        (solution.start, solution.costs[0], f"the {solution.start_name} start")
        if stated is None
        else (*stated, "the file's poses")
    )
    unit = "ms" if solution.solve_s < 1.0 else "s"
    took = solution.solve_s * (1000.0 if unit == "ms" else 1.0)
    tiles = (
        tile(number(int(problem.is_pose.sum()), 0), "", f"poses, {problem.dimension}D"),
        *([tile(number(int(problem.is_point.sum()), 0), "", "landmarks")] if problem.is_point.any() else []),
        tile(number(len(problem.edges), 0), "", "edges"),
        tile(f"{solution.costs[-1]:.6g}", "", f"chi², from {cost_before:.6g} of {of}"),
        tile(number(took, 1), unit, f"to solve, {len(solution.costs) - 1} iterations"),
        tile(number(len(solution.rejected), 0), "", "edges found false"),
        *([tile(certificate.word, "", "global optimum")] if certificate is not None else []),
    )
    uncertainty = uncertainty or uncertainty_if_any(problem, solution.poses, solution.weights)
    regions, enlarged = (np.empty((0, 1, 2)), 1.0) if uncertainty is None else _regions(problem, solution, uncertainty)
    after = _picture(problem, solution, solution.poses, regions)
    times = "" if enlarged == 1.0 else f", {enlarged:g} times as large"
    title = f"After, with 95 % regions of some poses{times}" if len(regions) else "After"
    pictures = grid(
        card(drawn(_picture(problem, solution, before)), title=f"Before: {of}"),
        card(drawn(after), title=title),
    )
    starts = table(("start", "chi²"), [(k, f"{v:.6g}") for k, v in solution.start_costs.items()])
    body = "".join(
        (
            f"<header><h1>{escape(name)}</h1></header>",
            f'<div class="tiles">{"".join(tiles)}</div>',
            section("Trajectory", pictures),
            section(
                "Cost",
                grid(card(drawn(_cost_curve(solution)), title="chi² over iterations"), card(starts, title="Starts")),
            ),
            section("Certificate", note(escape(certificate.text))) if certificate is not None else "",
            _rejected(problem, solution),
            section("Notes", bullets(solution.notes)) if solution.notes else "",
        )
    )
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(f'vislam: {name}')}</title><style>{stylesheet()}</style></head><body><main>{body}"
        "<footer>Made by vislam posegraph.</footer></main></body></html>\n"
    )
    write_text(path, page)


def _plane(poses: Array) -> tuple[int, int]:
    """Return the two axes along which poses spread most."""
    d = poses.shape[1] - 1
    first, second = np.sort(np.argsort(-np.ptp(poses[:, :d, d], axis=0), kind="stable")[:2]).tolist()
    return first, second


def _regions(problem: PoseGraphProblem, solution: PoseGraphSolution, uncertainty: Uncertainty) -> tuple[Array, float]:
    """Return outlines [M, P, 2] of some poses' regions, and how much enlarged."""
    step = max(1, len(problem.ids) // _REGIONS)
    chosen = np.flatnonzero(problem.is_pose | problem.is_point)[step // 2 :: step]
    covariances = uncertainty.of(problem.ids[chosen])
    axes = _plane(solution.poses)
    outlines = ellipses(solution.poses[chosen], covariances, axes=axes)
    extent = float(np.ptp(solution.poses[:, axes, problem.dimension], axis=0).max())
    widest = float(np.ptp(outlines, axis=1).max(initial=0.0))
    # by a power of ten, to between a thirtieth and a third of the picture; files often state a nominal information
    fits = widest > 0.0 and extent > 0.0
    enlarged = 10.0 ** float(np.floor(np.log10(0.3 * extent / widest))) if fits else 1.0
    return ellipses(solution.poses[chosen], covariances, axes=axes, enlarged=enlarged), enlarged


def _picture(problem: PoseGraphProblem, solution: PoseGraphSolution, poses: Array, regions: Array | None = None) -> str:
    """Draw the poses in the plane in which they spread most, with their edges and the outlines of `regions`."""
    d = problem.dimension
    first, second = _plane(solution.poses)
    points = poses[:, [first, second], d]
    shown = (problem.edges != problem.world).all(axis=1)
    rank = np.cumsum(problem.is_pose)  # landmarks may have ids between those of poses
    successive = np.abs(rank[problem.edges[:, 1]] - rank[problem.edges[:, 0]]) == 1
    rejected = solution.weights == 0.0
    between = shown & ~rejected
    lines = [
        _edges(points, problem.edges[shown & rejected], "bad", 0.4, 0.5),
        _edges(points, problem.edges[between & ~successive], "muted", 0.4, 0.5),
        _edges(points, problem.edges[shown & successive & ~problem.is_position], "graph", 1.2, 1.0),
    ]
    landmarks = points[problem.is_point]
    if len(landmarks):
        lines.append(Lines(np.stack((landmarks, landmarks), axis=1), "ink", 3.0))
    if regions is not None:
        lines.append(Lines(regions, "ekf", 0.8))
    return drawing(lines, Axis(f"{'xyz'[first]} [m]"), Axis(f"{'xyz'[second]} [m]"), height_pt=338, same_scale=True)


def _edges(points: Array, edges: Array, color: str, width_pt: float, opacity: float) -> Lines:
    step = max(1, -(-len(edges) // _MAX_LINES))
    return Lines(points[edges[::step]], color, width_pt, opacity)


def _cost_curve(solution: PoseGraphSolution) -> str:
    costs = np.maximum(np.array(solution.costs), 1e-12)
    curve = np.stack((np.arange(len(costs), dtype=np.float64), costs), axis=1)
    dots = np.stack((curve, curve), axis=1)
    lines = (Lines(curve[None], "graph", 1.4), Lines(dots, "graph", 4.0))
    return drawing(lines, Axis("iteration", whole=True), Axis("chi²", log=True), height_pt=230)


def _rejected(problem: PoseGraphProblem, solution: PoseGraphSolution) -> str:
    if not len(solution.rejected):
        return ""
    errors = problem.edge_chi2(solution.poses)
    worst = solution.rejected[np.argsort(-errors[solution.rejected], kind="stable")]
    rows = [
        (str(problem.ids[problem.edges[e, 0]]), str(problem.ids[problem.edges[e, 1]]), f"{errors[e]:.4g}")
        for e in worst[:_MAX_ROWS].tolist()
    ]
    rest = note(f"The worst {_MAX_ROWS} of {len(worst)}; edges.csv has all.") if len(worst) > _MAX_ROWS else ""
    title = f"{len(worst)} edges"
    return section("Edges found false", folded(title, table(("from", "to", "chi² at the end"), rows) + rest))
