"""Factors of the pose graph, built from plain measurements; the only room besides the graph that knows gtsam."""
