"""The sensors of one machine from a TOML file: `[sensors.NAME]` with kind, file and settings."""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vislam.config import SensorsConfig, validated
from vislam.config.ranges import Count, Finite, NonNegative, Positive, Probability
from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.core.reading import read_toml
from vislam.core.readings import Reading
from vislam.sensors.correlated import Correlated
from vislam.sensors.geodetic import Geodetic, why_nowhere
from vislam.sensors.gnss.fixes import GnssSettings
from vislam.sensors.kinds import kind_class
from vislam.sensors.sensor import Configured, Sensor, Variable
from vislam.sensors.simulated import Faults
from vislam.sensors.ticks import TicksSettings

MOST_SENSORS = 64
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
FileFormat = Literal["csv", "nmea", "ubx", "bag", "gpmf"]
BRIDGE = "bridge"  # in place of a port: the board that has the IMU
_FIX_DELAY_S = 0.05  # from a fix's time to a receiver's first byte, unless it is given
_FIX_COLUMNS = ("east_m", "north_m", "up_m")
_FORMATS: dict[str, FileFormat] = {  # all else is a table
    ".nmea": "nmea", ".ubx": "ubx", ".bag": "bag", ".mcap": "bag", ".db3": "bag",
    ".mp4": "gpmf", ".lrv": "gpmf", ".360": "gpmf",
}  # fmt: skip


class Suite:
    """Sensors by name, in the order in which they were given."""

    def __init__(self, sensors: Mapping[str, Sensor] | None = None) -> None:
        """Take the sensors; without any nothing changes anywhere."""
        self._sensors = dict(sensors or {})
        self._slices: dict[str, slice] = {}
        at = 0
        for name, sensor in self._sensors.items():
            self._slices[name] = slice(at, at + len(sensor.variables))
            at += len(sensor.variables)
        self.size = at  # of all own variables together
        variables = [variable for sensor in self._sensors.values() for variable in sensor.variables]
        self.starts: Array = np.array([variable.start for variable in variables], dtype=np.float64)  # [K]
        self.sigmas: Array = np.array([variable.sigma for variable in variables], dtype=np.float64)  # [K]

    def __len__(self) -> int:
        return len(self._sensors)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all sensors."""
        return tuple(self._sensors)

    def __getitem__(self, name: str) -> Sensor:
        return self._sensors[name]

    def own(self, name: str) -> slice:
        """Return where a sensor's own variables stand among all of them."""
        return self._slices[name]

    def after(self, name: str, dt_s: float) -> tuple[Array, Array]:
        """Return decays [V] and variances [V] of a sensor's own variables, as `Variable.after` has them."""
        decays, variances = np.array([variable.after(dt_s) for variable in self._sensors[name].variables]).T
        return decays, variances

    def drawn_own(self, name: str, rng: np.random.Generator) -> Array:
        """Return true own variables [V] of a simulated sensor, as its starts and sigmas have them."""
        at = self._slices[name]
        return self.starts[at] + self.sigmas[at] * rng.normal(size=at.stop - at.start)

    def why_unusable(self, reading: Reading) -> str:
        """Return why a reading cannot be used by anybody; empty: it can."""
        sensor = self._sensors.get(reading.sensor)
        if sensor is None:
            return f"no sensor is called {reading.sensor!r}; there is {', '.join(self.names) or 'none'}"
        if np.shape(reading.values) != (len(sensor.columns),):
            return f"{np.shape(reading.values)} values, {len(sensor.columns)} asked: {', '.join(sensor.columns)}"
        if not np.isfinite(reading.values).all():
            return "values that are not finite"
        covariance = reading.covariance
        if covariance is not None and not (np.isfinite(covariance).all() and (np.diag(covariance) > 0.0).all()):
            return "a covariance that is not finite and positive"
        return sensor.check(reading.values)


@dataclass(frozen=True, slots=True)
class JointsSettings:
    """Which joints of a robot's joint states are its wheels."""

    left: str
    right: str
    radius_m: Positive


@dataclass(frozen=True, slots=True)
class _Common:
    """The keys that every sensor's table may have beside its settings."""

    kind: str
    file: str = ""  # beside the TOML file; empty: readings come from elsewhere
    format: FileFormat | None = None  # None: by the file's ending; a bag where a topic is given
    topic: str = ""  # of a bag
    joints: JointsSettings | None = None  # of a bag's joint states
    simulated_hz: NonNegative = 0.0  # above 0, and without a file, readings are drawn on the truth of a recording
    simulated_slips: tuple[tuple[NonNegative, NonNegative], ...] = ()  # from and to, in seconds: the wheels spin
    offset_s: Finite = 0.0  # is added to the file's stamps, to have them by the IMU's clock
    port: str = ""  # live: where the device is plugged in; "bridge": at the board that has the IMU
    baud: Count | None = None  # of that port; None: 9600 of a satellite receiver, 115200 of another device
    delay_s: NonNegative | None = None  # from a reading's time to its first byte there; None: 0.05 of a receiver, or 0
    gate_probability: Probability = 0.999
    regain_m: NonNegative = 1000.0  # that refused readings which agree may move the filter by at most; 0: never
    correlated_sigma: float | tuple[float, ...] = ()  # of an error that neighbouring readings share; also one for all
    correlation_s: NonNegative = 0.0  # in which that forgets all but 1/e
    known: dict[str, tuple[Finite, Positive]] | None = None  # own variables that are known: value and sigma
    ticks: TicksSettings | None = None
    gnss: GnssSettings | None = None


