"""The start of a run: from the first samples and frames to a state one may believe."""

from vislam.frontend.start.initialisation import Initialisation, Initialiser, level_at_once, moved_to

__all__ = [
    "Initialisation",
    "Initialiser",
    "level_at_once",
    "moved_to",
]
