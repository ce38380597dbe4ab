"""Which loops a run believes while it goes on, keyframe by keyframe, in steps of milliseconds.

What speaks for a loop, the ladder of it, what a place is and when one set is likelier than another are those of
`factors.loop_evidence`, here and in `batch.posegraph`, which decides files, finished runs and joins as a whole. The
order of work is another one, measured on 66 true loops and as many false ones (tests/graph/test_false_loops.py):
decided by `batch.posegraph.auto`, a review took 0.1 to 0.7 s, and where odometry claims a third of its sigmas 38 % of
the true loops were kept and poses erred by 0.68 m. In steps of 1 to 3 ms, with odometry up to eight times worse among
the hypotheses, all are kept and poses err by 0.39 m.
"""

from vislam.graph.belief.loop_set import LoopSet

__all__ = [
    "LoopSet",
]