@dataclass(frozen=True, slots=True)
class SensorFile:
    """Where a sensor's readings are, and how they are read."""

    path: Path
    format: FileFormat
    offset_s: float
    ticks: TicksSettings | None  # None: the file has speeds
    gnss: GnssSettings
    topic: str = ""  # of a bag
    joints: JointsSettings | None = None


@dataclass(frozen=True, slots=True)
class SensorPort:
    """Where a device is plugged in, and how it is read."""

    port: str
    baud: int
    format: FileFormat  # "csv": lines of numbers
    delay_s: float
    gnss: GnssSettings
    columns: tuple[str, ...] = ()  # of its kind
    ticks: TicksSettings | None = None  # its lines are counts

    @property
    def at_bridge(self) -> bool:
        """Whether it is plugged into the serial bridge, which passes on its bytes."""
        return self.port == BRIDGE


@dataclass(frozen=True, slots=True)
class SensorSetup:
    """The sensors of a machine, and the files and ports of those that have one."""

    suite: Suite
    sensors: Mapping[str, Configured]
    files: Mapping[str, SensorFile]
    simulated_hz: Mapping[str, float]  # of those whose readings are drawn
    simulated_faults: Mapping[str, Faults]  # of the same
    ports: Mapping[str, SensorPort]  # of those that are read live
    datums: Mapping[str, Geodetic]  # of those whose frame's place on the earth is given


def load_sensor_setup(path: Path) -> SensorSetup:
    """Return the sensors that a TOML file describes.

    Raises UsageError in one line: file, table, key, what was asked and what was found.
    """
    try:
        data = read_toml(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"sensors {path} cannot be read: {error}; see docs/more-sensors.md for an example") from error
    return sensor_setup(data, str(path), path.parent)


def sensor_setup(data: Mapping[str, Any], source: str, folder: Path) -> SensorSetup:
    """Return the sensors that plain data describe; `source` stands in errors, files are beside `folder`."""
    of_cart = {section.name for section in dataclasses.fields(SensorsConfig)}  # one file may describe all of a cart
    if other := sorted(set(data) - {"sensors"} - of_cart):
        raise UsageError(f"{source}: no table [{other[0]}]; tables [sensors.NAME] are asked")
    tables = data.get("sensors", {})
    if not isinstance(tables, dict) or not 1 <= len(tables) <= MOST_SENSORS:
        raise UsageError(f"{source}: 1 to {MOST_SENSORS} tables [sensors.NAME] are asked")
    sensors: dict[str, Configured] = {}
    files: dict[str, SensorFile] = {}
    simulated: dict[str, float] = {}
    faults: dict[str, Faults] = {}
    ports: dict[str, SensorPort] = {}
    datums: dict[str, Geodetic] = {}
    for name, table in tables.items():
        where = f"{source}: [sensors.{name}]"
        if not _NAME.fullmatch(name):
            raise UsageError(f"{where}: a name of letters, digits, - and _ is asked, a letter first, 32 at most")
        if not isinstance(table, dict):
            raise UsageError(f"{where}: a table is asked, got {table!r}")
        sensors[name], common = _sensor(table, where)
        if (file := _file(common, sensors[name], where, folder)) is not None:
            files[name] = file
        elif common.simulated_hz > 0.0:
            simulated[name], faults[name] = common.simulated_hz, _faults(common, sensors[name], where)
        sensors[name].from_magnetometer &= name not in files and name not in simulated
        if (port := _port(common, sensors[name], where)) is not None:
            ports[name] = _not_taken(port, ports, where)
        if (datum := _gnss(common, where).datum) is not None:
            datums[name] = Geodetic(*datum)
    return SensorSetup(Suite(sensors), sensors, files, simulated, faults, ports, datums)


