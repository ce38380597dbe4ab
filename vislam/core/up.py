"""Which way is up in the map of a run that has no IMU, and how anybody knows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from vislam.core.errors import UsageError
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array

UpSource = Literal["told", "accelerometer", "map", "floor", "planes", "camera", "unknown"]
WORDS = ("auto", "camera", "none")  # of --up: find out; the first image's up is up; unknown
_LEAST_LENGTH = 1e-6  # of a vector with a direction
_UNIT = 1e-6  # by how much the length of a stored direction may differ from one
_SAME = 1e-9  # rad: directions that differ by less are one


@dataclass(frozen=True, slots=True, eq=False)
class Up:
    """The direction of up, where it comes from and how sure that is.

    Attributes:
        source: where it is from; "unknown" where there is none.
        direction: unit vector [3] in the frame in which the run was estimated; None where it is unknown.
        sigma_deg: of the direction, one sigma about each horizontal axis; None where that is unknown.
        confidence: 0 to 1, that it is this direction and no other; 0 where it is unknown.
        reason: one sentence for people: what it is made of, or why it is not known.
    """

    source: UpSource
    direction: Array | None
    sigma_deg: float | None
    confidence: float
    reason: str

    @property
    def is_known(self) -> bool:
        """Whether there is a direction."""
        return self.direction is not None

    @property
    def T_level_map(self) -> Array:
        """The rotation [4, 4] about the origin that turns up onto +z and nothing besides; identity where unknown."""
        return np.eye(4) if self.direction is None else transform(turn_to_z(self.direction), np.zeros(3))

    @property
    def levelled(self) -> Up:
        """The same in the frame that T_level_map leads to, where up is +z."""
        return self if self.direction is None else replace(self, direction=np.array([0.0, 0.0, 1.0]))

    @classmethod
    def unknown(cls, reason: str) -> Up:
        """Return that it is unknown, and why."""
        return cls("unknown", None, None, 0.0, reason)

    @classmethod
    def from_entry(cls, entry: dict[str, Any]) -> Up:
        """Return what `entry` gave. Raises KeyError, TypeError or ValueError where it is something else."""
        direction = entry["direction"]
        if direction is not None:
            direction = np.array(direction, dtype=np.float64)
            if direction.shape != (3,) or not abs(float(np.linalg.norm(direction)) - 1.0) < _UNIT:
                raise ValueError("its direction is no unit vector")
        return cls(entry["source"], direction, entry["sigma_deg"], float(entry["confidence"]), str(entry["reason"]))

    def entry(self) -> dict[str, Any]:
        """Return it as metrics.json and session.db have it."""
        return {
            "source": self.source,
            "direction": None if self.direction is None else np.asarray(self.direction, dtype=np.float64).tolist(),
            "sigma_deg": self.sigma_deg,
            "confidence": self.confidence,
            "reason": self.reason,
        }


def parse_up(text: str) -> Array | str:
    """Return what `--up` sets: one of the words of `WORDS`, or a unit vector [3] in the first camera's axes.

    Raises UsageError for anything else.
    """
    word = text.strip().lower()
    if word in WORDS:
        return word
    try:
        vector = np.array([float(part) for part in text.split(",")])
    except ValueError:
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else np.nan
    if not np.isfinite(length) or length < _LEAST_LENGTH:
        raise UsageError(
            f"--up '{text}' is no direction; give X,Y,Z in the first camera's axes (x right, y down, z forward; "
            f"--up=0,-1,0 is the image's own up), or one of {', '.join(WORDS)}"
        )
    return np.asarray(vector / length)


def turn_to_z(up: Array) -> Array:
    """Return the smallest rotation [3, 3] that takes the unit vector `up` [3] onto +z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, up[2]))
    if sine < _SAME:
        axis, sine = np.array([1.0, 0.0, 0.0]), 1.0  # straight up already, or upside down: any level axis will do
    return np.asarray(so3_exp(axis / sine * angle))
