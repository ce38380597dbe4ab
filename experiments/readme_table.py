"""The README's table, measured: runs vislam on every recording of the table and writes down what came out.

    .venv/bin/python experiments/readme_table.py [--out results/readme_table] [--only NAME ...] [--reuse]
    .venv/bin/python experiments/readme_table.py --profile pi --out results/readme_table_pi    # what a profile costs

Each run is a process of its own, as a user would start it; simulated worlds are recorded first, so that rendering does
not count. A recording that is missing or a run that fails stays in the
table and says so. The README's block between the markers is replaced, so that no number in it is typed by hand.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vislam.config.profiles import PROFILES
from vislam.core.files import write_text

REPOSITORY = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- table:begin -->", "<!-- table:end -->"
TIMEOUT_S = 1800.0
CLEAR = 2.0  # times what the truth is off by: its share of an error is 13 % there
_START = "from vislam.cli import main; main()"  # what the script `vislam` does, also where it is not on the path
COLUMNS = (
    "recording",
    "mode",
    "ATE batch [m]",
    "ATE graph [m]",
    "ATE EKF alone [m]",
    "keyframes",
    "loops",
    "real-time factor",
    "CPU [ms/frame]",
    "memory [MB]",
    "first pose [s]",
    "coverage",
)


@dataclass(frozen=True)
class Entry:
    """One row of the table: what to run."""

    name: str
    recording: str  # as the reader of the table knows it
    source: str  # "tum:FOLDER", "euroc:FOLDER", "points:FOLDER,option=value" below the data folder, or "sim:WORLD"
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What a run left: its metrics, or why there are none."""

    entry: Entry
    metrics: dict[str, Any] | None
    failure: str = ""


ENTRIES = (
    Entry("tum_fr1_desk", "TUM fr1_desk, 20 s", "tum:tum_fr1_desk"),
    Entry("euroc_mh01_stereo", "EuRoC MH_01, 17 s", "euroc:euroc_mh01_17s", ("--frontend.mode", "stereo")),
    Entry("euroc_mh01_mono", "EuRoC MH_01, 17 s", "euroc:euroc_mh01_17s", ("--frontend.mode", "mono")),
    Entry(
        "euroc_mh01_mono_loose",
        "the same, loosely coupled",
        "euroc:euroc_mh01_17s",
        ("--frontend.mode", "mono", "--graph.coupling", "loose", "--ekf.coupling", "loose"),
    ),
    Entry("v101_points", "EuRoC V1_01, IMU real, vision simulated", "points:euroc_v101_imu,rig=mono"),
    Entry("v201_points", "EuRoC V2_01, IMU real, vision simulated", "points:euroc_v201_imu,rig=mono"),
    Entry("corridor_loop", "simulated corridor-loop", "sim:corridor-loop"),
    Entry("corridor_open", "the same, loop closing off", "sim:corridor-loop", ("--loop.no-enabled",)),
    Entry(
        "corridor_starved",
        "the same, no IMU, 50 tracks instead of 400",
        "sim:corridor-loop",
        (
            "--imu.no-enabled",
            "--frontend.max-tracks",
            "50",
            "--frontend.min-inliers",
            "10",
            "--frontend.keyframe-min-inliers",
            "15",
        ),
    ),
    Entry("workshop_cart", "simulated workshop-cart", "sim:workshop-cart"),
)


def data_root() -> Path:
    """Return the folder of recordings: VISLAM_DATA, or the one beside the repository."""
    return Path(os.environ.get("VISLAM_DATA", REPOSITORY.parent / "shared" / "data"))


