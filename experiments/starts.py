"""Starts in the middle of motion: how soon is there a pose, how wrong is its scale, and is it known to be wrong?

    .venv/bin/python experiments/starts.py [--count N] [--seed S] [--only NAME ...] [--set SECTION.FIELD=VALUE ...]
    .venv/bin/python experiments/starts.py --results results/starts/runs.csv

The first form takes N starts of `experiments/starts.toml` by lot (0: all) and runs them in this process, so that what
is compiled or read once is paid for once; map, loops and viewer are off. The second holds what `vislam compare
experiments/starts.toml` found against the same bars. Recordings are looked for in VISLAM_DATA, by default
../shared/data.

The scale error is that of the best similarity to the truth over the whole piece. Two sigmas are stated of it: that of
the start, and that of the graph in the end. A start is warned of where the run doubts itself (not of the noise of the
IMU alone), vision is lost in the end, or no pose was given.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is imported

import cv2
import numpy as np

from vislam.config import Config, from_data
from vislam.core.errors import DataError, TrackingLostError
from vislam.core.messages import Tracking
from vislam.core.recording import Recording
from vislam.experiment.jobs import Job, expand, unique
from vislam.experiment.plan import load_plan
from vislam.runs import imu_noise
from vislam.runs.evidence import front_evidence, whole_evidence
from vislam.runs.folder import RunLog
from vislam.runs.metrics import initialisation
from vislam.runs.sources import is_world, measured_inertial, open_source, shaken, split_source
from vislam.runs.verdict import judge as verdict_of
from vislam.sim import MeasuredInertial, open_points
from vislam.slam import Slam
from vislam.trajectory import Trajectory, evaluate
from vislam.trajectory.consistency import stated_scale_sigma

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
PLAN = Path(__file__).with_name("starts.toml")
SOON_S = 3.0  # a controller waits no longer
SIGMAS = 3.0
GROSS = 0.10  # of the scale: nobody may be that wrong and not say so
REAL_TRACKS = "V1_01 real tracks"
VIBRATING = "MH_01 vibrating"
BEGUN = ("static", "moving")


@dataclass(frozen=True)
class Start:
    """What came of one start; NaN where there is nothing to tell."""

    label: str
    sequence: str
    first_pose_s: float
    status: str
    scale_error: float
    start_sigma: float
    end_sigma: float
    ate_m: float
    warned: bool
    reason: str

    @property
    def is_soon(self) -> bool:
        """Whether a pose came soon enough."""
        return self.first_pose_s <= SOON_S  # false for NaN

    def sigmas(self, stated: float) -> float:
        """Return the scale error in stated sigmas."""
        return abs(self.scale_error) / stated if stated > 0.0 else float("nan")

    def line(self) -> str:
        """Return what is printed of it."""
        return (
            f"{self.label:<44} {self.first_pose_s:5.2f} s {self.status:<9} scale {100 * self.scale_error:+7.2f} %, "
            f"start {100 * self.start_sigma:5.2f} % ({self.sigmas(self.start_sigma):4.1f} sigma), "
            f"end {100 * self.end_sigma:5.2f} % ({self.sigmas(self.end_sigma):4.1f} sigma), "
            f"ATE {1e3 * self.ate_m:6.1f} mm{' warned' if self.warned else ''}  {self.reason[:90]}"
        )


@cache
def measured(uri: str) -> MeasuredInertial:
    """Read a recording's inertial data and truth once."""
    return measured_inertial(uri)


def opened(job: Job) -> Recording:
    """Open the source of a job."""
    scheme, name, options = split_source(job.source)
    if is_world(scheme, name) or not scheme.startswith("points:"):
        return open_source(job.source, job.config["seed"])
    chosen = dict(part.split("=", 1) for part in options.split(",") if part)
    return open_points(measured(scheme.removeprefix("points:") + name), job.config["seed"], **chosen)


def run(job: Job, overrides: Callable[[dict], dict]) -> Start:
    """Run one start through the pipeline."""
    config: Config = from_data(overrides(job.config), "starts")
    recording = shaken(opened(job), config.imu.vibration)
    slam, log = Slam(config, recording.rig, imu_noise(config.imu, recording.imu_noise)), RunLog()
    lost = ""
    try:
        for value in recording.events():
            for step in slam.feed(value):
                log.add(step)
    except TrackingLostError as error:
        lost = str(error)
    finish = slam.finish()
    for step in finish.steps:
        log.add(step)
    for keyframe in finish.keyframes:
        log.add_keyframe(keyframe)
    final, end_sigma = Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4))), float("nan")
    if slam.back is not None:
        graph = slam.back.graph
        states = graph.states()
        final = log.final_trajectory([int(i) for i in graph.ids], graph.poses(), states, config.machine)
        end_sigma = stated_scale_sigma(states)
    return judged(job, config, slam, log, final, recording.truth(), end_sigma, lost)


