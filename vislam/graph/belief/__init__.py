"""Which loops a run believes while it goes on, keyframe by keyframe, in steps of milliseconds.

A finished run, sessions that are joined and pose-graph files are decided whole, by `batch.posegraph.auto`.
"""

from vislam.graph.belief.loop_set import LoopSet

__all__ = [
    "LoopSet",
]
