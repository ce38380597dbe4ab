"""How far loop closing can be trusted: precision, recall and gross edges over worlds, recordings and seeds.

    .venv/bin/python experiments/loop_precision_recall.py [--seeds 3] [--camera-hz 6] [--out FOLDER] [--reuse]
        [--sources sim:aliased-halls tum:/data/tum_fr1_desk ...] [--drift 0.05 [--no-guess]]
        [-- --loop.min-inliers 15 ...]

Each run is a process of its own, as a user would start it, without map and viewer. A seed is that of the pipeline; of a
simulated world also that of the place, the motion and the sensors. The runs of a source are pooled: one table
(`table.md`), two drawings per source (`curves.svg`), all numbers (`results.json`). What follows `--` goes to
every `vislam run`. A run that fails stays in the table and says so; --reuse takes run folders that are there already.

With --drift the keyframes of each run go through a new detector again, without a graph that would mend anything: their
poses are those of odometry, pulled away along one axis by so many metres per metre of the way. --no-guess takes the
candidates away that these poses suggest, so that appearance has to do alone. What is judged then is the detector.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import LoopTruthConfig
from vislam.core.errors import VislamError
from vislam.core.files import write_json, write_text
from vislam.core.messages import Array, Frame, Keyframe, LoopCandidate
from vislam.loop import Detections, LoopCloser, LoopRow, loops_text, retrieved_text
from vislam.runs.offline.loop_evaluation import JudgedLoops, judge_loops, summarise
from vislam.runs.report import write_loop_plot
from vislam.runs.session import Session

WORLDS = ("workshop-cart", "corridor-loop", "aliased-halls")
_START = "from vislam.cli import main; main()"
_QUIET = ("--map.no-enabled", "--view.no-enabled", "--overwrite")
_TIMEOUT_S = 3600.0


def pooled(runs: Sequence[JudgedLoops]) -> JudgedLoops:
    """Return several runs as one: their keyframes after each other."""
    stages = {
        name: Detections(
            np.concatenate([run.stages[name].score for run in runs]),
            np.concatenate([run.stages[name].verdict for run in runs]),
        )
        for name in runs[0].stages
    }
    sources = sorted({source for run in runs for source in run.proposals})
    proposals = {}
    for source in sources:
        each = [run.proposals.get(source, (0, 0)) for run in runs]
        proposals[source] = (sum(count for count, _ in each), sum(near for _, near in each))
    found = {step: sum(run.found[step] for run in runs) for step in runs[0].found}
    edges = [edge for run in runs for edge in run.edges]
    return JudgedLoops(np.concatenate([run.revisits for run in runs]), stages, edges, proposals, found)


def main() -> None:
    """Run, judge, write."""
    options, extra = _options()
    rule = LoopTruthConfig()
    answers: dict[str, dict[str, Any]] = {}
    for source in options.sources:
        name = source.rpartition(":")[2].rstrip("/").rpartition("/")[2].partition(",")[0]
        judged, failures = [], []
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            run = options.out / "runs" / f"{name}_{seed}"
            is_there = options.reuse and (run / "metrics.json").is_file()
            failure = "" if is_there else _run(source, seed, run, options, extra)
            try:
                told = run if options.drift is None else _drifted(run, options.drift, options.no_guess)
                judged.append(judge_loops(told, rule))
                print(f"{source} seed {seed}: {_line(judged[-1])}", flush=True)
            except VislamError as error:
                failures.append(f"seed {seed}: {failure or error}")
                print(f"{source} {failures[-1]}", flush=True)
        found = summarise(pooled(judged), rule) if judged else {}
        answers[name] = {**found, "runs": len(judged), "failures": failures}
        _write(options.out, answers)


def _options() -> tuple[argparse.Namespace, list[str]]:
    given = sys.argv[1:]
    end = given.index("--") if "--" in given else len(given)
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sources", nargs="+", default=[f"sim:{world}" for world in WORLDS])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--camera-hz", type=float, default=None, help="of simulated worlds; rendering takes most time")
    parser.add_argument("--out", type=Path, default=Path("results/loop_precision_recall"))
    parser.add_argument("--reuse", action="store_true")
    parser.add_argument("--drift", type=float, default=None, help="of the way, for a second look without a graph")
    parser.add_argument("--no-guess", action="store_true", help="with --drift: no candidates by odometry")
    return parser.parse_args(given[:end]), given[end + 1 :]


def _run(source: str, seed: int, run: Path, options: argparse.Namespace, extra: list[str]) -> str:
    """Run a source; return why it failed, or an empty string."""
    if source.startswith("sim:"):
        source += f",world_seed={seed}" + ("" if options.camera_hz is None else f",camera_hz={options.camera_hz:g}")
    run.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", _START, "run", source, "--seed", str(seed), "--out", str(run), *_QUIET, *extra]
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, env={**os.environ, **threads}, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"not done after {_TIMEOUT_S:g} s"
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]


def _drifted(run: Path, share: float, no_guess: bool) -> Path:
    """Send the keyframes of a run through a new detector with odometry that drifts; return a folder that tells it."""
    out = run.with_name(f"{run.name}_drift")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    for name in ("session.db", "trajectory_truth.tum"):
        shutil.copy(run / name, out / name)
    session = Session(run / "session.db")
    log, config, stored = session.factor_log(), session.config(), list(session.keyframes())
    session.close()
    loop = replace(config.loop, max_odometry=0) if no_guess else config.loop
    detector = LoopCloser(loop, log.rig, config.seed, log.first_state is not None)
    rows, retrieved = [], []
    for k, T in zip(stored, pulled_away(np.array([k.T_odom_body for k in stored]), share), strict=True):
        keyframe = Keyframe(k.id, k.t_ns, Frame(k.t_ns, k.id, ()), k.keypoints_px, k.descriptors, k.points_body_m)
        rows += [_row(candidate) for candidate in detector.detect(keyframe, T, tags=())[1]]
        retrieved += detector.retrieved
    detector.close()
    write_text(out / "loops.csv", loops_text(rows))
    write_text(out / "retrieved.csv", retrieved_text(retrieved))
    return out


def pulled_away(T_odom_body: Array, share: float) -> Array:
    """Return poses [N, 4, 4] that are off along x by a share of the way until then."""
    moved = T_odom_body.copy()
    steps_m = np.linalg.norm(np.diff(T_odom_body[:, :3, 3], axis=0), axis=1)
    moved[:, 0, 3] += share * np.concatenate([[0.0], np.cumsum(steps_m)])
    return moved


def _row(c: LoopCandidate) -> LoopRow:
    nan = float("nan")
    return LoopRow(
        c.from_id, c.to_id, -1, -1, c.source, c.score, c.inliers, c.supporters, c.sigma_m, c.consistency, nan, nan, nan,
        nan, c.T_from_to, c.decision.value, c.reason,
    )  # fmt: skip


def _line(judged: JudgedLoops) -> str:
    gross = sum(edge.is_gross for edge in judged.edges)
    sources = [f"{near} of {count} by {source} near" for source, (count, near) in judged.proposals.items()]
    steps = [f"{name} {count}" for name, count in judged.found.items()]
    return f"{len(judged.edges)} edges, {gross} gross; {'; '.join(sources)}; keyframes: {', '.join(steps)}"


def _write(out: Path, answers: dict[str, dict[str, Any]]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "results.json", answers)
    write_text(out / "table.md", _table(answers))
    drawn = {name: answer for name, answer in answers.items() if answer["runs"]}
    if drawn:
        write_loop_plot(out / "curves.svg", drawn)


def _table(answers: dict[str, dict[str, Any]]) -> str:
    """Return the table: per source the figures of every stage and of the edges."""
    head = ["source", "runs", "revisits", "stage", "wrong", "precision", "recall", "recall at 100 %", "interval"]
    head += ["edges", "gross", "median error"]
    lines = [" | ".join(head), " | ".join(["---"] * len(head))]
    for name, answer in answers.items():
        first = [name, str(answer["runs"]), str(answer.get("revisits", "-"))]
        edges = answer.get("edges")
        for stage, entry in answer.get("stages", {}).items():
            low, high = entry["interval"]
            shares = [entry[key] for key in ("precision", "recall", "recall_at_full_precision")]
            row = [*first, stage, str(entry["wrong"]), *(_number(value) for value in shares)]
            row += [f"{low:.2f} to {high:.2f}"]
            if stage == "graph" and edges:
                row += [str(edges["accepted"]), str(edges["gross"]), f"{_number(edges['error_m']['median'])} m"]
            else:
                row += ["", "", ""]
            lines.append(" | ".join(row))
            first = ["", "", ""]
        lines += [f"{name} | {failure}" for failure in answer["failures"]]
    return "\n".join(f"| {line} |" for line in lines) + "\n"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