def measure(entry: Entry, out: Path, root: Path, reuse: bool = False, settings: Sequence[str] = ()) -> Outcome:
    """Run one entry in a process of its own, under its options and `settings`.

    With `reuse`, a finished run in `out` is taken as it is.
    """
    kind, _, rest = entry.source.partition(":")
    name, *options = rest.split(",")
    if kind != "sim" and not (root / name).is_dir():
        return Outcome(entry, None, "recording missing")
    if not (reuse and (out / "metrics.json").is_file()):
        shutil.rmtree(out, ignore_errors=True)
        folder = out.parent / "recordings" / name if kind == "sim" else root / name
        failure = _call("simulate", name, "--out", str(folder)) if kind == "sim" and not folder.exists() else ""
        source = ",".join([f"points:{folder}", *options]) if kind == "points" else str(folder)
        failure = failure or _call("run", source, "--out", str(out), *settings, *entry.options)
        failure = failure or _call("optimize", str(out))
        if failure:
            return Outcome(entry, None, failure)
    try:
        return Outcome(entry, json.loads((out / "metrics.json").read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        return Outcome(entry, None, f"metrics.json: {error}")


def _call(*arguments: str) -> str:
    """Run a verb in a process of its own; return why it failed, or an empty string."""
    command = [sys.executable, "-c", _START, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return f"no answer after {TIMEOUT_S:.0f} s"
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines() or ["no message"]
    return f"exit code {done.returncode}: {lines[-1]}"


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes as a Markdown table."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * 2 + "---:|" * (len(COLUMNS) - 2)]
    lines += ["| " + " | ".join(row(outcome)) + " |" for outcome in outcomes]
    return "\n".join(lines) + "\n"


def row(outcome: Outcome) -> list[str]:
    """Return the cells of one outcome; where there is no IMU, odometry stands in for the EKF.

    An error that is not clear of what the truth itself is off by has that beside it.
    """
    metrics = outcome.metrics
    if metrics is None:
        reason = outcome.failure.replace("|", "/")
        return [outcome.entry.recording, "–", reason, *["–"] * (len(COLUMNS) - 3)]
    accuracy = metrics.get("accuracy") or {}
    final, before = accuracy.get("graph") or {}, accuracy.get("ekf") or {}
    loops, cost = metrics.get("loops") or {}, metrics.get("cost") or {}
    inertial = metrics.get("has_imu", True)
    mode = str(metrics.get("mode", "?")) + (", inertial" if inertial else "")
    scale = final.get("scale")
    note = f" (scale {scale:.3f})" if isinstance(scale, float) and abs(scale - 1.0) > 0.02 else ""
    off_m = (metrics.get("truth") or {}).get("error_m", 0.0)
    batch, graph, causal = (
        _error(entry.get("ate_rmse_m"), off_m) for entry in (accuracy.get("batch") or {}, final, before)
    )
    return [
        outcome.entry.recording,
        mode,
        batch,
        graph + note,
        causal if inertial or causal == "–" else f"{causal} (odometry)",
        _number(metrics.get("keyframes"), 0),
        f"{_number(loops.get('accepted'), 0)} of {_number(loops.get('candidates'), 0)}",
        _number(metrics.get("realtime_factor"), 2),
        _number(cost.get("cpu_ms_per_frame"), 0),
        _number(cost.get("peak_memory_mb"), 0),
        f"{_number(cost.get('first_pose_s'), 2)} ({_number(cost.get('first_pose_cpu_s'), 1)} CPU)",
        _percent(final.get("coverage")),
    ]


def replace_block(readme: str, block: str) -> str:
    """Return the README with the text between the markers replaced; ValueError when the markers are not there once."""
    if readme.count(BEGIN) != 1 or readme.count(END) != 1 or readme.index(BEGIN) > readme.index(END):
        raise ValueError(f"the README needs one line {BEGIN} followed by one line {END}")
    head, rest = readme.split(BEGIN)
    return f"{head}{BEGIN}\n{block.strip()}\n{END}{rest.split(END)[1]}"


def _number(value: Any, digits: int) -> str:
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return f"{value:.{digits}f}" if good else "–"


def _error(value: Any, off_m: float) -> str:
    shown = _number(value, 3)
    return shown if shown == "–" or value > CLEAR * off_m else f"{shown} (truth {off_m:.3f})"


def _percent(value: Any) -> str:
    return "–" if _number(value, 0) == "–" else f"{100.0 * value:.0f} %"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write the table, update the README; 1 when a run is missing or failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "results" / "readme_table", help="folder of the runs")
    parser.add_argument("--only", nargs="+", choices=[entry.name for entry in ENTRIES], help="leave the README alone")
    parser.add_argument("--reuse", action="store_true", help="take runs that are already there")
    parser.add_argument("--profile", choices=sorted(PROFILES), help="run all under a profile, leave the README alone")
    options = parser.parse_args(arguments)
    settings = () if options.profile is None else ("--profile", options.profile)
    options.out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    for entry in ENTRIES:
        if options.only is None or entry.name in options.only:
            outcomes.append(measure(entry, options.out / entry.name, data_root(), options.reuse, settings))
            print(" | ".join(row(outcomes[-1])), flush=True)
    text = table(outcomes)
    write_text(options.out.with_suffix(".md"), text)
    if options.only is None and options.profile is None:
        readme = REPOSITORY / "README.md"
        write_text(readme, replace_block(readme.read_text(encoding="utf-8"), text))
    return 0 if all(outcome.metrics is not None for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
