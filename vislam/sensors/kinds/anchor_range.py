"""Ranges to anchors, as ultra-wide band measures them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from vislam.config.ranges import Finite, NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.alignment import with_shared_errors
from vislam.sensors.body import BodyState
from vislam.sensors.measuring_frame import (
    ANYWHERE_M,
    FrameKind,
    about_up,
    frame_variables,
    placed,
    thinned_pairs,
    vector_variables,
)
from vislam.sensors.ranging import Prior, Ranges, ranged_frame
from vislam.sensors.sensor import Begun, Configured, Variable, noisy

_MOST_ANCHORS = 256
_TOUCHING_M = 1e-6  # an antenna at its anchor has no direction to it


@dataclass(frozen=True, slots=True)
class AnchorRangeSettings:
    """Settings of `range`."""

    anchors: Mapping[str, Vector3] = field(default_factory=dict)  # place by number, "7" or "0x1a", in their frame
    sigma_m: Positive = 0.1
    anchor_sigma_m: NonNegative = 0.0  # above 0 the anchors' places are estimated
    frame: FrameKind = "own"  # "known": anchors are in the world already
    frame_z_m: Finite = 0.0  # of the world's origin in the anchors' frame: ranges in one plane do not show it
    frame_z_sigma_m: Positive = ANYWHERE_M
    lever_m: Vector3 = (0.0, 0.0, 0.0)  # of the antenna in the body
    lever_sigma_m: NonNegative = 0.0  # above 0 it is estimated
    bias_m: Finite = 0.0  # by which all ranges are too long
    bias_sigma_m: NonNegative = 0.0  # above 0 it is estimated
    bias_walk_m_per_sqrt_s: NonNegative = 0.0
    scale_sigma: NonNegative = 0.0  # above 0 it is estimated how many times the distance a range is


class AnchorRange(Configured):
    """The distance from an antenna to one of several anchors."""

    Settings = AnchorRangeSettings
    columns = ("anchor", "range_m")
    sigma_columns = ("sigma_range_m",)
    touches = ("rotation", "position")

    def __init__(self, settings: AnchorRangeSettings | None = None) -> None:
        """Take settings. Raises UsageError for anchors that are none."""
        self.settings = s = settings or AnchorRangeSettings()
        self._anchors = _numbered(s.anchors)
        self.sources = tuple(self._anchors)
        frame = frame_variables(s.frame, up=(s.frame_z_m, s.frame_z_sigma_m))
        anchors: tuple[Variable, ...] = ()
        self._at: dict[int, int] = {}  # where an anchor's place stands among the own variables
        for number, place in self._anchors.items():
            self._at[number] = len(frame) + len(anchors)
            anchors += vector_variables(f"anchor_{number}", (place[0], place[1], place[2]), s.anchor_sigma_m)
        lever = vector_variables("lever", s.lever_m, s.lever_sigma_m)
        bias = (Variable("bias_m", s.bias_sigma_m, s.bias_m, s.bias_walk_m_per_sqrt_s),) if s.bias_sigma_m else ()
        scale = (Variable("scale", s.scale_sigma, 1.0),) if s.scale_sigma else ()
        self.variables = frame + anchors + lever + bias + scale
        self._frame, self._moving = len(frame), bool(anchors)
        self._lever = slice(len(frame + anchors), len(frame + anchors + lever))
        self._bias = slice(self._lever.stop, self._lever.stop + len(bias))
        self._scale = slice(self._bias.stop, len(self.variables))
        self._lever_m: Array = np.array(s.lever_m, dtype=np.float64)

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted range [1]."""
        return values[1:] - self._predicted(int(values[0]), body, own)

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [1, 15] and H_own [1, V]."""
        number = int(values[0])
        antenna = placed(body, own[: self._frame], self._lever_of(own))
        away = antenna.point_m - self._anchor(number, own)
        distance_m = float(np.linalg.norm(away))
        ray = self._scale_of(own) * away / max(distance_m, _TOUCHING_M)
        H_own = np.zeros((1, len(own)))
        H_own[0, : self._frame] = ray @ antenna.by_frame
        if self._moving:
            H_own[0, self._at[number] : self._at[number] + 3] = -ray
        if self._lever.stop > self._lever.start:
            H_own[0, self._lever] = ray @ antenna.by_lever
        H_own[0, self._bias] = 1.0
        H_own[0, self._scale] = distance_m
        return (ray @ antenna.H)[None], H_own

    def noise(self, values: Array) -> Array:
        """Return the variance [1, 1] of a range that brings none."""
        return np.array([[self.settings.sigma_m**2]])

    def channel(self, values: Array) -> int:
        """Return the anchor: several may be ranged at once."""
        return int(values[0])

    def check(self, values: Array) -> str:
        """Return why a range is none: of another anchor, or negative."""
        if values[0] not in self._anchors:
            return f"anchor {values[0]:g} is not among {', '.join(map(str, self._anchors))}"
        return "" if values[1] >= 0.0 else f"a negative range, {values[1]:g} m"

    def begin(self, readings: Sequence[Reading], bodies: Sequence[BodyState]) -> Begun | None:
        """Return the anchors' frame once ranges along the path distinguish it from its mirror images."""
        usual = super().begin(readings, bodies)
        if not self._frame or usual is None:
            return usual
        readings, bodies = thinned_pairs(readings, bodies)
        world = [body.position_m + body.R_world_body @ self._lever_m for body in bodies]
        variances = [r.covariance[0, 0] if r.covariance is not None else self.settings.sigma_m**2 for r in readings]
        far = np.array([r.values[1] for r in readings])
        settled = self.settings.anchor_sigma_m**2 + self.settings.lever_sigma_m**2
        unsure = settled + (self.settings.scale_sigma * far) ** 2
        seen = Ranges(
            np.array(world).reshape(-1, 3),
            np.array([self._anchors[int(r.values[0])] for r in readings]).reshape(-1, 3),
            far,
            np.sqrt(np.array(variances) + unsure),
        )
        rows = [*range(4), self._bias.start] if self._bias.stop > self._bias.start else list(range(4))
        known = Prior(np.zeros(5), np.zeros(5))
        known.starts[4] = self.settings.bias_m
        known.starts[: len(rows)], known.sigmas[: len(rows)] = usual.values[rows], usual.sigmas[rows]
        found = ranged_frame(seen, known)
        if found is None:
            return None
        usual.values[rows], usual.sigmas[rows] = found.values[: len(rows)], found.sigmas[: len(rows)]
        H_own = np.vstack([self.jacobians(r.values, b, usual.values)[1] for r, b in zip(readings, bodies, strict=True)])
        return with_shared_errors(usual, rows, self.variables, H_own, seen.sigmas_m)

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the range from a true body to an anchor that is chosen by chance."""
        number = int(rng.choice(list(self._anchors)))
        exact = self._predicted(number, body, own)
        return np.array([number, *noisy(exact, self.noise(exact), rng)])

    def about(self, path_m: Array, own: Array) -> Array:
        """Return own variables with a frame in which the middle of the path is at the middle of the anchors.

        By their sigmas alone the path would be ten kilometres off, where all ranges are alike and show no heading. Its
        height is kept where it is given, and else the world's origin is at that of the frame.
        """
        if not self._frame:
            return own
        anchors = np.array([self._anchor(number, own) for number in self._anchors])
        middle, there = (0.5 * (places.min(axis=0) + places.max(axis=0)) for places in (path_m, anchors))
        out = own.copy()
        out[1:3] = (there - about_up(float(own[0])) @ middle)[:2]
        if self.settings.frame_z_sigma_m >= ANYWHERE_M:
            out[3] = self.settings.frame_z_m
        return out

    def _predicted(self, number: int, body: BodyState, own: Array) -> Array:
        antenna = placed(body, own[: self._frame], self._lever_of(own)).point_m
        bias = own[self._bias] if self._bias.stop > self._bias.start else np.array([self.settings.bias_m])
        return self._scale_of(own) * np.linalg.norm(antenna - self._anchor(number, own)) + bias

    def _anchor(self, number: int, own: Array) -> Array:
        return own[self._at[number] : self._at[number] + 3] if self._moving else self._anchors[number]

    def _scale_of(self, own: Array) -> float:
        return float(own[self._scale.start]) if self._scale.stop > self._scale.start else 1.0

    def _lever_of(self, own: Array) -> Array:
        return own[self._lever] if self._lever.stop > self._lever.start else self._lever_m


def _numbered(anchors: Mapping[str, Vector3]) -> dict[int, Array]:
    """Return places [3] by number."""
    if not 1 <= len(anchors) <= _MOST_ANCHORS:
        raise UsageError(f"{len(anchors)} anchors; 1 to {_MOST_ANCHORS} are allowed: anchors = {{1 = [x, y, z], ...}}")
    numbered: dict[int, Array] = {}
    for name, place in anchors.items():
        try:
            number = int(name, 0)
        except ValueError:
            raise UsageError(f"anchor {name!r} has to be a number, such as 7 or 0x1a") from None
        if number in numbered or not 0 <= number < 2**53:
            raise UsageError(f"anchor {name!r} is given twice, or its number is negative or above 2^53")
        if not all(map(math.isfinite, place)):
            raise UsageError(f"anchor {name!r} is at {list(place)}; a finite place [x, y, z] in metres is asked")
        numbered[number] = np.array(place, dtype=np.float64)
    return numbered
