"""How worlds describe where a body goes: rounded polylines, travel with rests and pauses, smooth random motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.sim.motion.spline import BodySpline

_STEP_M = 0.01
_EYE_M = 1.25
_STEP_HZ = 1.8
_KNOTS_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class PlanarPath:
    """A curve in the plane, sampled densely along its length."""

    arc_m: Array  # [N]
    xy_m: Array  # [N, 2]
    heading_rad: Array  # [N], unwrapped

    @property
    def length_m(self) -> float:
        """Length of the curve."""
        return float(self.arc_m[-1])

    def at(self, arc_m: Array) -> tuple[Array, Array]:
        """Return points [N, 2] and headings [N] at arc lengths [N]; beyond the ends the ends are held."""
        x = np.interp(arc_m, self.arc_m, self.xy_m[:, 0])
        y = np.interp(arc_m, self.arc_m, self.xy_m[:, 1])
        return np.stack([x, y], axis=1), np.interp(arc_m, self.arc_m, self.heading_rad)


def rounded_path(waypoints_m: Sequence[tuple[float, float]], radius_m: float) -> PlanarPath:
    """Return the polyline through `waypoints_m` with its corners rounded by arcs of `radius_m`.

    Raises UsageError when two corners are too close for that radius.
    """
    points = np.asarray(waypoints_m, dtype=np.float64)
    pieces = []
    start = points[0]
    for previous, corner, following in zip(points[:-2], points[1:-1], points[2:], strict=True):
        incoming = (corner - previous) / np.linalg.norm(corner - previous)
        outgoing = (following - corner) / np.linalg.norm(following - corner)
        turn = np.arctan2(incoming[0] * outgoing[1] - incoming[1] * outgoing[0], incoming @ outgoing)
        if abs(turn) < 1e-6:
            continue
        reach = radius_m * np.tan(abs(turn) / 2.0)
        entry = corner - reach * incoming
        if (entry - start) @ incoming < 0.0:
            raise UsageError(f"path corners near {corner.tolist()} are too close for a radius of {radius_m} m")
        pieces.append(_line(start, entry))
        left = np.array([-incoming[1], incoming[0]]) * np.sign(turn)
        angles = np.linspace(0.0, abs(turn), max(2, int(radius_m * abs(turn) / _STEP_M)))[:, None]
        pieces.append(entry + radius_m * (np.sin(angles) * incoming + (1.0 - np.cos(angles)) * left))
        start = corner + reach * outgoing
    pieces.append(_line(start, points[-1]))
    xy = np.concatenate(pieces)
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    xy = xy[np.concatenate([[True], steps > 1e-9])]
    delta = np.diff(xy, axis=0)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(delta, axis=1))])
    heading = np.unwrap(np.arctan2(delta[:, 1], delta[:, 0]))
    return PlanarPath(arc, xy, np.append(heading, heading[-1]))


def _line(start: Array, end: Array) -> Array:
    count = max(2, int(np.linalg.norm(end - start) / _STEP_M))
    return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)


@dataclass(frozen=True, slots=True)
class Travel:
    """A journey along a path: rest, speed up, travel, slow down, pause, go on, rest."""

    length_m: float
    speed_m_s: float
    ramp_s: float
    rest_s: float  # before the start
    end_rest_s: float
    stops_m: tuple[float, ...] = ()  # pauses on the way, ascending
    pause_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """Time from the first to the last instant."""
        return self._nodes()[0][-1]

    def arc_m(self, t_s: Array) -> Array:
        """Return the distance travelled [N] at times [N]; beyond the ends the ends are held."""
        times, distances = self._nodes()
        t = np.clip(t_s, 0.0, times[-1])
        arc = np.zeros_like(t)
        for begin, end, done, until in zip(times[:-1], times[1:], distances[:-1], distances[1:], strict=True):
            inside = (t >= begin) & (t <= end)
            arc[inside] = done + self._leg(t[inside] - begin, end - begin, until - done)
        return arc

    def _nodes(self) -> tuple[list[float], list[float]]:
        stops = [*self.stops_m, self.length_m]
        times, distances = [0.0, self.rest_s], [0.0, 0.0]
        for index, stop in enumerate(stops):
            times.append(times[-1] + (stop - distances[-1]) / self.speed_m_s + self.ramp_s)
            distances.append(stop)
            times.append(times[-1] + (self.end_rest_s if index == len(stops) - 1 else self.pause_s))
            distances.append(stop)
        return times, distances

    def _leg(self, t: Array, duration_s: float, length_m: float) -> Array:
        """Return the distance along one leg; the speed rises and falls as a smoothstep, integrated in closed form."""
        if length_m == 0.0:
            return np.zeros_like(t)
        up = np.clip(t / self.ramp_s, 0.0, 1.0)
        down = np.clip((t - (duration_s - self.ramp_s)) / self.ramp_s, 0.0, 1.0)
        cruise = np.clip(t - self.ramp_s, 0.0, duration_s - 2.0 * self.ramp_s)
        ramped = (up**3 - 0.5 * up**4) + (down - down**3 + 0.5 * down**4)
        return self.speed_m_s * (cruise + self.ramp_s * ramped)


def smoothstep(t_s: Array, begin_s: float, end_s: float) -> Array:
    """Return 0 before `begin_s`, 1 after `end_s` and a curve with flat ends between."""
    x = np.clip((t_s - begin_s) / (end_s - begin_s), 0.0, 1.0)
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0)


def wander(t_s: Array, rng: np.random.Generator, rms: float, band_hz: tuple[float, float], columns: int) -> Array:
    """Return smooth random signals [N, columns] of the given rms: eight sinusoids spread over a frequency band."""
    count = 8
    frequency = np.exp(rng.uniform(np.log(band_hz[0]), np.log(band_hz[1]), (count, columns)))
    phase = rng.uniform(0.0, 2.0 * np.pi, (count, columns))
    waves = np.sin(2.0 * np.pi * frequency * t_s[:, None, None] + phase)
    return rms * np.sqrt(2.0 / count) * waves.sum(axis=1)


def walk(path: PlanarPath, travel: Travel, seed: int) -> BodySpline:
    """Return a walk along a path at the height of the chest, looking ahead; `seed` is that of the wandering gaze."""

    def design(t_s: Array) -> tuple[Array, Array]:
        arc = travel.arc_m(t_s)
        xy, heading = path.at(arc)
        walking = smoothstep(arc, 0.1, 1.5) * smoothstep(path.length_m - arc, 0.1, 1.5)
        step = 2.0 * np.pi * _STEP_HZ * t_s
        slow = wander(t_s, np.random.default_rng(seed), 1.0, (0.08, 0.35), 4) * walking[:, None]
        side = walking * 0.018 * np.sin(0.5 * step) + 0.04 * slow[:, 0]
        xy = xy + side[:, None] * np.column_stack([-np.sin(heading), np.cos(heading)])
        z = _EYE_M + walking * 0.014 * np.sin(step)
        roll = walking * 0.009 * np.sin(0.5 * step + 0.4) + 0.015 * slow[:, 1]
        pitch = 0.06 + walking * 0.007 * np.sin(step + 0.8) + 0.03 * slow[:, 2]
        return np.column_stack([xy, z]), np.column_stack([roll, pitch, heading + 0.07 * slow[:, 3]])

    return BodySpline.from_design(design, travel.duration_s, _KNOTS_S)
