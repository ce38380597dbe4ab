"""What leaves a window: observations with the oldest keyframe, so that none is used twice, and what is settled."""

from collections.abc import Sequence

import numpy as np

from vislam.core.geometry import invert
from vislam.core.messages import Array, NavState
from vislam.window.equations import Ints, Solution, joint_covariance
from vislam.window.keyframes import Keyframes
from vislam.window.messages import WindowEdge, WindowGravity
from vislam.window.posterior import nav_state, pose, tilt
from vislam.window.tracks import TrackTable

_STAY = 2  # observations that a living track keeps, so that it goes on tying keyframes together
_RESTART_SIGMA_M = 0.1  # of the state a window restarts from after a failed solution
_RESTART_SIGMA_RAD = 0.03
_RESTART_SPEED_SIGMA_M_S = 0.3
_RESTART_GYRO_BIAS_SIGMA_RAD_S = 0.01
_RESTART_ACCEL_BIAS_SIGMA_M_S2 = 0.1
_MAX_SPEED_M_S = 300.0  # a prediction that is faster is nonsense to restart from
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


def settled(
    keyframes: Keyframes, solution: Solution, T: Array, P: Array, full: bool
) -> tuple[list[WindowEdge], list[WindowGravity], list[tuple[int, NavState]]]:
    """Return what is final about the oldest keyframe: its edge T [4, 4] of covariance P [6, 6], tilt and state."""
    oldest, after = int(keyframes.ids[0]), int(keyframes.ids[1])
    edge = [WindowEdge(oldest, after, T, P, True)]
    if not full:
        return edge, [], []
    index = np.concatenate([9 * len(keyframes) + np.arange(6), np.arange(9)])
    covariance = joint_covariance(solution.U, index)
    state = nav_state(int(keyframes.t_ns[0]), keyframes.X[0], covariance)
    return edge, [tilt(oldest, keyframes.X[0], covariance[:3, :3])], [(oldest, state)]


def broken_off(keyframes: Keyframes, last_edges: Sequence[WindowEdge]) -> tuple[NavState, tuple[WindowEdge, ...]]:
    """Return the newest state as the last good solution predicts it, wide, and the edges of all keyframes before it.

    These have the covariance of that solution; the last one is as wide as the state.
    """
    ids, X = keyframes.ids, keyframes.X
    wide = np.repeat(
        [
            _RESTART_SIGMA_RAD,
            _RESTART_SIGMA_M,
            _RESTART_SPEED_SIGMA_M_S,
            _RESTART_GYRO_BIAS_SIGMA_RAD_S,
            _RESTART_ACCEL_BIAS_SIGMA_M_S2,
        ],
        3,
    )
    covariance = np.diag(wide**2)
    known = {(e.from_id, e.to_id): e.covariance for e in last_edges}
    dt_s = float(keyframes.t_ns[-1] - keyframes.t_ns[-2]) * 1e-9 if len(ids) > 1 else 0.0
    x = X[-1]
    if len(ids) > 1 and not np.abs(x[9:12] - X[-2, 9:12]).max() < _MAX_SPEED_M_S * dt_s:  # NaN too
        x = X[-1] = X[-2]
    edges = tuple(
        WindowEdge(a, b, invert(pose(xa)) @ pose(xb), known.get((a, b), covariance[:6, :6]), True)
        for a, b, xa, xb in zip(ids[:-1].tolist(), ids[1:].tolist(), X[:-1], X[1:], strict=True)
    )
    return nav_state(int(keyframes.t_ns[-1]), x, covariance), edges
