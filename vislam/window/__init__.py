"""Tight coupling: a sliding window of keyframe states and landmarks, optimised by Gauss-Newton."""
