"""What benchmarks measured, kept as one JSON file per revision, and what changed since the last one.

    .venv/bin/python benchmarks/results.py compare
    .venv/bin/python benchmarks/results.py compare window pose_graph --factor 1.3
    .venv/bin/python benchmarks/results.py table

Benchmarks that are given `--record` write `benchmarks/results/NAME/REVISION.json`: metrics in CPU milliseconds by name,
with machine, versions and date. `compare` prints for each metric of the newest file its change against the newest
earlier one of the same machine that has it, tells when one takes more than `factor` times as long as that (SLOWER) or
as the least so far (CREEPS), and exits with 1 when one does so by more than `--limit`. Where both files have the time
of a reference measured beside them (see cost.py), times are compared as multiples of it, whatever the machine.
`table` writes the newest file of each benchmark into the table of RESULTS.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from vislam.core.errors import DataError, VislamError  # noqa: E402
from vislam.core.files import write_text  # noqa: E402

FOLDER = ROOT / "benchmarks" / "results"
PAGE = ROOT / "benchmarks" / "RESULTS.md"
BEGIN, END = "<!-- table:begin -->", "<!-- table:end -->"
FACTOR = 1.3  # CPU times of one machine repeat within a fifth
_PACKAGES = ("numpy", "scipy", "numba", "gtsam", "opencv-python-headless")
_REVISION_DIGITS = 12


@dataclass(frozen=True, slots=True)
class Result:
    """What one benchmark measured at one revision on one machine."""

    revision: str
    date: str  # UTC, ISO 8601
    machine: str
    versions: dict[str, str]
    cpu_ms: dict[str, float]
    reference_ms: float | None = None  # CPU time of fixed work in the same process; None: not measured


@dataclass(frozen=True, slots=True)
class Change:
    """A metric of the newest result beside its last and its least value, as they would be where it was measured."""

    metric: str
    before_ms: float
    after_ms: float
    since: str  # the revision of the last value
    least_ms: float
    least_since: str

    @property
    def ratio(self) -> float:
        """Return the new time over the last one."""
        return self.after_ms / self.before_ms

    @property
    def creep(self) -> float:
        """Return the new time over the least one."""
        return self.after_ms / self.least_ms


def result(cpu_ms: Mapping[str, float], reference_ms: float | None = None) -> Result:
    """Return what was measured here and now; raises ValueError when a metric is not a positive number."""
    wrong = [metric for metric, value in cpu_ms.items() if not 0.0 < value < float("inf")]
    if wrong or not cpu_ms:
        raise ValueError(f"CPU times must be positive numbers: {', '.join(wrong) or 'there are none'}")
    now = datetime.now(UTC).isoformat(timespec="seconds")
    versions = {"python": platform.python_version(), **{package: metadata.version(package) for package in _PACKAGES}}
    times = {metric: float(f"{value:.6g}") for metric, value in cpu_ms.items()}
    rounded_ms = None if reference_ms is None else float(f"{reference_ms:.6g}")
    return Result(revision(), now, machine(), versions, times, rounded_ms)


def record(name: str, cpu_ms: Mapping[str, float], folder: Path = FOLDER, reference_ms: float | None = None) -> Path:
    """Write `folder/NAME/REVISION.json` and return its path.

    Metrics that this machine has measured at the same revision before stay beside the new ones; with a reference they
    do not, for it is one for all.

    Raises:
        ValueError: a metric is not a positive number.
        StorageError: the file cannot be written.
    """
    new = result(cpu_ms, reference_ms)
    path = folder / name / f"{new.revision}.json"
    if path.exists() and reference_ms is None:
        last = read(path)
        known = last.cpu_ms if last.machine == new.machine else {}
        new = replace(new, cpu_ms={**known, **new.cpu_ms})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(asdict(new), indent=1, sort_keys=True) + "\n")
    return path


def read(path: Path) -> Result:
    """Read a file that `record` wrote; raises DataError when it is something else."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        times = {str(metric): float(value) for metric, value in data["cpu_ms"].items()}
        reference_ms = data.get("reference_ms")
        found = Result(data["revision"], data["date"], data["machine"], data["versions"], times, reference_ms)
        every = [*times.values(), *([] if reference_ms is None else [reference_ms])]
        if datetime.fromisoformat(found.date).tzinfo is None or not all(value > 0.0 for value in every):
            raise ValueError("a date without a zone, or a time that is not positive")
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(f"{path} is no result of a benchmark ({error}); measure it again with --record") from error
    return found


def history(name: str, folder: Path = FOLDER) -> list[Result]:
    """Return the results of a benchmark, the oldest first; raises DataError when a file is damaged."""
    results = [read(path) for path in (folder / name).glob("*.json")]
    return sorted(results, key=lambda result: datetime.fromisoformat(result.date))


