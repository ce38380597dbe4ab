"""Simulated vision without images: landmarks, and a tracker that follows them."""

from vislam.sim.points.points import MeasuredInertial, PointOptions, PointRecording, open_points

__all__ = [
    "MeasuredInertial",
    "PointOptions",
    "PointRecording",
    "open_points",
]
