"""Which loops to believe: the one place that decides, for live runs and finished ones."""

from vislam.graph.belief.loop_set import LoopSet

__all__ = [
    "LoopSet",
]
