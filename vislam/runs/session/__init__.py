"""The crash-safe store of a run: all that was measured and decided, up to the last keyframe, in one SQLite file.

A keyframe is committed in one transaction, so whatever ends the process leaves the last committed keyframe readable.
Arrays are stored as raw little-endian bytes with fixed types; nothing is pickled. From what is stored a run goes on
(`recall`), and a batch estimate starts (`Session.factor_log`), without an image.
"""

from vislam.runs.session.reader import Session, StoredKeyframe, has_begun, has_frames
from vislam.runs.session.recalling import can_go_on, recall
from vislam.runs.session.writer import SessionWriter

__all__ = ["Session", "SessionWriter", "StoredKeyframe", "can_go_on", "has_begun", "has_frames", "recall"]
