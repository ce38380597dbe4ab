"""Telemetry in video files: the tables of an MP4, and GoPro's GPMF track in it."""

from vislam.datasets.telemetry.gpmf_track import Telemetry, open_telemetry
from vislam.datasets.telemetry.mp4 import frame_times_ns, is_mp4

__all__ = ["Telemetry", "frame_times_ns", "is_mp4", "open_telemetry"]
