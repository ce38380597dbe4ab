"""The start of a run: from the first samples and frames to a state one may believe."""

from vislam.frontend.start.answer import Initialisation, level_at_once, moved_to
from vislam.frontend.start.initialisation import Initialiser, Phase

__all__ = [
    "Initialisation",
    "Initialiser",
    "Phase",
    "level_at_once",
    "moved_to",
]
