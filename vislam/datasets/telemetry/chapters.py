"""The chapters that a GoPro cuts a long recording into: GX010001.MP4, GX020001.MP4, ... as one film."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.recording import Problems
from vislam.datasets.imu_pairs import Rows, paired
from vislam.datasets.tables import in_time_order
from vislam.datasets.telemetry.gpmf_track import Telemetry, open_telemetry
from vislam.datasets.telemetry.mp4 import Integers, frame_times_ns
from vislam.sensors.gnss import Fix

_NAME = re.compile(r"(G[A-Z])(\d{2})(\d{4})", re.ASCII)  # GX, GH, GL: codec or mode; chapter; number of the recording
_OLD_FIRST, _OLD_LATER = re.compile(r"GOPR(\d{4})", re.ASCII), "GP"  # GOPR0001, GP010001, GP020001, ...
_MOST_CHAPTERS = 100  # two digits


@dataclass(frozen=True, slots=True, eq=False)
class Chapter:
    """One file of a film."""

    path: Path
    begins_ns: int  # on the film's clock, which is the first chapter's
    first_frame: int  # the number of its first frame in the film
    frames_ns: Integers  # [N] on the film's clock, in order


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """The chapters of a recording, and what is to be reported of them."""

    chapters: tuple[Chapter, ...]
    findings: tuple[Finding, ...] = ()


def later_chapters(path: Path) -> tuple[list[Path], str]:
    """Return the files that follow the first chapter of a recording, and what is missing among them or odd.

    There are none behind a file that is not named as a first chapter is.
    """
    stem, suffix = path.stem.upper(), path.suffix
    if (match := _NAME.fullmatch(stem)) is not None:
        kind, number, recording = match.groups()
        if kind != _OLD_LATER and number != "01":
            first = f"{path.stem[:2]}01{recording}{suffix}"
            return [], f"it is chapter {int(number)} of a recording; {first} opens all of it"
        if kind == _OLD_LATER:
            return [], f"it is chapter {int(number) + 1} of a recording; GOPR{recording}{suffix} opens all of it"
        names = [f"{path.stem[:2]}{k:02d}{recording}{suffix}" for k in range(2, _MOST_CHAPTERS)]
    elif (match := _OLD_FIRST.fullmatch(stem)) is not None:
        names = [f"{_OLD_LATER}{k:02d}{match[1]}{suffix}" for k in range(1, _MOST_CHAPTERS)]
    else:
        return [], ""
    there = [path.with_name(name).is_file() for name in names]
    count = there.index(False) if False in there else len(names)
    stray = [name for name, is_there in zip(names[count:], there[count:], strict=True) if is_there]
    why = f"{names[count]} is missing, so {', '.join(stray)} cannot be joined" if stray else ""
    return [path.with_name(name) for name in names[:count]], why


def joined_film(path: Path) -> Film:
    """Return a film with its chapters behind each other: the first frame of one is a period behind the last before.

    Raises DataError when the first chapter has no table of frame times; a later one that has none ends the film.
    """
    later, why = later_chapters(path)
    findings = [Finding("warning", why, path.name, "copy all chapters into one folder")] if why else []
    first = frame_times_ns(path)
    chapters = [Chapter(path, 0, 0, first)]
    for one in later:
        before = chapters[-1]
        try:
            frames_ns = frame_times_ns(one)
            if not len(frames_ns) or len(before.frames_ns) < 2:
                raise DataError(f"{one} has no frames")
        except DataError as error:
            findings.append(Finding("warning", f"the film ends before {one.name}: {error}", one.name, "copy it again"))
            break
        period_ns = int(before.frames_ns[-1] - before.frames_ns[-2])
        begins_ns = int(before.frames_ns[-1]) + period_ns - int(frames_ns[0])
        number = before.first_frame + len(before.frames_ns)
        chapters.append(Chapter(one, begins_ns, number, frames_ns + begins_ns))
    if len(chapters) > 1:
        names = ", ".join(chapter.path.name for chapter in chapters)
        findings.insert(0, Finding("ok", f"{len(chapters)} chapters are one film: {names}", path.name, ""))
    return Film(tuple(chapters), tuple(findings))


class JoinedTelemetry:
    """The telemetry of all chapters by the clock of the film; satisfies `ImuRows`."""

    def __init__(self, parts: list[tuple[Telemetry, int]]) -> None:
        """Take the telemetry of each chapter, and when (ns) the chapter begins."""
        self._parts = parts
        self._name = parts[0][0].path.name

    @property
    def has_imu(self) -> bool:
        """Whether the first chapter has rates and forces."""
        return self._parts[0][0].has_imu

    @property
    def fix_count(self) -> int:
        """How many samples of GNSS there are, with a fix or not."""
        return sum(part.fix_count for part, _ in self._parts)

    def findings(self) -> list[Finding]:
        """Return what doctor reports: of the first chapter, and what the others lack."""
        findings = self._parts[0][0].findings()
        for part, _ in self._parts[1:]:
            findings += [finding for finding in part.findings() if finding.severity != "ok"]
        return findings

    def imu_rows(self, problems: Problems) -> Rows:
        """Yield stamp (ns since the film began), rates and forces as `Telemetry.imu_rows`, across the chapters."""
        parts = [(part, begins_ns) for part, begins_ns in self._parts if part.has_imu]
        for part, _ in parts:
            part.count_damage(problems)

        def of_key(key: str) -> Rows:
            rows = chain.from_iterable(_shifted(part.rows, key, problems, begins_ns) for part, begins_ns in parts)
            return in_time_order(rows, problems, key)

        yield from paired(of_key("GYRO"), of_key("ACCL"), problems, self._name)

    def fixes(self, problems: Problems) -> Iterator[Fix]:
        """Yield the GNSS fixes of all chapters by the film's clock."""
        for part, begins_ns in self._parts:
            if part.fix_count:
                for fix in part.fixes(problems):
                    yield replace(fix, t_ns=fix.t_ns + begins_ns)


def open_joined(path: Path) -> Telemetry | JoinedTelemetry | None:
    """Return the telemetry of a film with its later chapters; None where the first has none.

    Raises DataError when the first file cannot be read; a later one that cannot is left out.
    """
    first = open_telemetry(path)
    if first is None or not later_chapters(path)[0]:
        return first
    parts = [(first, 0)]
    for chapter in joined_film(path).chapters[1:]:
        try:
            if (part := open_telemetry(chapter.path)) is not None:
                parts.append((part, chapter.begins_ns))
        except DataError:
            continue
    return JoinedTelemetry(parts)


def _shifted(rows: Callable[[str, Problems], Rows], key: str, problems: Problems, begins_ns: int) -> Rows:
    for t_ns, values in rows(key, problems):
        yield t_ns + begins_ns, values
