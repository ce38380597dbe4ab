"""Inertial samples and GNSS fixes in the GPMF track of a GoPro's video, by the video's own clock.

GPMF has no stamp per sample. Newer cameras state when the first sample of each payload was taken (STMP, microseconds):
the others lie evenly up to the next payload. For older ones a line is fitted to how many samples there were by the end
of each payload of the MP4, as gpmf-parser does, for payloads are cut by a clock of their own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.messages import Array
from vislam.core.reading import opened
from vislam.core.recording import Problems
from vislam.datasets.imu_pairs import Rows, paired
from vislam.datasets.tables import in_time_order
from vislam.datasets.telemetry.klv import Stream, read_streams
from vislam.datasets.telemetry.mp4 import Track, is_mp4, read_tracks
from vislam.sensors.geodetic import Geodetic
from vislam.sensors.gnss import Fix

_MOST_PAYLOAD_BYTES = 2**24  # a second of the fastest camera has 80 kB
_KEYS = ("ACCL", "GYRO", "GPS5", "GPS9", "SHUT")
_UNITS = {
    "ACCL": {"m/s": 1.0, "g": 9.80665},  # SIUN begins so: the exponent is written in several ways
    "GYRO": {"rad/s": 1.0, "deg/s": math.pi / 180.0, "\u00b0/s": math.pi / 180.0},
}
_USUAL_UNIT = {"ACCL": "m/s^2", "GYRO": "rad/s"}
# of cameras that do not state it (ORIN): gpmf-parser's tables; the first camera's is what all others are turned into
_AXES_BY_DEVICE = {"fusion": "yXZ"}  # whose streams are named as those of HERO5, which has another order
_USUAL_AXES = "ZXY"
_USUAL_NAMES = ("(up/down, right/left, forward/back)", "(z,x,y)")  # in the name of a stream
_LETTERS = "XYZ"
_FARTHEST_S = 1e9  # from the film's beginning: thirty years
_CLOCKS_AGREE = 0.1  # stamps that count otherwise than the MP4 by more are in another unit, or damaged


@dataclass(slots=True)
class _Counted:
    """What one pass over the payloads found of one key."""

    payloads: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    totals: list[int | None] = field(default_factory=list)  # TSMP
    stamps: list[int | None] = field(default_factory=list)  # STMP
    example: Stream | None = None


@dataclass(frozen=True, slots=True)
class _Times:
    """When the samples of each payload were taken."""

    begin_s: dict[int, float]  # of a payload's first sample
    period_s: dict[int, float]  # from sample to sample


def open_telemetry(path: Path) -> Telemetry | None:
    """Return the telemetry in a video, None where it has none; raises DataError when the file cannot be read."""
    if not is_mp4(path):
        return None
    tracks = read_tracks(path)
    track = next((track for track in tracks if track.format == "gpmd" and len(track.sizes)), None)
    if track is None:
        return None
    video = next((track for track in tracks if track.handler == "vide" and len(track.shown)), None)
    begins_s = 0.0 if video is None else int(video.shown.min()) / video.timescale + video.shift_s
    return Telemetry(path, track, begins_s)


class Telemetry:
    """Reads the payloads of a GPMF track, as often as asked, one at a time."""

    def __init__(self, path: Path, track: Track, first_frame_s: float) -> None:
        """Count what there is; raises DataError when the file cannot be read."""
        self.path = path
        self._track = track
        self._first_frame_s = first_frame_s
        self._damaged = 0
        self._counted = {key: _Counted() for key in _KEYS}
        self._device = ""
        self._in_space = {"GPS5": 0, "GPS9": 0}
        self._base_us: int | None = None
        for index, streams in self._payloads():
            self._count(index, streams)
        self._times: dict[str, _Times] = {}
        for key, counted in self._counted.items():
            if counted.payloads:
                self._times[key] = self._timed(counted)

    @property
    def has_imu(self) -> bool:
        """Whether there are rates and forces."""
        return all(sum(self._counted[key].counts) > 1 for key in ("GYRO", "ACCL"))

    @property
    def fix_count(self) -> int:
        """How many samples of GNSS there are, with a fix or not."""
        return sum(self._counted[self._fix_key].counts)

    def imu_rows(self, problems: Problems) -> Rows:
        """Yield stamp (ns since the film began), rates (rad/s) and forces (m/s^2) in GoPro's axes X, Y, Z.

        Raises DataError for units or samples that are not those of an IMU.
        """
        self.count_damage(problems)
        rates, forces = (in_time_order(self.rows(key, problems), problems, key) for key in ("GYRO", "ACCL"))
        yield from paired(rates, forces, problems, self.path.name)

    def count_damage(self, problems: Problems) -> None:
        """Count the payloads that were damaged."""
        problems.count(f"{self.path.name}: damaged payloads of telemetry", times=self._damaged)

    def rows(self, key: str, problems: Problems) -> Rows:
        """Yield stamp and samples of GYRO (rad/s) or ACCL (m/s^2), as they were stored; raises as `imu_rows`."""
        example = self._counted[key].example
        assert example is not None
        turned = _axes(example)[0] * self._unit(key, example)
        good = False
        for index, streams in self._payloads():
            stream = _of_key(streams, key)
            if stream is None or index not in self._times[key].begin_s:
                continue
            try:
                samples = stream.samples(key)
                if samples.shape[1] != 3 or not np.isfinite(samples).all():
                    raise ValueError(f"{key} of {samples.shape[1]} numbers a sample, or not finite")
            except ValueError as error:
                problems.count(f"{self.path.name}: payloads that cannot be read", str(error))
                continue
            good = True
            yield from zip(self._stamps(key, index, len(samples)), (samples @ turned.T).tolist(), strict=True)
        if not good:
            raise DataError(f"{self.path}: no payload of its telemetry has {key} that can be read")

    def fixes(self, problems: Problems) -> Iterator[Fix]:
        """Yield the GNSS fixes, stamped like the samples of the IMU; those without a place in space have no kind."""
        key = self._fix_key
        self.count_damage(problems)
        for index, streams in self._payloads():
            stream = _of_key(streams, key)
            if stream is None or index not in self._times[key].begin_s:
                continue
            try:
                samples = stream.samples(key)
            except ValueError as error:
                problems.count(f"{self.path.name}: payloads that cannot be read", str(error))
                continue
            for t_ns, sample in zip(self._stamps(key, index, len(samples)), samples, strict=True):
                yield _fix(t_ns, sample, stream)

    def findings(self) -> list[Finding]:
        """Return what doctor reports."""
        where = self.path.name
        findings = []
        if self.has_imu:
            rates = ", ".join(f"{name} {self._rate_hz(key):.0f} Hz" for name, key in _NAMES)
            by = "stamped by the camera (STMP)" if self._is_stamped("GYRO") else "stamped by the count of samples"
            findings.append(Finding("ok", f"telemetry of {self._device or 'a camera'}: {rates}, {by}", where))
            findings += self._doubts()
        else:
            findings.append(Finding("warning", "telemetry without gyroscope and accelerometer", where, "vision alone"))
        if self.fix_count:
            text = f"telemetry: {self.fix_count} GNSS samples, {self._in_space[self._fix_key]} with a fix in space"
            findings.append(Finding("ok", f"{text}; to use them name {where} in a sensors file", where))
        if self._damaged:
            what = f"{self._damaged} payloads of telemetry are damaged"
            findings.append(Finding("warning", what, where, "their samples are left out; copy the file again"))
        return findings

    @property
    def _fix_key(self) -> str:
        """The better one, where a camera writes both."""
        return "GPS9" if self._counted["GPS9"].payloads else "GPS5"

    def _payloads(self) -> Iterator[tuple[int, list[Stream]]]:
        """Yield index and streams of each payload."""
        self._damaged = 0
        with opened(self.path) as file:
            end = os.fstat(file.fileno()).st_size
            for index, (at, size) in enumerate(
                zip(self._track.offsets.tolist(), self._track.sizes.tolist(), strict=True)
            ):
                if size > _MOST_PAYLOAD_BYTES or at + size > end:
                    self._damaged += 1
                    continue
                file.seek(at)
                streams, whole = read_streams(file.read(size))
                self._damaged += not whole
                yield index, streams

    def _count(self, index: int, streams: list[Stream]) -> None:
        for key in _KEYS:
            stream = _of_key(streams, key)
            if stream is None or not stream.count(key):
                continue
            counted = self._counted[key]
            counted.payloads.append(index)
            counted.counts.append(stream.count(key))
            counted.totals.append(stream.number("TSMP"))
            counted.stamps.append(stream.number("STMP"))
            counted.example = counted.example or stream
            self._device = self._device or stream.device
            if key in self._in_space:
                with suppress(ValueError):
                    samples = stream.samples(key)
                    self._in_space[key] += sum(_fix(0, sample, stream).kind != "none" for sample in samples)
        if self._base_us is None:
            shutter = self._counted["SHUT"].stamps[:1] if self._counted["SHUT"].payloads[:1] == [index] else []
            stamps = [stamp for stream in streams if (stamp := stream.number("STMP")) is not None]
            self._base_us = shutter[0] if shutter and shutter[0] is not None else min(stamps, default=None)

    def _timed(self, counted: _Counted) -> _Times:
        counts, payloads = np.array(counted.counts), np.array(counted.payloads)
        ends_s = self._track.decoded[payloads + 1] / self._track.timescale + self._track.shift_s
        begins_s = self._track.decoded[payloads] / self._track.timescale + self._track.shift_s
        by_count = _by_count(counted, counts, begins_s, ends_s)
        begin_s, period_s = self._by_stamps(counted, counts, by_count[1]) or by_count
        known = zip(payloads.tolist(), begin_s.tolist(), period_s.tolist(), counts.tolist(), strict=True)
        timed = [(i, begin, step) for i, begin, step, n in known if step > 0.0 and abs(begin) + n * step < _FARTHEST_S]
        return _Times({i: begin for i, begin, _ in timed}, {i: period for i, _, period in timed})

    def _by_stamps(self, counted: _Counted, counts: NDArray[np.int64], usual_s: Array) -> tuple[Array, Array] | None:
        """Return begin and period of each payload by the camera's own stamps; None where they cannot be used."""
        known = [stamp for stamp in counted.stamps if stamp is not None]
        if len(known) != len(counts) or self._base_us is None:
            return None
        begin_s = np.array([stamp - self._base_us for stamp in known], dtype=np.float64) * 1e-6 + self._first_frame_s
        if len(counts) == 1:
            return begin_s, usual_s
        follows = np.diff(np.array(counted.payloads)) == 1
        period_s = np.append(np.diff(begin_s) / counts[:-1], np.nan)
        sound = np.append(follows & (np.abs(period_s[:-1] / usual_s[:-1] - 1.0) < 5 * _CLOCKS_AGREE), False)
        if not sound.any() or abs(np.median(period_s[sound]) / np.median(usual_s) - 1.0) > _CLOCKS_AGREE:
            return None
        period_s[~sound] = np.median(period_s[sound])
        return begin_s, period_s

    def _is_stamped(self, key: str) -> bool:
        counted, times = self._counted[key], self._times[key]
        first, stamp = counted.payloads[0], counted.stamps[0]
        if stamp is None or self._base_us is None or first not in times.begin_s:
            return False
        return abs(times.begin_s[first] - (stamp - self._base_us) * 1e-6 - self._first_frame_s) < 1e-9

    def _rate_hz(self, key: str) -> float:
        periods = list(self._times[key].period_s.values())
        return 1.0 / float(np.median(periods)) if periods else math.nan

    def _stamps(self, key: str, index: int, count: int) -> list[int]:
        times = self._times[key]
        at_s = times.begin_s[index] + times.period_s[index] * np.arange(count)
        stamps: list[int] = np.rint(at_s * 1e9).astype(np.int64).tolist()
        return stamps

    def _unit(self, key: str, stream: Stream) -> float:
        given = stream.text("SIUN") or stream.text("UNIT") or _USUAL_UNIT[key]
        for unit, factor in _UNITS[key].items():
            if given.startswith(unit):
                return factor
        raise DataError(f"{self.path}: {key} of its telemetry is in '{given[:20]}', {' or '.join(_UNITS[key])} is read")

    def _doubts(self) -> list[Finding]:
        doubts = []
        for name, key in _NAMES:
            example = self._counted[key].example
            assert example is not None
            if doubt := _axes(example)[1]:
                doubts.append(
                    Finding("warning", f"{name}: {doubt}", self.path.name, "compare the turns that doctor reports")
                )
            if not (example.text("SIUN") or example.text("UNIT")):
                doubts.append(
                    Finding("warning", f"{name}: no unit is stated, {_USUAL_UNIT[key]} taken", self.path.name, "")
                )
        return doubts


