"""Telemetry in video files: the tables of an MP4, GoPro's GPMF track in it, and the chapters of a long recording."""

from vislam.datasets.telemetry.chapters import Film, JoinedTelemetry, joined_film, later_chapters, open_joined
from vislam.datasets.telemetry.gpmf_track import Telemetry, open_telemetry
from vislam.datasets.telemetry.mp4 import frame_times_ns, is_mp4

__all__ = [
    "Film", "JoinedTelemetry", "Telemetry", "frame_times_ns", "is_mp4", "joined_film", "later_chapters", "open_joined",
    "open_telemetry",
]  # fmt: skip
