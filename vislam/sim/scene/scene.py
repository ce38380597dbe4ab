"""The geometry of a simulated world: textured rectangles, discs and cylinders, and how they are put together.

Every surface is seen from one side only. A surface is described by its corner, two unit axes (`u` to the right and `v`
downwards as seen from outside, like an image) and its painter; `bake.py` turns the descriptions into the arrays that
the ray caster reads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImageU8

RECTANGLE, DISC, CYLINDER = 0, 1, 2

Painter = Callable[[np.random.Generator, int, int, float], ImageU8]
"""Paints a surface: generator, height px, width px, pixels per metre -> BGR image [H, W, 3]."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """One textured surface; `origin`, axes and normal are in the world frame."""

    kind: int
    origin: Array  # [3] top-left corner; of a cylinder, the centre of its top
    axis_u: Array  # [3] unit; of a cylinder, the direction of angle zero
    axis_v: Array  # [3] unit
    size_m: tuple[float, float]  # along u (a cylinder: its circumference) and v
    painter: Painter
    texels_per_m: float
    glow: float = 0.0  # light of its own, added to what falls on it: lamps, windows, screens
    name: str = "thing"  # what it belongs to; see `names.py`

    @property
    def normal(self) -> Array:
        """Outward unit normal; of a cylinder, the direction of a quarter turn to the right seen from outside."""
        if self.kind == CYLINDER:
            return np.cross(self.axis_u, self.axis_v)
        return np.cross(self.axis_v, self.axis_u)

    @property
    def radius_m(self) -> float:
        """Radius of a cylinder or disc."""
        return self.size_m[0] / (2.0 * np.pi) if self.kind == CYLINDER else self.size_m[0] / 2.0

    def bounding_box(self) -> tuple[Array, Array]:
        """Return the centre [3] and the three half axes [3, 3] (rows) of an oriented box around the surface."""
        half_v = 0.5 * self.size_m[1] * self.axis_v
        if self.kind == CYLINDER:
            radius = self.radius_m
            return self.origin + half_v, np.stack([radius * self.axis_u, half_v, radius * self.normal])
        half_u = 0.5 * self.size_m[0] * self.axis_u
        return self.origin + half_u + half_v, np.stack([half_u, half_v, np.zeros(3)])

    def point(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return points and outward normals [..., 3] at texture coordinates `u`, `v` in 0..1."""
        down = (v * self.size_m[1])[..., None] * self.axis_v
        if self.kind == CYLINDER:
            angle = (2.0 * np.pi * u)[..., None]
            normals = np.cos(angle) * self.axis_u + np.sin(angle) * self.normal
            return self.origin + down + self.radius_m * normals, normals
        points = self.origin + down + (u * self.size_m[0])[..., None] * self.axis_u
        return points, np.broadcast_to(self.normal, points.shape)


@dataclass(frozen=True, slots=True)
class Lamp:
    """A point-like lamp under the ceiling; its size softens the shadows."""

    position_m: tuple[float, float, float]
    power: float  # irradiance at 1 m, where 1 makes white paint white
    bgr: tuple[float, float, float] = (1.0, 1.0, 1.0)
    size_m: float = 0.5