_NAMES = (("gyroscope", "GYRO"), ("accelerometer", "ACCL"))


def _of_key(streams: list[Stream], key: str) -> Stream | None:
    """Return the first stream with a key: the camera comes before what is connected to it."""
    return next((stream for stream in streams if key in stream.values), None)


def _by_count(counted: _Counted, counts: NDArray[np.int64], begins_s: Array, ends_s: Array) -> tuple[Array, Array]:
    """Return begin and period of each payload by a line through how many samples there were at each end."""
    summed = np.cumsum(counts)
    stated = [total for total in counted.totals if total is not None]
    totals = summed
    if len(stated) == len(counts):
        since_first = np.array(stated, dtype=object) - stated[0] + int(counts[0])  # of any size in a damaged file
        if all(0 < int(t) < 2**40 for t in since_first):
            as_stated = since_first.astype(np.int64)
            totals = as_stated if (np.diff(as_stated) >= counts[1:]).all() else summed
    if len(counts) == 1:
        return begins_s, (ends_s - begins_s) / counts
    mean_n, mean_s = totals.mean(), ends_s.mean()
    spread = totals - mean_n
    period_s = float(spread @ (ends_s - mean_s) / (spread @ spread))
    begin_s = mean_s + period_s * (totals - counts - mean_n)
    return begin_s, np.full(len(counts), period_s)


