"""Further sensors at their ports, recorded beside IMU and camera: a table for each, and a file that describes them.

`vislam run FOLDER --sensors.file FOLDER/sensors.toml` reads them again.
"""

import json
import socket
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.errors import UsageError
from vislam.core.files import write_text
from vislam.core.reading import read_toml
from vislam.datasets.recorder import Recorder
from vislam.hw.port_readings import PortReadings
from vislam.hw.serial_port import check_port
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.toml import SensorSetup, load_sensor_setup

FILE_NAME = "sensors.toml"
# keys of how a device is read; a table of readings is read otherwise
_OF_PORTS = (
    "port", "baud", "delay_s", "format", "ticks", "file", "offset_s", "topic", "joints", "simulated_hz",
    "simulated_slips",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FurtherPorts:
    """Sensors that are to be recorded."""

    setup: SensorSetup
    tables: Mapping[str, Mapping[str, Any]]  # of each sensor, as the file has them


def further_ports(path: Path) -> FurtherPorts:
    """Return the sensors `[sensors.NAME]` of a cart's file.

    Raises UsageError for a file that cannot be used, and for a sensor that has nothing to be recorded from.
    """
    setup = load_sensor_setup(path)
    missing = [n for n in setup.suite.names if n not in setup.ports and not setup.suite[n].from_magnetometer]
    if missing:
        raise UsageError(
            f"{path}: [sensors.{missing[0]}]: it needs a port to be recorded from; docs/more-sensors.md, Live"
        )
    tables = read_toml(path)["sensors"]
    return FurtherPorts(setup, tables)


class ReadingRecorder:
    """Owns the readers of further sensors while a recording goes on; one thread only, which never waits here."""

    def __init__(self, asked: FurtherPorts, imu: str) -> None:
        """Look for the ports; they are opened by `begin`.

        Raises UsageError for a sensor at the bridge where the IMU is no bridge, HardwareError for a port that is not
        there.
        """
        ports = asked.setup.ports
        at_bridge = [name for name, port in ports.items() if port.at_bridge]
        if at_bridge and imu.partition(":")[0] != "serial":
            raise UsageError(
                f'[sensors.{at_bridge[0]}]: port = "bridge" is the serial bridge, and --imu {imu} is none; take --imu '
                "serial:PORT, or give the sensor a port of its own"
            )
        for port in ports.values():
            if not port.at_bridge:
                check_port(port.port, port.baud)
        self._asked = asked
        self._wire = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) if at_bridge else None
        self._reader: PortReadings | None = None
        self._recorder: Recorder | None = None
        self._folder = Path()
        self._datums: dict[str, Geodetic] = {}
        self._written: Counter[str] = Counter()

    @property
    def bridge_end(self) -> socket.socket | None:
        """What the serial bridge passes on to; None: nothing is at the bridge."""
        return None if self._wire is None else self._wire[0]

    def begin(self, recorder: Recorder, folder: Path) -> None:
        """Open the ports, and write what the sensors are; raises StorageError."""
        self._recorder, self._folder = recorder, folder
        self._reader = PortReadings(self._asked.setup.ports, None if self._wire is None else self._wire[1])
        for name in self._asked.setup.ports:
            recorder.begin_readings(name, self._header(name))
        self._describe()

    def take(self) -> None:
        """Write the readings that came since the last call; raises StorageError."""
        if self._reader is None or self._recorder is None:
            return
        for reading in self._reader.read():
            values = reading.values
            if reading.covariance is not None:
                values = np.concatenate([values, np.sqrt(np.diag(reading.covariance))])
            self._recorder.write_reading(reading.sensor, reading.t_ns, values)
            self._written[reading.sensor] += 1
        if (datums := self._reader.datums()) != self._datums:
            self._datums = dict(datums)
            self._describe()

    def counters(self) -> dict[str, dict[str, int]]:
        """Return what came of each sensor, and its faults."""
        return {} if self._reader is None else self._reader.counters()

    def notes(self) -> tuple[str, ...]:
        """Return what a user should know: how to use the readings, and which sensor gave none, and why."""
        if self._reader is None:
            return ()
        status = self._reader.status()
        silent = [f"[sensors.{name}] gave no reading: {status[name]}" for name in status if not self._written[name]]
        use = f"further sensors: vislam run {self._folder} --sensors.file {self._folder / FILE_NAME}"
        return (use, *silent)

    def close(self) -> None:
        """Close the ports; may be called twice."""
        if self._reader is not None:
            self._reader.close()
        for end in self._wire or ():
            end.close()

    def _header(self, name: str) -> str:
        port, sensor = self._asked.setup.ports[name], self._asked.setup.sensors[name]
        sigmas = () if port.format == "csv" else sensor.sigma_columns  # receivers state how sure each fix is
        return ",".join(("t_ns", *sensor.columns, *sigmas))

    def _describe(self) -> None:
        """Write the sensors' tables with files in the place of their ports."""
        lines = ["# Written by vislam record; readings are by the clock of the IMU, delays taken off."]
        for name, given in self._asked.tables.items():
            table = dict(given)
            lines.append(f"\n[sensors.{name}]")
            if name in self._asked.setup.ports:
                if "ticks" in table:
                    lines.append(f"# speeds, of counts by ticks = {_toml(table['ticks'])}")
                table = {key: value for key, value in table.items() if key not in _OF_PORTS} | {"file": f"{name}.csv"}
                if (datum := self._datums.get(name)) is not None:
                    place = [datum.latitude_deg, datum.longitude_deg, datum.height_m]
                    table["gnss"] = {**table.get("gnss", {}), "datum": place}
            lines += [f"{key} = {_toml(value)}" for key, value in table.items()]
        write_text(self._folder / FILE_NAME, "\n".join(lines) + "\n")


def _toml(value: Any) -> str:
    """Return a value as it stands in a TOML file, tables in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str | bool):
        return json.dumps(value)
    return repr(value)


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)