@dataclass(slots=True, eq=False)
class SceneBuilder:
    """Collects surfaces, the solid boxes that throw shadows, and lamps."""

    surfaces: list[Surface] = field(default_factory=list)
    solids: list[tuple[Array, Array]] = field(default_factory=list)  # centre [3], half axes [3, 3]
    lamps: list[Lamp] = field(default_factory=list)
    ambient: float = 0.35
    name: str = "thing"  # of what is added

    def rectangle(
        self,
        corner: tuple[float, float, float] | Array,
        u: tuple[float, float, float] | Array,
        v: tuple[float, float, float] | Array,
        painter: Painter,
        texels_per_m: float = 200.0,
        glow: float = 0.0,
        kind: int = RECTANGLE,
    ) -> None:
        """Add a rectangle from its top-left corner and its edge vectors (to the right and down, seen from outside)."""
        u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
        length_u, length_v = float(np.linalg.norm(u)), float(np.linalg.norm(v))
        origin = np.asarray(corner, dtype=np.float64)
        size = (length_u, length_v)
        self.surfaces.append(
            Surface(kind, origin, u / length_u, v / length_v, size, painter, texels_per_m, glow, self.name)
        )

    def box(
        self,
        centre_xy: tuple[float, float],
        bottom_m: float,
        size_m: tuple[float, float, float],
        yaw_rad: float,
        side: Painter,
        top: Painter | None = None,
        front: Painter | None = None,
        texels_per_m: float = 220.0,
        show_bottom: bool = False,
    ) -> None:
        """Add a solid box standing at `bottom_m`; its front looks along its own +x axis, turned by `yaw_rad`."""
        x_axis = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
        y_axis = np.array([-np.sin(yaw_rad), np.cos(yaw_rad), 0.0])
        z_axis = np.array([0.0, 0.0, 1.0])
        length, width, height = size_m
        base = np.array([*centre_xy, bottom_m])
        for out, right, depth, across in (
            (x_axis, y_axis, length, width),
            (-x_axis, -y_axis, length, width),
            (y_axis, -x_axis, width, length),
            (-y_axis, x_axis, width, length),
        ):
            painter = front if front is not None and out is x_axis else side
            corner = base + 0.5 * depth * out - 0.5 * across * right + height * z_axis
            self.rectangle(corner, across * right, -height * z_axis, painter, texels_per_m)
        corner = base - 0.5 * length * x_axis + 0.5 * width * y_axis + height * z_axis
        self.rectangle(corner, length * x_axis, -width * y_axis, top or side, texels_per_m)
        if show_bottom:
            corner = base - 0.5 * length * x_axis - 0.5 * width * y_axis
            self.rectangle(corner, length * x_axis, width * y_axis, side, texels_per_m)
        half = 0.5 * np.stack([length * x_axis, width * y_axis, height * z_axis])
        self.solids.append((base + half[2], half))

    def cylinder(
        self,
        centre_xy: tuple[float, float],
        bottom_m: float,
        radius_m: float,
        height_m: float,
        side: Painter,
        top: Painter | None = None,
        texels_per_m: float = 220.0,
    ) -> None:
        """Add an upright cylinder with a disc on top."""
        top_centre = np.array([*centre_xy, bottom_m + height_m])
        size = (2.0 * np.pi * radius_m, height_m)
        frame_u, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
        self.surfaces.append(Surface(CYLINDER, top_centre, frame_u, down, size, side, texels_per_m, name=self.name))
        corner = top_centre + radius_m * np.array([-1.0, 1.0, 0.0])
        across = 2.0 * radius_m
        self.rectangle(corner, (across, 0.0, 0.0), (0.0, -across, 0.0), top or side, texels_per_m, kind=DISC)
        half = np.diag([0.9 * radius_m, 0.9 * radius_m, 0.5 * height_m])
        self.solids.append((top_centre - np.array([0.0, 0.0, 0.5 * height_m]), half))

    def add_turned(self, part: SceneBuilder, yaw_rad: float) -> None:
        """Add everything of another builder, turned about the vertical through the world's origin."""
        R = np.array(
            [[np.cos(yaw_rad), -np.sin(yaw_rad), 0.0], [np.sin(yaw_rad), np.cos(yaw_rad), 0.0], [0.0, 0.0, 1.0]]
        )
        for one in part.surfaces:
            turned = replace(one, origin=R @ one.origin, axis_u=R @ one.axis_u, axis_v=R @ one.axis_v)
            self.surfaces.append(turned)
        self.solids += [(R @ centre, half @ R.T) for centre, half in part.solids]
        for lamp in part.lamps:
            x, y, z = (R @ np.array(lamp.position_m)).tolist()
            self.lamps.append(replace(lamp, position_m=(x, y, z)))

    def lamp(self, position_m: tuple[float, float, float], power: float, bgr: tuple[float, float, float]) -> None:
        """Add a lamp without a visible body."""
        self.lamps.append(Lamp(position_m, power, bgr))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A baked world: what the ray caster reads, P surfaces with at most L mip levels each.

    A row of `geometry` holds origin [0:3], axis u [3:6], axis v [6:9], normal [9:12], size along u and v [12:14] in
    metres and texels per metre along u and v [14:16]: all that a ray asks of a surface lies in one stretch of memory.
    """

    kind: NDArray[np.int64]  # [P]
    geometry: Array  # [P, 16]
    centre: Array  # [P, 3] of the bounding box
    half: Array  # [P, 3, 3] its half axes
    texels: NDArray[np.uint32]  # [N] BGRX, display encoding, light included
    levels: NDArray[np.int64]  # [P, L, 3] offset into `texels`, width, height
    level_count: NDArray[np.int64]  # [P]
    labels: NDArray[np.uint8]  # [P] what each surface belongs to: 1 + its place in `names.NAMES`
    hung: Array  # [M, 6] what is painted on surfaces: surface, low u, low v, high u, high v in m, label

    def clearance_m(self, points: Array) -> Array:
        """Return the distance [N] from points [N, 3] to the nearest surface (discs count as their squares)."""
        best = np.full(len(points), np.inf)
        for index in range(len(self.kind)):
            offset = points - self.centre[index]
            local = offset @ self.geometry[index, 3:12].reshape(3, 3).T
            size = self.geometry[index, 12:14]
            if self.kind[index] == CYLINDER:
                radius = size[0] / (2.0 * np.pi)
                radial = np.abs(np.hypot(local[:, 0], local[:, 2]) - radius)
                along = np.maximum(np.abs(local[:, 1]) - 0.5 * size[1], 0.0)
                best = np.minimum(best, np.hypot(radial, along))
                continue
            beyond = np.maximum(np.abs(local[:, :2]) - 0.5 * size, 0.0)
            best = np.minimum(best, np.sqrt(beyond[:, 0] ** 2 + beyond[:, 1] ** 2 + local[:, 2] ** 2))
        return best
