"""The back end: keyframes, odometry and loops in one graph."""

from vislam.core.memory import EdgeReport
from vislam.graph.pose_graph import PoseGraph

__all__ = ["EdgeReport", "PoseGraph"]
