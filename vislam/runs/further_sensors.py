"""Further sensors of a run: their readings among the values of a recording, from files or drawn on its truth."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vislam.config import FurtherSensorsConfig
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.core.recording import Problems, Recording
from vislam.datasets.sensor_files import sensor_readings
from vislam.sensors import Suite
from vislam.sensors.simulated import drawn_readings
from vislam.sensors.toml import SensorSetup, load_sensor_setup

Value = ImuSample | MagSample | Frame
_EDGE_NS = 100_000_000  # of a truth, at which its rates are not known well


def suite_of(config: FurtherSensorsConfig) -> Suite | None:
    """Return the further sensors of a run; None without any. Raises UsageError as `load_sensor_setup`."""
    return None if config.file is None else load_sensor_setup(Path(config.file)).suite


def further_readings(recording: Recording, config: FurtherSensorsConfig, seed: int) -> FurtherReadings | None:
    """Return the readings of a run's further sensors; None without any.

    Raises UsageError for settings that cannot be, DataError when readings are to be drawn without a truth.
    """
    return None if config.file is None else FurtherReadings(recording, load_sensor_setup(Path(config.file)), seed)


class FurtherReadings:
    """Readings of further sensors beside a recording.

    Attributes:
        suite: what the sensors are.
        problems: what could not be read of their files, in this pass.
    """

    def __init__(self, recording: Recording, setup: SensorSetup, seed: int) -> None:
        """Prepare to read the files of a setup, and to draw what it has as simulated; see `drawn`.

        Raises UsageError for a sensor that has neither.
        """
        self.suite, self.problems = setup.suite, Problems()
        for name in setup.suite.names:
            if name not in setup.files and name not in setup.simulated_hz and not setup.suite[name].from_magnetometer:
                raise UsageError(
                    f"[sensors.{name}] has no readings here: give its file, or simulated_hz to draw them on the truth"
                )
        self._setup = setup
        self._drawn = drawn(recording, setup, seed)

    def among(self, values: Iterator[Value]) -> Iterator[Value | Reading]:
        """Yield values and readings by their stamps; each stream keeps its own order."""
        streams: list[Iterator[Value | Reading]] = [values, *self.streams()]
        return heapq.merge(*streams, key=lambda value: value.t_ns)

    def streams(self) -> list[Iterator[Reading]]:
        """Return the readings of each sensor, in its own order."""
        setup, problems = self._setup, self.problems
        files = [sensor_readings(name, setup.sensors[name], file, problems) for name, file in setup.files.items()]
        return [*files, *map(iter, self._drawn)]


def drawn(recording: Recording, setup: SensorSetup, seed: int) -> list[list[Reading]]:
    """Return the readings of simulated sensors on the truth of a recording.

    Own variables are drawn by their sigmas, but anchors stand about the path. Raises DataError without a truth.
    """
    if not setup.simulated_hz:
        return []
    from vislam.sensors import bodies_on  # it loads scipy's splines, which take 0.1 s

    truth = recording.truth()
    if truth is None:
        raise DataError(f"{recording.name} has no truth on which sensors can be drawn; give them files")
    out = []
    for number, (name, rate_hz) in enumerate(setup.simulated_hz.items()):
        begin_ns, end_ns = int(truth.t_ns[0]) + _EDGE_NS, int(truth.t_ns[-1]) - _EDGE_NS
        t_ns = np.arange(begin_ns, end_ns, round(1e9 / rate_hz), dtype=np.int64)
        own = setup.suite.drawn_own(name, np.random.default_rng([seed, number]))
        own = setup.sensors[name].about(truth.positions_m, own)
        faults = setup.simulated_faults[name]
        out.append(drawn_readings(name, setup.sensors[name], bodies_on(truth, t_ns), own, seed, faults))
    return out
