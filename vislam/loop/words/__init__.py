"""Bags of words: the vocabulary, its tree, the index, and the database of keyframes.

Compiled by hand: 470 lines. Peers of a query at 1,000, 5,000, 10,000 and 50,000 keyframes (0.21, 0.34, 0.34 and 0.85
ms): scipy's sparse product (0.24, 0.26, 0.37 and 2.18 ms) and DBoW2 (1.7, 13 and 30 ms, not measured at 50,000;
benchmarks/RESULTS.md). So the index pays beyond 10,000 keyframes only: to be dropped for scipy's product if maps stay
smaller. The tree's transform (0.4 ms) has no measured peer.
"""

from vislam.loop.words.database import PlaceDatabase, seed_vocabulary, side_by_side
from vislam.loop.words.orbslam import read_orbslam
from vislam.loop.words.vocabulary import BagOfWords, Vocabulary, depth_for, train

__all__ = [
    "BagOfWords",
    "PlaceDatabase",
    "Vocabulary",
    "depth_for",
    "read_orbslam",
    "seed_vocabulary",
    "side_by_side",
    "train",
]
