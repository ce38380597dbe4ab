"""Which observations leave with the oldest keyframe, so that none is ever used twice."""

from __future__ import annotations

import numpy as np

from vislam.window.equations import Ints
from vislam.window.tracks import TrackTable

_STAY = 2  # observations that a living track keeps, so that it goes on tying keyframes together
_SPREAD = 2654435761  # Knuth's multiplicative hash: neighbouring ids part at different places


def split(tracks: TrackTable, ids: Ints, least: int) -> tuple[Ints, Ints]:
    """Return rows that go into the prior, ordered as `arrange` wants them, and rows that are dropped.

    Of a track that the oldest keyframe `ids[0]` saw, the first observations go into the prior as a landmark of their
    own and the rest starts another; a track that has ended goes whole. Where a living track parts depends on its id,
    so that no two neighbouring keyframes lose all that ties them at once. A track too short to part loses its oldest
    observation. Parting costs three equations once in a while, where dropping costs two for each keyframe.
    """
    order, starts = tracks.ordered()
    slot, keyframe = tracks.slot[order], tracks.keyframe[order]
    ends = np.append(starts[1:], len(slot))
    given: list[Ints] = []
    dropped: list[Ints] = []
    old = keyframe[starts] == ids[0] if len(starts) > 0 else np.zeros(0, dtype=bool)
    names = tracks.track_ids(slot[starts])
    hosted = tracks.host[slot[starts]] == ids[0]
    for i in np.flatnonzero(old).tolist():
        rows, seen = order[starts[i] : ends[i]], keyframe[starts[i] : ends[i]]
        if not hosted[i]:  # never became a landmark
            dropped.append(rows[seen == ids[0]])
            continue
        moments = np.unique(seen)
        count = len(moments)
        if moments[-1] == ids[-1]:
            room = count - _STAY - least
            count = least + (int(names[i]) * _SPREAD >> 8) % (room + 1) if room >= 0 else 0
        if count == 0:
            dropped.append(rows[seen == ids[0]])
        else:
            given.append(rows[seen <= moments[count - 1]])
    nothing = np.zeros(0, dtype=np.int64)
    return np.concatenate([nothing, *given]), np.concatenate([nothing, *dropped])
