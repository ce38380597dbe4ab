"""Every default of vislam in one typed tree, with its unit and its reason.

`load` reads a TOML file and applies `{"section.field": value}` overrides; `dump` gives the resolved tree as plain data,
which every run writes down as `config.json`.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from vislam.config.batch import BatchConfig, GraphWorldConfig, PoseGraphConfig
from vislam.config.estimators import EkfConfig, GraphConfig, PublishConfig, WindowConfig
from vislam.config.frontend import CalibrationConfig, FrontEndConfig, InitConfig, PlanarConfig
from vislam.config.inertial import AttitudeConfig, ImuConfig, PowerUpConfig, VibrationConfig
from vislam.config.live import LiveConfig, VerdictConfig, ViewConfig
from vislam.config.loop import LoopConfig, LoopTruthConfig
from vislam.config.machine import USUAL_SLIP_M_S, MachineConfig
from vislam.config.mapping import DriveConfig, LabelConfig, MapConfig, MapProduct, MonoDepthConfig
from vislam.config.moved import known, renamed
from vislam.config.profiles import merged, profile
from vislam.config.ranges import Finite, NonNegative, Positive, Seed, check_ranges
from vislam.config.sensors import (
    Axes,
    BoardConfig,
    BridgeClockConfig,
    DepthCameraConfig,
    FurtherSensorsConfig,
    Gy85Config,
    ImuChip,
    LibraryCameraConfig,
    Matrix3,
    OakConfig,
    PicamConfig,
    RealsenseConfig,
    RecordConfig,
    SensorCalibration,
    SensorsConfig,
    SerialConfig,
    Vector3,
    WebcamConfig,
)
from vislam.core.errors import UsageError
from vislam.core.reading import read_toml

__all__ = [
    "USUAL_SLIP_M_S",
    "AttitudeConfig",
    "Axes",
    "BatchConfig",
    "BoardConfig",
    "BridgeClockConfig",
    "CalibrationConfig",
    "Config",
    "DepthCameraConfig",
    "DriveConfig",
    "EkfConfig",
    "Finite",
    "FrontEndConfig",
    "FurtherSensorsConfig",
    "GraphConfig",
    "GraphWorldConfig",
    "Gy85Config",
    "ImuChip",
    "ImuConfig",
    "InitConfig",
    "LabelConfig",
    "LibraryCameraConfig",
    "LiveConfig",
    "LoopConfig",
    "LoopTruthConfig",
    "MachineConfig",
    "MapConfig",
    "MapProduct",
    "Matrix3",
    "MonoDepthConfig",
    "NonNegative",
    "OakConfig",
    "PicamConfig",
    "PlanarConfig",
    "PoseGraphConfig",
    "Positive",
    "PowerUpConfig",
    "PublishConfig",
    "RealsenseConfig",
    "RecordConfig",
    "SensorCalibration",
    "SensorsConfig",
    "SerialConfig",
    "Vector3",
    "VerdictConfig",
    "VibrationConfig",
    "ViewConfig",
    "WebcamConfig",
    "WindowConfig",
    "dump",
    "from_data",
    "load",
    "load_cart",
    "load_sensors",
    "recorded",
    "validated",
]

Options = TypeVar("Options")


@dataclass(frozen=True, slots=True)
class Config:
    """The whole configuration of a run."""

    seed: Seed = 0  # of every random choice in the pipeline
    up: str = "auto"  # without an IMU: X,Y,Z in the first camera's axes, camera (as its first image has it) or none
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    machine: MachineConfig = field(default_factory=MachineConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    sensors: FurtherSensorsConfig = field(default_factory=FurtherSensorsConfig)
    frontend: FrontEndConfig = field(default_factory=FrontEndConfig)
    init: InitConfig = field(default_factory=InitConfig)
    ekf: EkfConfig = field(default_factory=EkfConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    batch: BatchConfig = field(default_factory=BatchConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    map: MapConfig = field(default_factory=MapConfig)
    live: LiveConfig = field(default_factory=LiveConfig)
    power_up: PowerUpConfig = field(default_factory=PowerUpConfig)
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)
    verdict: VerdictConfig = field(default_factory=VerdictConfig)
    view: ViewConfig = field(default_factory=ViewConfig)


def dump(config: Config) -> dict[str, Any]:
    """Return the configuration as plain nested data, ready for JSON."""
    return dataclasses.asdict(config)


def load(
    base: Path | Config | None = None, overrides: Mapping[str, Any] | None = None, profile_name: str | None = None
) -> Config:
    """Build a configuration from defaults, a profile, a TOML file or configuration, and overrides.

    Overrides are dotted names, `{"map.enabled": False}`, or sections, `{"map": {"enabled": False}}`. Each goes before
    those named before it. Raises UsageError naming the field, what was asked and what is allowed.
    """
    data = {} if profile_name is None else profile(profile_name)
    if base is not None:
        data = merged(data, dump(base) if isinstance(base, Config) else _read_toml(base))
    for dotted, value in (overrides or {}).items():
        section, *rest = reversed(dotted.split("."))
        nested = {section: value}
        for name in rest:
            nested = {name: nested}
        data = merged(data, nested)
    return from_data(data, source=str(base) if isinstance(base, Path) else "overrides")


def load_sensors(path: Path | None = None) -> SensorsConfig:
    """Return the sensors of a cart as a TOML file describes them; raises UsageError as `load` does."""
    return load_cart(path)[0]


def load_cart(path: Path | None) -> tuple[SensorsConfig, FurtherSensorsConfig]:
    """Return the sensors of a cart, and where further ones are described: in the same file, by `[sensors.NAME]`.

    Raises UsageError as `load` does.
    """
    data = {} if path is None else _read_toml(path)
    has_further = data.pop("sensors", None) is not None  # `vislam.sensors.toml` makes something of them
    _refuse_unknown(data, SensorsConfig, str(path))
    return validated(SensorsConfig, data, str(path)), FurtherSensorsConfig(str(path) if has_further else None)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"config {path} cannot be read: {error}; see docs/config.md for an example") from error


def from_data(data: dict[str, Any], source: str) -> Config:
    """Build a configuration from plain nested data; unknown and ill-typed fields raise UsageError with `source`."""
    data = renamed(data, source)
    _refuse_unknown(data, Config, source)
    return validated(Config, data, source)


def recorded(data: Any, source: str) -> dict[str, Any]:
    """Return the settings that a run of this version or an earlier one wrote down, by the names of this version.

    What is a setting no longer is left out. Raises UsageError where they are no settings or contradict each other.
    """
    if not isinstance(data, dict):
        raise UsageError(f"{source} holds no settings; run the recording again")
    return known(renamed(data, source), dump(Config()))


def validated(cls: type[Options], data: Mapping[str, Any], where: str) -> Options:
    """Build a dataclass from plain data; what is unknown, ill-typed or out of range raises UsageError with `where`."""
    known = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for name in data:
        if name not in known:
            raise UsageError(f"{where}: no option '{name}'; there are: {', '.join(known)}")
    from pydantic import ValidationError  # takes a tenth of a second to load, and most never read a file

    try:
        options: Options = _validator(cls).validate_python(data)  # type: ignore[arg-type] # a class is hashable
    except ValidationError as error:
        first = error.errors()[0]
        field_path = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"{where}: option {field_path}: {first['msg']}, got {first['input']!r}") from error
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error
    check_ranges(options, where)
    return options


@cache
def _validator(cls: type) -> Any:
    """Return pydantic's adapter of a dataclass, which takes longer to build than data to be checked by it."""
    from pydantic import TypeAdapter

    return TypeAdapter(cls)


def _refuse_unknown(data: dict[str, Any], cls: type, source: str, prefix: str = "") -> None:
    known = {f.name: f for f in dataclasses.fields(cls)}
    for name, value in data.items():
        if name not in known:
            raise UsageError(f"{source}: no setting '{prefix}{name}'; this section has: {', '.join(known)}")
        factory = known[name].default_factory
        if isinstance(value, dict) and isinstance(factory, type) and dataclasses.is_dataclass(factory):
            _refuse_unknown(value, factory, source, f"{prefix}{name}.")
