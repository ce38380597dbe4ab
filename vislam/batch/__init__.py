"""Batch optimisation: a whole run at once, as the reference of accuracy, and pose graphs from files."""

from vislam.batch.graph_files import read_pose_graph, write_pose_graph
from vislam.batch.graph_optimize import PoseGraphSolution, optimize_pose_graph
from vislam.batch.graph_problem import PoseGraphProblem
from vislam.batch.loops import LoopVerdict
from vislam.batch.optimize import BatchResult, optimize_run

__all__ = [
    "BatchResult",
    "LoopVerdict",
    "PoseGraphProblem",
    "PoseGraphSolution",
    "optimize_pose_graph",
    "optimize_run",
    "read_pose_graph",
    "write_pose_graph",
]