def judged(
    job: Job,
    config: Config,
    slam: Slam,
    log: RunLog,
    final: Trajectory,
    truth: Trajectory | None,
    end_sigma: float,
    lost: str,
) -> Start:
    """Compare what a start led to with the truth."""
    front = slam.front.report()
    begun = initialisation(front, int(log.stamps_ns[0]) if len(log) else None)
    errors: dict[str, float | None] = {}
    with suppress(DataError):  # without a trajectory there is nothing to compare
        errors = evaluate(final, truth, front.alignment) if truth is not None else {}
    evidence = whole_evidence(front_evidence(front, config.machine), log, final, len(log), [], {}, 0, {})
    told = list(verdict_of(evidence, config.verdict).reasons)
    is_lost = bool(lost) or log.newest_tracking is Tracking.LOST
    begins = begun["status"] in BEGUN
    reason = "; ".join(([] if begins else [str(begun["reason"])]) + told + ([lost] if lost else []))
    scale = errors.get("scale")
    return Start(
        job.label.replace(" tight seed 0 member 0", ""), job.sequence, number(begun["t_s"]), begun["status"],
        number(scale) - 1.0, number(begun["scale_sigma"]), end_sigma, number(errors.get("ate_rmse_m")),
        bool(told) or is_lost or not begins, reason,
    )  # fmt: skip


def number(value: object) -> float:
    """Return a number, NaN for what is missing."""
    return float("nan") if value is None or value == "" else float(str(value))


def from_results(path: Path) -> list[Start]:
    """Read what `vislam compare` found, of the final trajectories."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["output"] == "graph"]
    return [
        Start(
            f"{row['sequence']} noise {row['noise [px]']} start {row['start [s]']}", row["sequence"],
            number(row["initialisation_s"]), "moving" if row["initialisation_s"] else "none",
            number(row["scale_error"]), number(row["start_scale_sigma"]), number(row["end_scale_sigma"]),
            number(row["ate_m"]), row["status"] != "ok" or number(row["doubts"]) > 0, row["reason"],
        )
        for row in rows
    ]  # fmt: skip


def summary(starts: Sequence[Start]) -> list[str]:
    """Return the shares that the bars are about, for each sequence and for all simulated ones together."""
    groups = {name: [s for s in starts if s.sequence == name] for name in dict.fromkeys(s.sequence for s in starts)}
    groups["simulated vision, all"] = [s for s in starts if s.sequence not in (REAL_TRACKS, VIBRATING)]
    return ["", *(_share_line(name, members) for name, members in groups.items() if members)]


def _share_line(name: str, members: Sequence[Start]) -> str:
    ended = [s for s in members if np.isfinite(s.scale_error)]
    soon = sum(s.is_soon for s in members)
    at_start = [s.sigmas(s.start_sigma) <= SIGMAS for s in ended if s.start_sigma > 0.0]  # a start at rest has none
    at_end = [s.sigmas(s.end_sigma) <= SIGMAS for s in ended]
    gross = [s for s in ended if abs(s.scale_error) > GROSS]
    first_s = [s.first_pose_s for s in members if np.isfinite(s.first_pose_s)]
    scale = 100.0 * np.median([abs(s.scale_error) for s in ended]) if ended else np.nan
    return (
        f"{name}: {soon} of {len(members)} begin within {SOON_S:g} s (median {np.median(first_s or [np.nan]):.2f} s); "
        f"scale off by {scale:.2f} % in the median, within {SIGMAS:g} sigmas of the start {sum(at_start)} of "
        f"{len(at_start)}, of the end {sum(at_end)} of {len(at_end)}; off by over {GROSS:.0%}: {len(gross)}, "
        f"{sum(not s.warned for s in gross)} of them without a warning"
    )


def overriding(settings: Sequence[str]) -> Callable[[dict], dict]:
    """Return what applies SECTION.FIELD=VALUE to a configuration."""

    def apply(config: dict) -> dict:
        for setting in settings:
            dotted, _, value = setting.partition("=")
            *sections, name = dotted.split(".")
            node = config
            for section in sections:
                node = node[section]
            node[name] = value
        return config

    return apply


def main() -> None:
    """Run starts, or read results, and hold them against the bars."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plan", type=Path, default=PLAN, help="whose starts are run")
    parser.add_argument("--count", type=int, default=20, help="starts, drawn by lot; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the lot")
    parser.add_argument("--only", nargs="*", default=[], help="sequences of the plan, or beginnings of labels")
    parser.add_argument("--set", nargs="*", default=[], metavar="SECTION.FIELD=VALUE", help="settings of the pipeline")
    parser.add_argument("--results", type=Path, help="runs.csv of a comparison: nothing is run")
    arguments = parser.parse_args()
    if arguments.results is not None:
        starts = from_results(arguments.results)
        print("\n".join([*(start.line() for start in starts), *summary(starts)]))
        return
    cv2.setNumThreads(1)
    os.environ.setdefault("VISLAM_DATA", str(DATA))
    jobs = list(unique(expand(load_plan(arguments.plan))))
    if arguments.only:
        jobs = [job for job in jobs if any(job.label.startswith(name) for name in arguments.only)]
    if 0 < arguments.count < len(jobs):
        chosen = np.random.default_rng(arguments.seed).choice(len(jobs), arguments.count, replace=False)
        jobs = [jobs[i] for i in sorted(chosen.tolist())]
    apply, starts = overriding(arguments.set), []
    for job in jobs:
        cpu_s = time.process_time()
        starts.append(run(job, apply))
        print(f"{starts[-1].line()} [{time.process_time() - cpu_s:.1f} s CPU]", flush=True)
    print("\n".join(summary(starts)))


if __name__ == "__main__":
    main()
