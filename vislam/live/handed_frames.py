"""Frames of a device that another process owns, through shared memory: the newest one, and how the camera is."""

import json
import struct
import time
from dataclasses import replace

import numpy as np

from vislam.core.messages import Frame
from vislam.hw.cameras.factory import grey
from vislam.hw.health import Health
from vislam.live.wire.slot import SlotReader, SlotWriter, wait_for

_NS = 1_000_000_000
_HEAD = struct.Struct("<qqiiBBBI")  # stamp, index, height, width, grey images, colour, depth, bytes of the counters
_COUNTERS_BYTES = 4096
_POLL_S = 0.001


class FrameHander:
    """The writing end: owns the shared memory. One thread only."""

    def __init__(self, name: str, width: int, height: int, with_depth: bool) -> None:
        """Make the memory. Raises StorageError when it cannot be made."""
        per_pixel = 7 if with_depth else 2  # colour and depth, or a grey pair
        self._capacity = _HEAD.size + _COUNTERS_BYTES + width * height * per_pixel
        self._slot = SlotWriter(name, self._capacity)
        self._wrong_size = 0

    def hand(self, frame: Frame, counters: dict[str, int]) -> None:
        """Replace the frame; one of another size than was asked for is counted and left out."""
        height, width = frame.images[0].shape
        images = frame.images if frame.color is None else (frame.color,)  # grey is made of colour again
        arrays = [*images, *(() if frame.depth_m is None else (frame.depth_m,))]
        greys = len(frame.images) if frame.color is None else 0
        words = self._words(counters)
        shape = height, width, greys, frame.color is not None, frame.depth_m is not None, len(words)
        head = _HEAD.pack(frame.t_ns, frame.index, *shape)
        data = head + words + b"".join(array.tobytes() for array in arrays)
        if len(data) > self._capacity:
            self._wrong_size += 1
            self.report(counters)
        else:
            self._slot.write(data)

    def report(self, counters: dict[str, int]) -> None:
        """Replace the counters, while no frame comes."""
        words = self._words(counters)
        self._slot.write(_HEAD.pack(0, 0, 0, 0, 0, 0, 0, len(words)) + words)

    def close(self) -> None:
        """Remove the memory."""
        self._slot.close()

    def _words(self, counters: dict[str, int]) -> bytes:
        return json.dumps({**counters, "wrong_size": self._wrong_size}).encode()


class HandedFrames:
    """Satisfies `FrameSource` with what a `FrameHander` of another process writes."""

    def __init__(self, name: str, missing_s: float) -> None:
        """Wait for the memory. Raises DataError when it does not appear.

        Args:
            name: of the memory.
            missing_s: without a frame for so long, the camera is missing.
        """
        self._slot: SlotReader = wait_for(name)
        self._missing_ns = round(missing_s * _NS)
        self._sequence = 0
        self._index: int | None = None
        self._newest_ns = time.monotonic_ns()
        self._told: dict[str, int] = {}
        self._taken = self._replaced = 0

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame, see `FrameSource`."""
        deadline = time.monotonic() + timeout_s
        while True:
            if self._slot.sequence != self._sequence and (read := self._slot.read()) is not None:
                self._sequence = read[0]
                if (frame := self._unpacked(bytearray(read[1]))) is not None:
                    return frame
            if time.monotonic() >= deadline:
                return None
            time.sleep(_POLL_S)

    def health(self) -> Health:
        """Return CAMERA_MISSING or nothing."""
        missing = time.monotonic_ns() - self._newest_ns > self._missing_ns
        return Health.CAMERA_MISSING if missing else Health(0)

    def counters(self) -> dict[str, int]:
        """Return those that the device's process reported last, and frames replaced before they were read."""
        return {"captured": 0, **self._told, "replaced": self._replaced, "taken": self._taken}

    def close(self) -> None:
        """Let go of the memory; may be called twice."""
        self._slot.close()

    def _unpacked(self, data: bytearray) -> Frame | None:
        """Return the frame of memory that may be written to, as all cameras give; None for counters alone."""
        t_ns, index, height, width, greys, has_color, has_depth, words = _HEAD.unpack_from(data)
        at = _HEAD.size + words
        self._told = json.loads(bytes(data[_HEAD.size : at]))
        if not height:
            return None
        self._newest_ns = time.monotonic_ns()
        self._taken += 1
        self._replaced += 0 if self._index is None else index - self._index - 1
        self._index = index
        pixels = height * width
        images = [np.frombuffer(data, np.uint8, pixels, at + k * pixels).reshape(height, width) for k in range(greys)]
        at += greys * pixels
        frame = Frame(t_ns, index, tuple(images))
        if has_color:
            color = np.frombuffer(data, np.uint8, 3 * pixels, at).reshape(height, width, 3)
            frame, at = replace(frame, images=(grey(color),), color=color), at + 3 * pixels
        if has_depth:
            depth = np.frombuffer(data, np.float32, pixels, at).reshape(height, width)
            frame = replace(frame, depth_m=depth)
        return frame
