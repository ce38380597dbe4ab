"""Pose-graph files of every format: which one it is, and its reader and writer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from vislam.batch.posegraph.g2o import read_g2o, write_g2o
from vislam.batch.posegraph.isam import read_isam, write_isam
from vislam.batch.posegraph.landmark_lines import Noise
from vislam.batch.posegraph.optimize import PoseGraphSolution, optimize_pose_graph
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.toro import read_toro, write_toro
from vislam.config import PoseGraphConfig, validated
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array
from vislam.core.reading import open_file

GraphFormat = Literal["g2o", "toro", "isam"]

_READERS: dict[GraphFormat, Callable[[Path, bool], PoseGraphProblem]] = {
    "g2o": read_g2o, "toro": read_toro,
}  # fmt: skip
_WRITERS: dict[GraphFormat, Callable[[PoseGraphProblem, Path, Array | None], None]] = {
    "g2o": write_g2o, "toro": write_toro, "isam": write_isam,
}  # fmt: skip
_ENDINGS: dict[str, GraphFormat] = {".g2o": "g2o", ".toro": "toro", ".isam": "isam"}
_TAGS: dict[str, GraphFormat] = {
    "VERTEX_SE2": "g2o", "VERTEX_SE3:QUAT": "g2o", "EDGE_SE2": "g2o", "EDGE_SE3:QUAT": "g2o",
    "VERTEX2": "toro", "VERTEX3": "toro", "ODOMETRY": "isam", "Constraint2": "isam", "POSE3D_INIT": "isam",
    "LANDMARK": "isam",
}  # fmt: skip
_LOOKED_AT_BYTES = 1 << 20


def graph_format(path: Path) -> GraphFormat:
    """Return the format of a file by its ending .g2o, .toro or .isam, else by a line in its first MiB that shows it.

    Raises UsageError where neither decides: EDGE2 and EDGE3 alone mean one thing to TORO and another one to iSAM.
    """
    by_name = _ENDINGS.get(path.suffix.lower())
    if by_name is not None:
        return by_name
    try:
        with open_file(path) as file:
            text = file.read(_LOOKED_AT_BYTES)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    for line in text.splitlines():
        tag = line.split(maxsplit=1)[:1]
        if tag and (found := _TAGS.get(tag[0].decode("utf-8", errors="replace"))) is not None:
            return found
    raise UsageError(
        f"{path}: neither name nor contents decide between g2o, TORO and iSAM; end the name in .g2o, .toro or .isam"
    )


def read_pose_graph(path: Path, repair: bool = False, isam_noise: Noise | Literal["auto"] = "auto") -> PoseGraphProblem:
    """Read a pose graph of any format; see `graph_format` and the readers. `repair`: make its information positive.

    `isam_noise`: whether an iSAM file in the plane states square roots of information or covariances; "auto" decides.
    """
    name = graph_format(path)
    return read_isam(path, repair, isam_noise) if name == "isam" else _READERS[name](path, repair)


def write_pose_graph(problem: PoseGraphProblem, path: Path, poses: Array | None = None) -> None:
    """Write a pose graph in the format that the name ends in, g2o where it has none; see the writers."""
    _WRITERS[_ENDINGS.get(path.suffix.lower(), "g2o")](problem, path, poses)


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
