"""Batch optimisation: a whole run at once, as the reference of accuracy, and pose graphs from files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.batch.bundle.bundle_adjustment import BatchResult, optimize_run
    from vislam.batch.bundle.loops import LoopVerdict
    from vislam.batch.posegraph.files import PoseGraphFile, read_pose_graph, write_pose_graph
    from vislam.batch.posegraph.optimize import PoseGraphSolution, optimize_pose_graph
    from vislam.batch.posegraph.problem import PoseGraphProblem
    from vislam.batch.posegraph.worlds import (
        SimulatedGraph,
        false_loops,
        measured_graph,
        simulate_graph,
        write_simulated,
    )
    from vislam.core.cluster import DaskTeam, dask_client

__all__ = [
    "BatchResult",
    "DaskTeam",
    "LoopVerdict",
    "PoseGraphFile",
    "PoseGraphProblem",
    "PoseGraphSolution",
    "SimulatedGraph",
    "dask_client",
    "false_loops",
    "measured_graph",
    "optimize_pose_graph",
    "optimize_run",
    "read_pose_graph",
    "simulate_graph",
    "write_pose_graph",
    "write_simulated",
]

__getattr__ = late(
    __name__,
    {
        "BatchResult optimize_run": "vislam.batch.bundle.bundle_adjustment",
        "DaskTeam dask_client": "vislam.core.cluster",
        "LoopVerdict": "vislam.batch.bundle.loops",
        "PoseGraphFile": "vislam.batch.posegraph.files",
        "read_pose_graph write_pose_graph": "vislam.batch.posegraph.files",
        "PoseGraphSolution optimize_pose_graph": "vislam.batch.posegraph.optimize",
        "PoseGraphProblem": "vislam.batch.posegraph.problem",
        "SimulatedGraph false_loops measured_graph simulate_graph write_simulated": "vislam.batch.posegraph.worlds",
    },
)
