"""Cameras: a webcam, or a video file in its place."""