def _sensor(table: dict[str, Any], where: str) -> tuple[Configured, _Common]:
    if not isinstance(table.get("kind"), str):
        raise UsageError(f'{where}: option kind: a name is asked, as kind = "position", got {table.get("kind")!r}')
    shared = {key.name for key in dataclasses.fields(_Common)}
    common = validated(_Common, {key: value for key, value in table.items() if key in shared}, where)
    own = {key: value for key, value in table.items() if key not in shared}
    try:
        cls = kind_class(common.kind)
    except UsageError as error:
        raise UsageError(f"{where}: option kind: {error}") from error
    known = [setting.name for setting in dataclasses.fields(cls.Settings)]
    if unknown := [key for key in own if key not in known]:
        raise UsageError(f"{where}: no option {unknown[0]!r}; there are: {', '.join([*sorted(shared), *known])}")
    settings = validated(cls.Settings, own, where)
    try:
        sensor = cls(settings)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error
    sensor.gate_probability = common.gate_probability
    sensor.regain_m = common.regain_m
    sensor.variables = _with_known(sensor.variables, common.known or {}, where)
    if common.correlated_sigma == () and not common.correlation_s:
        return sensor, common
    given = common.correlated_sigma
    try:
        return Correlated(sensor, given if isinstance(given, tuple) else (given,), common.correlation_s), common
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error


def _with_known(
    variables: tuple[Variable, ...], known: Mapping[str, tuple[float, float]], where: str
) -> tuple[Variable, ...]:
    names = [variable.name for variable in variables]
    if unknown := [name for name in known if name not in names]:
        there = f"there are: {', '.join(names)}" if names else "it has none"
        raise UsageError(f"{where}: option known: no own variable {unknown[0]!r} with these settings; {there}")
    stated = [known.get(variable.name, (variable.start, variable.sigma)) for variable in variables]
    return tuple(v._replace(start=start, sigma=sigma) for v, (start, sigma) in zip(variables, stated, strict=True))


def _file(common: _Common, sensor: Configured, where: str, folder: Path) -> SensorFile | None:
    if not common.file or "\0" in common.file:
        return None
    path = folder / common.file
    format_ = common.format or ("bag" if common.topic else _FORMATS.get(path.suffix.lower(), "csv"))
    if (format_ == "bag") != bool(common.topic):
        raise UsageError(f"{where}: option topic: one is asked of a bag and of nothing else; vislam doctor lists them")
    if (format_ == "bag" and common.ticks) or (format_ != "bag" and common.joints):
        raise UsageError(f"{where}: ticks are those of a table, joints those of a bag; this is {format_}")
    if format_ in ("nmea", "ubx") and sensor.columns != _FIX_COLUMNS:
        raise UsageError(f"{where}: option format: {format_} holds fixes, for a kind that has east, north, up")
    _check_ticks(common, sensor, where)
    return SensorFile(path, format_, common.offset_s, common.ticks, _gnss(common, where), common.topic, common.joints)


def _faults(common: _Common, sensor: Configured, where: str) -> Faults:
    if common.simulated_slips and not sensor.slips:
        raise UsageError(f"{where}: option simulated_slips: kind {common.kind} has no wheels that could slip")
    if any(begin >= end for begin, end in common.simulated_slips):
        raise UsageError(f"{where}: option simulated_slips: each begins before it ends, got {common.simulated_slips}")
    return Faults(slips=common.simulated_slips)


def _port(common: _Common, sensor: Configured, where: str) -> SensorPort | None:
    if not common.port:
        return None
    fixes = sensor.columns == _FIX_COLUMNS
    format_ = common.format or ("nmea" if fixes else "csv")
    if format_ != "csv" and not fixes:
        raise UsageError(f"{where}: option format: {format_} holds fixes, for a kind that has east, north, up")
    _check_ticks(common, sensor, where)
    if common.port == BRIDGE:
        if format_ == "csv" and common.ticks is None:
            raise UsageError(
                f"{where}: option port: the bridge counts encoders, for kind wheels with ticks, and passes a satellite "
                f"receiver on (format nmea or ubx); kind {common.kind} wants a port of its own"
            )
        if common.baud is not None:
            raise UsageError(f"{where}: option baud: at the bridge it is set in the sketch, as GNSS_BAUD")
    baud = common.baud or (115_200 if format_ == "csv" else 9600)
    stated_s = common.delay_s
    delay_s = stated_s if stated_s is not None else 0.0 if format_ == "csv" else _FIX_DELAY_S
    gnss = _gnss(common, where)
    return SensorPort(common.port, baud, format_, delay_s, gnss, sensor.columns, common.ticks)


def _not_taken(port: SensorPort, others: Mapping[str, SensorPort], where: str) -> SensorPort:
    """Return the port; two programs on one would each get half of the bytes, and so would two sensors."""
    for name, other in others.items():
        if other.port == port.port and not port.at_bridge:
            raise UsageError(f"{where}: option port: sensor {name} has {port.port}; each wants a port of its own")
    return port


def _check_ticks(common: _Common, sensor: Configured, where: str) -> None:
    if common.ticks and sensor.columns != ("left_m_s", "right_m_s"):
        raise UsageError(f"{where}: option ticks: counts are those of kind wheels, this is {common.kind}")


def _gnss(common: _Common, where: str) -> GnssSettings:
    gnss = common.gnss or GnssSettings()
    if gnss.datum and (why := why_nowhere(Geodetic(*gnss.datum))):
        raise UsageError(f"{where}: option gnss.datum: {why}")
    return gnss