def _axes(stream: Stream) -> tuple[Array, str]:
    """Return what turns stored values into X, Y, Z [3, 3], and what is doubtful about it, empty where nothing is."""
    order = stream.text("ORIN")
    if _is_order(order):
        return _placed(order), ""
    matrix, out = stream.values.get("MTRX"), stream.text("ORIO") or _USUAL_AXES
    if matrix is not None and _is_order(out):
        with suppress(ValueError):
            values = Stream("", {"MTRX": matrix}).samples("MTRX").ravel()
            if len(values) == 9:
                M = values.reshape(3, 3)
                if np.allclose(M @ M.T, np.eye(3), atol=1e-3):
                    return _placed(out) @ M, ""
    device = stream.device.lower().replace(" ", "")
    known = next((order for name, order in _AXES_BY_DEVICE.items() if name in device), None)
    if known is not None:
        return _placed(known), ""
    if any(name in stream.text("STNM") for name in _USUAL_NAMES):
        return _placed(_USUAL_AXES), ""
    return _placed(_USUAL_AXES), f"the order of its axes is not stated (ORIN), HERO5's {_USUAL_AXES} taken"


def _is_order(text: str) -> bool:
    return sorted(text.upper()) == list(_LETTERS)


def _placed(order: str) -> Array:
    """Return the matrix [3, 3] from values in an order such as "YxZ", a small letter negated, to X, Y, Z."""
    M = np.zeros((3, 3))
    for column, letter in enumerate(order):
        M[_LETTERS.index(letter.upper()), column] = 1.0 if letter.isupper() else -1.0
    return M


def _fix(t_ns: int, sample: Array, stream: Stream) -> Fix:
    """Return a sample of GPS5 or GPS9 as a fix; one that is not in space has no place."""
    fix_type = stream.number("GPSF") if len(sample) < 9 else _whole(sample[8])
    precision = stream.number("GPSP")
    dop = math.nan if precision is None else precision / 100.0
    if len(sample) >= 9:
        dop = float(sample[7])
    in_space = fix_type == 3 and len(sample) >= 3 and bool(np.isfinite(sample[:3]).all())
    place = Geodetic(*sample[:3].tolist()) if in_space else Geodetic(0.0, 0.0, 0.0)
    return Fix(t_ns, place, "single" if in_space else "none", hdop=dop)


def _whole(number: float) -> int | None:
    return int(number) if math.isfinite(number) else None
