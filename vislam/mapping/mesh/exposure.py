"""What pictures of one surface differ by in exposure and white balance, and what to multiply each by to undo it.

Gains as in Brown and Lowe, "Automatic panoramic image stitching using invariant features", IJCV 2007, but of logarithms
and per channel: a camera's gamma turns a longer exposure into a factor, too.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from vislam.core.messages import Array, ImageU8

_DARK, _BRIGHT = 12, 243  # what is darker is noise, what is brighter may be cut off
_SIGMA_LOG = 0.1  # of a sample: gloss, blur and poses
_SIGMA_GAIN = 0.4  # of a gain that nothing is known of
_ASTRAY = 0.3  # from the mean of the others, in logarithms: something else is seen there
_PASSES = 2  # the second without what the first shows to be astray


def exposure_gains(seen: Sequence[tuple[NDArray[np.int64], ImageU8]], count: int) -> Array:
    """Return factors [V, 3] for the red, green and blue of V views under which they agree on what they see together.

    Their geometric mean is 1: brighter all, and what is white is lost.

    Args:
        seen: of each view, which of the places it sees, and their colours [M, 3].
        count: of the places.
    """
    if not seen:
        return np.ones((0, 3))
    place = np.concatenate([places for places, _ in seen])
    view = np.repeat(np.arange(len(seen)), [len(places) for places, _ in seen])
    colors = np.concatenate([of_view for _, of_view in seen]).astype(np.float64)
    usable = ((colors > _DARK) & (colors < _BRIGHT)).all(axis=1)
    place, view, logs = place[usable], view[usable], np.log(colors[usable])
    gains = np.zeros((len(seen), 3))
    good = np.ones(len(place), np.bool_)
    for _ in range(_PASSES):
        gains = _solved(place[good], view[good], logs[good], (count, len(seen)))
        at = logs + gains[view]
        often = np.maximum(np.bincount(place[good], minlength=count), 1)
        mean = np.column_stack([np.bincount(place[good], at[good, c], count) / often for c in range(3)])
        good = (np.abs(at - mean[place]) < _ASTRAY).all(axis=1)
    return np.exp(gains)


def _solved(place: NDArray[np.int64], view: NDArray[np.int64], logs: Array, size: tuple[int, int]) -> Array:
    """Return logarithms of gains [V, 3]; what a place is like is eliminated, and gains without any evidence are 0."""
    saw = csr_matrix((np.ones(len(place)), (place, view)), shape=size)
    often = np.maximum(np.bincount(place, minlength=size[0]), 1)
    together = saw.T @ csr_matrix(saw.multiply(1.0 / often[:, None]))
    H = np.diag(np.bincount(view, minlength=size[1]).astype(np.float64)) - together.toarray()
    mean = np.column_stack([np.bincount(place, logs[:, c], size[0]) for c in range(3)]) / often[:, None]
    g = np.column_stack([np.bincount(view, (logs - mean[place])[:, c], size[1]) for c in range(3)])
    return -np.linalg.solve(H + (_SIGMA_LOG / _SIGMA_GAIN) ** 2 * np.eye(size[1]), g)
