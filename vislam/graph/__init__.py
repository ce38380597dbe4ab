"""The back end: keyframes, odometry and loops in one graph."""

from vislam.factors.gate import EdgeReport
from vislam.graph.pose_graph import PoseGraph

__all__ = ["EdgeReport", "PoseGraph"]