def changes(results: Sequence[Result]) -> list[Change]:
    """Return the metrics of the newest of results [N], the oldest first, that were measured before and compare."""
    if not results:
        return []
    newest, found = results[-1], []
    scaled = [(_times_here(earlier, newest), earlier.revision) for earlier in reversed(results[:-1])]
    for metric, after_ms in newest.cpu_ms.items():
        known = [(times[metric], since) for times, since in scaled if metric in times]
        if known:
            found.append(Change(metric, known[0][0], after_ms, known[0][1], *min(known)))
    return found


def _times_here(earlier: Result, newest: Result) -> dict[str, float]:
    """Return the times of an earlier result as they would be where the newest was measured; none if nobody can say."""
    if earlier.reference_ms is not None and newest.reference_ms is not None:
        factor = newest.reference_ms / earlier.reference_ms
        return {metric: value * factor for metric, value in earlier.cpu_ms.items()}
    return earlier.cpu_ms if earlier.machine == newest.machine else {}


def compare(names: Sequence[str], factor: float, folder: Path = FOLDER, limit: float | None = None) -> bool:
    """Print what changed in benchmarks, all that have results by default; see `told` for what is returned.

    Raises DataError when a benchmark has no results, or a file of it is damaged.
    """
    is_fine, names = True, names or sorted(path.name for path in folder.glob("*/"))
    if not names:
        raise DataError(f"{folder} holds no results; measure something with --record first")
    for name in names:
        results = history(name, folder)
        if not results:
            raise DataError(f"{name} has no results in {folder}; measure it with --record first")
        is_fine = told(name, results, factor, limit) and is_fine
    return is_fine


def told(name: str, results: Sequence[Result], factor: float, limit: float | None = None) -> bool:
    """Print what changed in the newest of results [N], the oldest first; return whether nothing is beyond the limit.

    What is beyond the factor is marked; the limit is the factor, unless another is given.
    """
    rows = changes(results)
    print(f"{name} at {results[-1].revision}" + ("" if rows else ": nothing to compare with"))
    for row in rows:
        verdict = ""
        if row.ratio > factor:
            verdict = "  SLOWER"
        elif row.creep > factor:
            verdict = f"  CREEPS: {row.creep:.2f}x since {row.least_since}"
        times = f"{row.before_ms:10.4g} ms -> {row.after_ms:10.4g} ms"
        print(f"  {row.metric:40} {times}  {row.ratio:5.2f}x since {row.since}{verdict}")
    beyond = sum(row.creep > factor for row in rows)
    if rows:
        print(f"{'WARNING: ' if beyond else ''}{beyond} of {len(rows)} became slower by more than {factor:g} times")
    return all(row.creep <= (factor if limit is None else limit) for row in rows)


def table(folder: Path = FOLDER) -> str:
    """Return a table of the newest result of each benchmark; raises DataError when a file is damaged."""
    lines = ["| benchmark | metric | CPU [ms] | revision | machine |", "|---|---|---:|---|---|"]
    for path in sorted(folder.glob("*/")):
        newest = history(path.name, folder)[-1]
        lines += [
            f"| {path.name} | {metric} | {value:.4g} | {newest.revision} | {newest.machine} |"
            for metric, value in newest.cpu_ms.items()
        ]
    return "\n".join(lines) + "\n"


def with_table(page: str, rows: str, name: str = str(PAGE)) -> str:
    """Return a page whose block between the markers is a table; raises DataError, with its name, where it has none."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise DataError(f"{name} has no lines {BEGIN} and {END}")
    return f"{before}{BEGIN}\n{rows}{END}{after}"


def revision() -> str:
    """Return the git revision of the code, "-changed" behind it when the library differs from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    return git("rev-parse", "HEAD")[:_REVISION_DIGITS] + ("-changed" if git("status", "--short", "vislam") else "")


def machine() -> str:
    """Return the processor's name and how many cores there are: times of different ones do not compare."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{platform.machine()} {models[0] if models else platform.processor()}, {os.cpu_count()} cores"


def main() -> int:
    """Do what the command line asks for; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["compare", "table"])
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks; all that have results by default")
    parser.add_argument("--factor", type=float, default=FACTOR, help="of CPU time that is still no change")
    parser.add_argument("--limit", type=float, help="beyond which the exit code is 1; --factor by default")
    args = parser.parse_args()
    try:
        if args.what == "table":
            write_text(PAGE, with_table(PAGE.read_text(encoding="utf-8"), table()))
            return 0
        return 0 if compare(args.names, args.factor, limit=args.limit) else 1
    except VislamError as error:
        print(error, file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
