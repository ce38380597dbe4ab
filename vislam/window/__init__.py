"""Tight coupling: a sliding window of keyframe states and landmarks, optimised by Gauss-Newton."""

from vislam.window.by_hand import Window
from vislam.window.messages import CalibrationEstimate, WindowEdge, WindowGravity, WindowUpdate
from vislam.window.window import SlidingWindow

__all__ = ["CalibrationEstimate", "SlidingWindow", "Window", "WindowEdge", "WindowGravity", "WindowUpdate"]
