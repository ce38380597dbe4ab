"""Every default of vislam in one typed tree, with its unit and its reason.

`load` reads a TOML file and applies `{"section.field": value}` overrides; `dump` gives the resolved tree as plain data,
which every run writes down as `config.json`.
"""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError

from vislam.errors import UsageError

_STRICT = ConfigDict(extra="forbid")


@dataclass(frozen=True, slots=True)
class ImuConfig:
    """Inertial noise; None keeps what the recording's own sensor file says."""

    gyro_noise_density: float | None = None  # rad/s/sqrt(Hz)
    accel_noise_density: float | None = None  # m/s^2/sqrt(Hz)
    gyro_bias_walk: float | None = None  # rad/s^2/sqrt(Hz)
    accel_bias_walk: float | None = None  # m/s^3/sqrt(Hz)
    gravity_m_s2: float = 9.81
    buffer_s: float = 5.0  # history kept for spans and replays; covers vision latency many times over
    max_gap_s: float = 0.1  # a longer hole between samples is an outage, not something to interpolate across


@dataclass(frozen=True, slots=True)
class FrontEndConfig:
    """Feature tracking and visual odometry."""

    mode: Literal["auto", "mono", "stereo", "rgbd"] = "auto"  # auto: the richest the recording offers


@dataclass(frozen=True, slots=True)
class InitConfig:
    """How the first gravity-aligned state is found."""


@dataclass(frozen=True, slots=True)
class EkfConfig:
    """The fast path."""


@dataclass(frozen=True, slots=True)
class GraphConfig:
    """The iSAM2 pose graph."""


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """Loop detection and verification."""

    enabled: bool = True


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Clouds, the occupancy octree, the navigation grid and the mesh."""

    enabled: bool = True
    resolution_m: float = 0.05  # octree voxel and grid cell; fine enough for table edges, 4 ms per keyframe
    insertion: Literal["discretised", "full"] = "discretised"  # one ray per end voxel; full: one per pixel, 10x dearer
    hit_probability: float = 0.7  # OctoMap's sensor model, so that our maps are its maps
    miss_probability: float = 0.4
    clamp_min_probability: float = 0.1192  # OctoMap's clamping: a voxel changes its mind after a few contrary scans
    clamp_max_probability: float = 0.971
    min_range_m: float = 0.3  # nearer, structured-light depth and stereo matching are not valid
    max_range_m: float = 4.0  # depth noise grows with the square; farther points only clear the way to here
    pixel_step: int = 2  # keep every n-th row and column of a depth image; at 4 m still 3 pixels per voxel
    edge_ratio: float = 0.03  # a step to a neighbour pixel of more than this share of depth is an object's border
    speckle_pixels: int = 40  # smaller connected surfaces, in kept pixels, are noise
    stereo_scale: float = 0.5  # image scale for dense stereo; 30 ms per 752x480 keyframe
    stereo_disparity_sigma_px: float = 0.3  # of semi-global matching at that scale
    stereo_max_sigma_m: float = 0.15  # farther stereo points, with a larger error of depth, only clear the way
    move_voxels: float = 1.0  # a keyframe corrected by more than this many voxels is integrated again
    move_deg: float = 1.0  # or turned by more than this: 7 cm at 4 m
    rebuild_keyframes_per_call: int = 8  # bounded work per call while a correction is followed; 5 ms each
    cloud_voxel_m: float = 0.02  # one averaged point per voxel in cloud.ply
    cloud_min_points: int = 2  # depth pixels that must agree on a voxel of the cloud
    cloud_neighbours: int = 12  # statistical outlier removal: mean distance to so many neighbours
    cloud_outlier_sigma: float = 2.5  # may exceed the average by so many standard deviations
    grid_floor_m: float | None = None  # height of the floor in map; None: the lowest large horizontal surface
    grid_low_m: float = 0.10  # above the floor: lower things are driven over or are the floor's own noise
    grid_high_m: float = 1.60  # above the floor: higher things are driven under
    mesh: bool = False  # TSDF mesh by Open3D; a few seconds at export
    mesh_voxel_m: float = 0.02  # about the noise of depth at 3 m


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """The Rerun recording of a run."""

    enabled: bool = True


@dataclass(frozen=True, slots=True)
class Config:
    """The whole configuration of a run."""

    seed: int = 0  # of every random choice in the pipeline
    imu: ImuConfig = field(default_factory=ImuConfig)
    frontend: FrontEndConfig = field(default_factory=FrontEndConfig)
    init: InitConfig = field(default_factory=InitConfig)
    ekf: EkfConfig = field(default_factory=EkfConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    map: MapConfig = field(default_factory=MapConfig)
    view: ViewConfig = field(default_factory=ViewConfig)


def dump(config: Config) -> dict[str, Any]:
    """Return the configuration as plain nested data, ready for JSON."""
    return dataclasses.asdict(config)


def load(path: Path | None = None, overrides: dict[str, Any] | None = None) -> Config:
    """Build a configuration from defaults, a TOML file and dotted overrides such as `{"graph.coupling": "tight"}`.

    Raises UsageError naming the field, what was asked and what is allowed.
    """
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UsageError(f"config {path} cannot be read: {error}; see docs/config.md for an example") from error
    for dotted, value in (overrides or {}).items():
        *sections, name = dotted.split(".")
        node = data
        for section in sections:
            node = node.setdefault(section, {})
        node[name] = value
    return from_data(data, source=str(path) if path else "overrides")


def from_data(data: dict[str, Any], source: str) -> Config:
    """Build a configuration from plain nested data; unknown and ill-typed fields raise UsageError with `source`."""
    _refuse_unknown(data, Config, source)
    try:
        return TypeAdapter(Config).validate_python(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"{source}: {where}: {first['msg']}, got {first['input']!r}") from error


def _refuse_unknown(data: dict[str, Any], cls: type, source: str, prefix: str = "") -> None:
    known = {f.name: f for f in dataclasses.fields(cls)}
    for name, value in data.items():
        if name not in known:
            raise UsageError(f"{source}: no setting '{prefix}{name}'; this section has: {', '.join(known)}")
        factory = known[name].default_factory
        if isinstance(value, dict) and isinstance(factory, type) and dataclasses.is_dataclass(factory):
            _refuse_unknown(value, factory, source, f"{prefix}{name}.")
