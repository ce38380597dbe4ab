"""`PoseGraphFile`: a pose graph from a file, optimised and written again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from vislam.batch.posegraph.files import read_pose_graph, write_pose_graph
from vislam.batch.posegraph.optimize import PoseGraphSolution, optimize_pose_graph
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.config import PoseGraphConfig, validated
from vislam.core.messages import Array


class PoseGraphFile:
    """A pose graph of a g2o, TORO or iSAM file: read, `optimise`, `write`.

        graph = PoseGraphFile("city.g2o")
        print(graph.optimise(robust="auto"))
        graph.write("city-optimised.g2o")

    Attributes:
        problem: measurements and where to start.
        poses: the newest poses [N, d + 1, d + 1], in the plane (d = 2) or in space (d = 3).
    """

    def __init__(self, path: Path | str, repair: bool = False) -> None:
        """Read a file; `repair` makes its information positive. Raises DataError, naming the line, for a bad one."""
        self.path = Path(path)
        self.problem: PoseGraphProblem = read_pose_graph(self.path, repair)
        self.poses: Array = self.problem.poses

    def __repr__(self) -> str:
        p = self.problem
        where = "in the plane" if p.dimension == 2 else "in space"
        return f"PoseGraphFile({self.path}: {len(p.ids)} poses {where}, {len(p.edges)} edges)"

    def optimise(self, **settings: Any) -> PoseGraphSolution:
        """Optimise from the poses of the file and keep the answer; settings are those of `vislam posegraph`.

        Raises UsageError for a setting that there is not or that the graph cannot have, DataError where it fails.
        """
        config = validated(PoseGraphConfig, settings, "PoseGraphFile.optimise")
        solution = optimize_pose_graph(self.problem, config)
        self.poses = solution.poses
        return solution

    def write(self, path: Path | str) -> None:
        """Write measurements and newest poses in the format that the name ends in: .g2o, .toro or .isam."""
        write_pose_graph(replace(self.problem, poses=self.poses), Path(path), self.poses)
