"""The gyro's bias at power-up, kept on the disk for the next one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import PowerUpConfig
from vislam.core.errors import StorageError
from vislam.imu import BiasMemory


class KeptBias:
    """Owns the file of remembered biases; in the parent of all processes, for no sensor waits for a disk.

    Attributes:
        memory: what earlier runs left.
        refusal: why the bias of this run is not kept; None: it is, or there was none yet.
    """

    def __init__(self, config: PowerUpConfig) -> None:
        """Read the file, where one is asked for; raises DataError when it is damaged."""
        self._path = None if config.memory is None else Path(config.memory)
        self.memory = BiasMemory(config.remembered)
        if self._path is not None:
            self.memory = BiasMemory.read(self._path, config.remembered)
        self.refusal: str | None = None
        self._is_kept = False

    def take(self, report: dict[str, Any]) -> None:
        """Keep the bias that power-up reports, once, if it found one."""
        temperature_c = report.get("temperature_c")
        if self._path is None or self._is_kept or temperature_c is None:
            return
        self._is_kept = True
        self.memory.add(temperature_c, np.array(report["gyro_bias_rad_s"]))
        try:
            self.memory.write(self._path)
        except StorageError as error:
            self.refusal = str(error)
