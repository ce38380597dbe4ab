"""The back end: keyframes, odometry and loops in one graph; and `Graph`, for poses and measurements by hand."""

from vislam.core.memory import EdgeReport
from vislam.graph.graph import Graph, Optimised
from vislam.graph.pose_graph import PoseGraph

__all__ = ["EdgeReport", "Graph", "Optimised", "PoseGraph"]
