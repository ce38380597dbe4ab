"""Where sensors sit: the frames of a bag as its static transforms give them."""

from __future__ import annotations

from typing import Any

import numpy as np

from vislam.core.geometry import invert, rotation_from_quaternion_xyzw
from vislam.core.messages import Array

_MOST_FRAMES = 10_000
_SAME = 1e-9  # of a transform that is repeated


class Frames:
    """A tree of frames, of transforms that are static or were the same every time."""

    def __init__(self) -> None:
        """Begin without any."""
        self._parents: dict[str, tuple[str, Array]] = {}
        self._moving: set[str] = set()

    def learn(self, message: Any) -> None:
        """Take the transforms of a TFMessage; those that are no rigid motion are left out."""
        for given in message.transforms:
            child, parent = _name(given.child_frame_id), _name(given.header.frame_id)
            t, q = given.transform.translation, given.transform.rotation
            T = rigid((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
            if T is None or child == parent or len(self._parents) >= _MOST_FRAMES:
                continue
            known = self._parents.get(child)
            if known is not None and (known[0] != parent or not np.allclose(known[1], T, rtol=0.0, atol=_SAME)):
                self._moving.add(child)
            self._parents[child] = (parent, T)

    def between(self, a: str, b: str) -> Array | None:
        """Return `T_a_b` [4, 4], None where the two are not joined by frames that keep still."""
        a, b = _name(a), _name(b)
        if a == b:
            return np.eye(4)
        above_a, above_b = self._above(a), self._above(b)
        common = next((name for name in above_a if name in above_b), None)
        return None if common is None else invert(above_a[common]) @ above_b[common]

    def _above(self, name: str) -> dict[str, Array]:
        """Return `T_ancestor_name` of a frame and all above it; a circle ends where it closes."""
        found, T = {name: np.eye(4)}, np.eye(4)
        while name in self._parents and name not in self._moving:
            name, T_parent_child = self._parents[name]
            if name in found:
                break
            T = T_parent_child @ T
            found[name] = T
        return found


def rigid(position: tuple[float, float, float], quaternion_xyzw: tuple[float, float, float, float]) -> Array | None:
    """Return a pose [4, 4], None where the numbers are none."""
    q, t = np.array(quaternion_xyzw, dtype=np.float64), np.array(position, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not (np.all(np.isfinite(t)) and abs(norm - 1.0) < 0.1):
        return None
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion_xyzw(q[None] / norm)[0]
    T[:3, 3] = t
    return T


def _name(frame: str) -> str:
    return frame.removeprefix("/")  # as the first tf wrote them
