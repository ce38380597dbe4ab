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
    """Clouds and the occupancy octree."""

    enabled: bool = True


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
