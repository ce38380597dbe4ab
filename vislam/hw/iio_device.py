"""One device of the kernel's Industrial I/O subsystem: channels, scales and the buffer behind /dev/iio:deviceX.

The interface is that of Documentation/ABI/testing/sysfs-bus-iio and driver-api/iio/buffers: files only, so neither a C
library nor libiio's daemon is needed, and a tree of files is all that a test needs.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import HardwareError
from vislam.core.messages import Array
from vislam.hw.descriptor import received

KINDS = ("anglvel", "accel")  # rad/s and m/s^2, by the ABI
_TYPE = re.compile(r"(be|le):([su])(\d+)/(\d+)(?:X(\d+))?>>(\d+)")
_AXES = "xyz"
_MOST_BYTES = {8, 16, 32, 64}  # of storage, in bits


@dataclass(frozen=True, slots=True)
class Element:
    """How one channel lies in a scan."""

    index: int
    bits: int
    storage: int  # bits
    shift: int
    is_signed: bool
    is_big: bool

    @staticmethod
    def parsed(index: str, kind: str) -> Element:
        """Return what two files of the kernel say; raises ValueError for what they cannot."""
        match = _TYPE.fullmatch(kind.strip())
        if match is None:
            raise ValueError(f"'{kind.strip()}' is no type of a channel")
        order, sign, bits, storage, repeat, shift = match.groups()
        element = Element(int(index), int(bits), int(storage), int(shift), sign == "s", order == "be")
        fits = 0 < element.bits <= element.storage and element.bits + element.shift <= element.storage
        if repeat not in (None, "1") or element.storage not in _MOST_BYTES or not fits:
            raise ValueError(f"channels of type '{kind.strip()}' are not known")
        return element

    def values(self, stored: NDArray[Any]) -> NDArray[np.int64]:
        """Return the numbers [N] in storage words [N]."""
        left = 64 - self.bits - self.shift
        moved = stored.astype(np.uint64) << np.uint64(left)
        down = left + self.shift
        return moved.view(np.int64) >> down if self.is_signed else (moved >> np.uint64(down)).astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Scans:
    """What a buffer gave, oldest first; empty where it gave nothing."""

    t_ns: NDArray[np.int64]  # [N], by the clock that `IioDevice.clock` names
    values: dict[str, Array]  # kind -> [N, 3] in its unit


class IioDevice:
    """A device that is set up and gives scans of the kinds it has; owns its file, and switches it off when closed.

    Attributes:
        name: of the chip, by the kernel's driver.
        kinds: `anglvel`, `accel` or both.
        rate_hz: that was set, or that there is; None: the driver does not have it.
        clock: of its stamps, `monotonic` or `realtime`.
    """

    def __init__(self, folder: Path, node: Path, rate_hz: float, length: int) -> None:
        """Set channels, clock, rate and buffer, and start it.

        Raises HardwareError: it has no buffer, may not be written, or does not start.
        """
        self._folder = folder
        self.name = _text(folder / "name") or folder.name
        self.kinds = kinds_of(folder)
        scan = _scan_folder(folder)
        self._fd = -1
        self._left = b""
        try:
            self._write("buffer/enable", "0")
            self._layout = self._enabled(scan)
            self.clock = self._clock_set()
            self.rate_hz = self._rate_set(rate_hz)
            self._scales = {kind: self._scale(kind) for kind in self.kinds}
            self._write("buffer/length", str(length))
            self._write("buffer/enable", "1")
            self._fd = os.open(node, os.O_RDONLY | os.O_NONBLOCK)
        except (OSError, ValueError) as error:
            self.close()
            raise HardwareError(
                f"{node} ({self.name}): {error}; give yourself the right to write below {folder} and to read {node} "
                "(a udev rule, docs/sensors.md), set its trigger if it has none, see that no other program uses it"
            ) from error

    def read(self, timeout_s: float) -> Scans:
        """Return the scans that are there, waiting for the first; raises OSError where the device went away."""
        data = self._left + received(self._fd, timeout_s)
        whole = len(data) // self._layout.itemsize * self._layout.itemsize
        self._left = data[whole:]
        return self._scans(np.frombuffer(data[:whole], dtype=self._layout))

    def close(self) -> None:
        """Stop the buffer; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        try:
            self._write("buffer/enable", "0")
        except OSError:
            self._left = b""  # it went away: there is nothing to stop

    def _enabled(self, scan: Path) -> np.dtype[Any]:
        """Switch the axes and the stamp on, all else off; return how a scan lies in the buffer."""
        wanted = [f"in_{kind}_{axis}" for kind in self.kinds for axis in _AXES] + ["in_timestamp"]
        for switch in sorted(scan.glob("*_en")):
            is_wanted = switch.name.removesuffix("_en") in wanted
            switch.write_text("1" if is_wanted else "0", encoding="ascii")
        self._elements = {
            name: Element.parsed(_needed(scan / f"{name}_index"), _needed(scan / f"{name}_type")) for name in wanted
        }
        names, formats, offsets, place = [], [], [], 0
        for name, element in sorted(self._elements.items(), key=lambda item: item[1].index):
            size = element.storage // 8
            place = -(-place // size) * size  # each lies at a multiple of its own size
            names.append(name)
            formats.append(f"{'>' if element.is_big else '<'}u{size}")
            offsets.append(place)
            place += size
        widest = max(element.storage // 8 for element in self._elements.values())
        size = -(-place // widest) * widest
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})

    def _scans(self, rows: NDArray[Any]) -> Scans:
        values = {}
        for kind in self.kinds:
            raw = [self._elements[f"in_{kind}_{axis}"].values(rows[f"in_{kind}_{axis}"]) for axis in _AXES]
            scale, offset = self._scales[kind]
            values[kind] = (np.stack(raw, axis=1).astype(np.float64) + offset) * scale
        return Scans(self._elements["in_timestamp"].values(rows["in_timestamp"]), values)

    def _clock_set(self) -> str:
        """Ask for stamps of CLOCK_MONOTONIC; return which clock it is."""
        file = self._folder / "current_timestamp_clock"
        if not file.exists():
            return "realtime"  # kernels before 4.8
        file.write_text("monotonic", encoding="ascii")
        found = _needed(file).strip()
        if found not in ("monotonic", "realtime"):
            raise ValueError(f"its stamps are of the clock '{found}'")
        return found

    def _rate_set(self, asked_hz: float) -> float | None:
        for file in (
            self._folder / "sampling_frequency",
            *(self._folder / f"in_{k}_sampling_frequency" for k in KINDS),
        ):
            if not file.exists():
                continue
            offered = _text(self._folder / f"{file.name}_available")
            rates = sorted(float(word) for word in offered.split() if _is_number(word)) if "[" not in offered else []
            chosen = next((rate for rate in rates if rate >= asked_hz), rates[-1] if rates else asked_hz)
            file.write_text(f"{chosen:g}", encoding="ascii")
            return float(_needed(file))
        return None

    def _scale(self, kind: str) -> tuple[Array, Array]:
        """Return scale and offset [3] of a kind; each axis may have its own."""
        scales, offsets = [], []
        for axis in _AXES:
            stems = [f"in_{kind}_{axis}", f"in_{kind}"]
            found = [_text(self._folder / f"{stem}_scale") for stem in stems]
            scales.append(float(next((text for text in found if text), "nan")))
            found = [_text(self._folder / f"{stem}_offset") for stem in stems]
            offsets.append(float(next((text for text in found if text), "0")))
        if not np.isfinite(scales).all() or not np.isfinite(offsets).all() or 0.0 in scales:
            raise ValueError(f"it has no scale of {kind}")
        return np.array(scales), np.array(offsets)

    def _write(self, name: str, value: str) -> None:
        (self._folder / name).write_text(value, encoding="ascii")


def kinds_of(folder: Path) -> tuple[str, ...]:
    """Return which of `anglvel` and `accel` a device can stream, with three axes and a stamp."""
    scan = _scan_folder(folder)
    if not (scan / "in_timestamp_en").exists():
        return ()
    return tuple(kind for kind in KINDS if all((scan / f"in_{kind}_{axis}_en").exists() for axis in _AXES))


def _scan_folder(folder: Path) -> Path:
    return next((folder / name for name in ("scan_elements", "buffer0") if (folder / name).is_dir()), folder)


def _needed(file: Path) -> str:
    return file.read_text(encoding="ascii", errors="replace")


def _text(file: Path) -> str:
    """Return what a file holds; empty where there is none."""
    try:
        return _needed(file).strip()
    except OSError:
        return ""


def _is_number(word: str) -> bool:
    try:
        return np.isfinite(float(word))
    except ValueError:
        return False
