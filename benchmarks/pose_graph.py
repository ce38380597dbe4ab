"""Pose-graph optimisers side by side: every peer on the same file, one after the other, and cost against size.

    .venv/bin/python benchmarks/pose_graph.py FILE.g2o ...
    .venv/bin/python benchmarks/pose_graph.py landmarks     # Victoria Park of the installed gtsam
    .venv/bin/python benchmarks/pose_graph.py commands FILE.g2o ... --record   # whole commands, into docs/batch.md
    .venv/bin/python benchmarks/pose_graph.py growth --sizes 1000 10000 100000 --picture growth.png

Each peer runs in a process of its own, reads the file, solves and writes a g2o file; times are its CPU seconds, the
least of the rounds, in which peers take turns. Results are then judged alike, as they are in memory: chi2 of the poses
(`PoseGraphProblem`: Log residuals, full information, no factor 1/2), how far it is above the lowest that a peer found,
whether `certify` proves them, and where our descent ends from there: g2o minimises another cost (the vector part of
quaternions), so its optimum is not one of this chi2, but it may lie in the same valley. The first round of ours, which
loads compiled code, does not count. g2o and Ceres come from wheels that are no part of vislam:

    pip install --no-deps --target FOLDER g2opy pyceres     # then --peers FOLDER

A whole command is a process from its start to its end: of ours, `vislam posegraph` with what it reports by default, and
with the optimum alone. Without the wheels their rows say that they are missing, as do those of a peer that fails.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import results

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from vislam.batch.posegraph.certificate import certify  # noqa: E402
from vislam.batch.posegraph.files import read_pose_graph  # noqa: E402
from vislam.batch.posegraph.g2o import write_g2o  # noqa: E402
from vislam.batch.posegraph.optimize import optimize_pose_graph  # noqa: E402
from vislam.batch.posegraph.problem import PoseGraphProblem  # noqa: E402
from vislam.batch.posegraph.solver import levenberg_marquardt  # noqa: E402
from vislam.batch.posegraph.structure import Structure  # noqa: E402
from vislam.batch.posegraph.worlds import simulate_graph  # noqa: E402
from vislam.config import GraphWorldConfig, PoseGraphConfig  # noqa: E402
from vislam.core.errors import VislamError  # noqa: E402

PAGE = ROOT / "docs" / "batch.md"
COMMANDS = {"vislam": (), "optimum alone": ("--no-noise", "--no-certify", "--no-report")}
PEER = ROOT / "benchmarks" / "peers" / "pose_graph_peer.py"
OURS, PEERS = "vislam", ("vislam", "gtsam_lm", "gtsam_chordal_lm", "g2o_lm", "ceres_lm")
# SE-Sync's published costs (IJRR 2019); where the tables lack a file, of a run of its program
SE_SYNC = {
    "intel": 52.348, "MIT": 61.154, "manhattan": 6431.4, "parking-garage": 1.2625, "sphere2500": 1687.01,
    "smallGrid3D": 1025.40,
}  # fmt: skip


def run_peer(name: str, source: Path, result: Path, limit_s: float, wheels: str = "") -> dict[str, Any]:
    """Return the times of a peer, or {"reason": why there are none}."""
    command = [sys.executable, str(PEER), name, str(source), str(result)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *([wheels] if wheels else [])])}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=False, env=environment)
    except subprocess.TimeoutExpired:
        return {"reason": f"not done after {limit_s:g} s"}
    if done.returncode:
        lines = [line for line in done.stderr.strip().splitlines() if line.strip()] or [f"exit code {done.returncode}"]
        return {"reason": lines[-1][:90]}
    return json.loads(done.stdout.strip().splitlines()[-1])


def judge(problem: PoseGraphProblem, poses: np.ndarray) -> tuple[float, str, float]:
    """Return chi2 of poses, the certificate's word, and chi2 where our descent ends from them."""
    try:
        certificate = certify(problem, poses)
    except VislamError as error:
        return problem.chi2(poses), str(error)[:40], float("nan")
    ones = np.ones(len(problem.edges))
    refined = levenberg_marquardt(Structure(problem), poses, ones, iterations=200, tolerance=1e-12)
    return certificate.chi2, "yes" if certificate.certified else "no", problem.chi2(refined.poses)


def compare(files: list[Path], limit_s: float, folder: Path, wheels: str, rounds: int) -> dict[str, float]:
    """Print the table of all peers on files; return CPU ms of ours."""
    cpu_ms: dict[str, float] = {}
    print("| file | peer | load s | solve s | total s | wall s | chi2 | above the lowest | certified | refined |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---|---:|")
    versions: dict[str, str] = {}
    for source in files:
        problem = read_pose_graph(source)
        rows: dict[str, list[dict[str, Any]]] = {peer: [] for peer in PEERS}
        for _ in range(rounds):
            for peer, runs in rows.items():
                if not runs or "reason" not in runs[-1]:
                    runs.append(run_peer(peer, source, folder / f"{source.stem}_{peer}.g2o", limit_s, wheels))
        ended = {peer: runs for peer, runs in rows.items() if "reason" not in runs[-1]}
        judged = {peer: judge(problem, np.load(folder / f"{source.stem}_{peer}.g2o.npy")) for peer in ended}
        lowest = min((chi2 for chi2, _, _ in judged.values()), default=float("nan"))
        for peer, runs in rows.items():
            if peer not in judged:
                print(f"| {source.stem} | {peer} | | | | | | | {runs[-1]['reason']} | |", flush=True)
                continue
            versions[peer] = runs[-1]["version"]
            least = min(runs, key=lambda run: float(run["total"]))
            numbers = [f"{least[key]:.3f}" for key in ("load", "solve", "total", "wall")]
            if least["evaluation"] > 0.0:
                numbers[1] += f" ({least['solve'] * (1.0 - least['evaluation']):.3f} without Python)"
            chi2, word, refined = judged[peer]
            ends = f"{chi2:.9g} | {chi2 / lowest - 1.0:.1e} | {word} | {refined:.9g}"
            print(f"| {source.stem} | {peer} | {' | '.join(numbers)} | {ends} |", flush=True)
        if OURS in judged:
            for part in ("load", "solve"):
                cpu_ms[f"{source.stem}, {part}"] = 1e3 * min(float(run[part]) for run in rows[OURS])
            certificate = certify(problem, np.load(folder / f"{source.stem}_{OURS}.g2o.npy"))
            theirs = f", published {SE_SYNC[source.stem]:g}" if source.stem in SE_SYNC else ""
            print(f"\n{source.stem}: SE-Sync's cost {certificate.isotropic_cost:.6g}{theirs}; {certificate.text}\n")
    print("versions: " + ", ".join(f"{peer} {number}" for peer, number in versions.items()))
    return cpu_ms


def commands(files: list[Path], limit_s: float, folder: Path, wheels: str, rounds: int) -> dict[str, float]:
    """Return CPU ms of whole commands, ours and the peers', the least of the rounds, of which the first compiles."""
    cpu_ms: dict[str, float] = {}
    for source in files:
        for _ in range(rounds):
            for name in (*COMMANDS, *PEERS[1:]):
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                if name in COMMANDS:
                    command = [sys.executable, "-m", "vislam", "posegraph", str(source), "--out", str(folder / "out")]
                    subprocess.run([*command, *COMMANDS[name]], cwd=ROOT, capture_output=True, check=True)
                elif "reason" in run_peer(name, source, folder / "out.g2o", limit_s, wheels):
                    continue
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                spent = 1e3 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
                metric = f"{source.stem}, whole command, {name}"
                cpu_ms[metric] = min(spent, cpu_ms.get(metric, spent))
    return cpu_ms


def table_of_commands(cpu_ms: dict[str, float]) -> str:
    """Return a table of whole commands in CPU seconds, a row for each file."""
    names = (*COMMANDS, *PEERS[1:])
    files = dict.fromkeys(metric.split(", ")[0] for metric in cpu_ms if ", whole command, " in metric)
    rows = [["CPU [s]", *names], ["---", *["---:"] * len(names)]]
    for file in files:
        times = [cpu_ms.get(f"{file}, whole command, {name}") for name in names]
        rows.append([file, *("" if time is None else f"{1e-3 * time:.2f}" for time in times)])
    return "".join(f"|{'|'.join(row)}|\n" for row in rows)


def growth(
    shapes: list[str], sizes: list[int], loops: float, limit_s: float, folder: Path, picture: Path | None
) -> None:
    """Print, and draw, CPU time and memory against size."""
    rows: list[dict[str, Any]] = []
    print("| shape | poses | edges | load s | solve s | total s | peak MB | chi2 / degrees of freedom |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for shape in shapes:
        for size in sizes:
            made = simulate_graph(shape, GraphWorldConfig(poses=size, loops_per_pose=loops))  # type: ignore[arg-type]
            problem, source = made.problem, folder / "made.g2o"
            write_g2o(problem, source)
            edges = len(problem.edges)
            times = run_peer(OURS, source, folder / "result.g2o", limit_s)
            if "reason" in times:
                print(f"| {shape} | {size} | {edges} | {times['reason']} | | | | |", flush=True)
                continue
            ratio = problem.chi2(read_pose_graph(folder / "result.g2o").poses) / (problem.tangent * (edges - size + 1))
            numbers = " | ".join(f"{times[key]:.2f}" for key in ("load", "solve", "total"))
            print(f"| {shape} | {size} | {edges} | {numbers} | {times['peak_mb']:.0f} | {ratio:.4f} |", flush=True)
            rows.append({"shape": shape, "poses": size, **times})
    if picture is not None:
        draw(rows, picture)


def landmarks() -> None:
    """Print CPU seconds and chi2 of our start and descent, and of gtsam's Levenberg-Marquardt from the same start."""
    import gtsam

    from peers.gtsam_route import gtsam_levenberg_marquardt

    source = Path(gtsam.__file__).parent / "Data" / "victoria_park.txt"
    print("| file | start | method | solve s (CPU) | chi2 |\n|---|---|---|---:|---:|")
    for _ in range(2):  # the first round loads compiled code
        problem = read_pose_graph(source)
        grown = optimize_pose_graph(problem, PoseGraphConfig(start="grown"))
    chordal = optimize_pose_graph(problem, PoseGraphConfig(start="chordal"))
    begun = time.process_time()
    peer = gtsam_levenberg_marquardt(problem, grown.start)
    peer_s = time.process_time() - begun
    for start, method, seconds, end in (
        ("grown", "ours", grown.solve_s, grown), ("grown", "gtsam, without the start", peer_s, peer),
        ("chordal", "ours", chordal.solve_s, chordal),
    ):  # fmt: skip
        numbers = f"{seconds:.2f} | {end.costs[-1]:.9g}{'' if end.converged else ', not converged'}"
        print(f"| {source.stem} | {start} | {method} | {numbers} |", flush=True)


def draw(rows: list[dict[str, Any]], picture: Path) -> None:
    """Draw CPU time and memory over size, with a line of n log n."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    for shape in dict.fromkeys(row["shape"] for row in rows):
        of_shape = [row for row in rows if row["shape"] == shape]
        poses = np.array([row["poses"] for row in of_shape])
        left.loglog(poses, [row["solve"] for row in of_shape], "o-", label=shape)
        right.loglog(poses, [row["peak_mb"] for row in of_shape], "o-", label=shape)
    poses = np.array(sorted({row["poses"] for row in rows}), dtype=float)
    least = min(row["solve"] for row in rows if row["poses"] == poses[0])
    left.loglog(poses, least * poses * np.log(poses) / (poses[0] * np.log(poses[0])), "k--", lw=0.8, label="n log n")
    left.set(xlabel="poses", ylabel="CPU time to solve [s]")
    right.axhline(4096.0, color="k", ls="--", lw=0.8)
    right.set(xlabel="poses", ylabel="peak memory [MB]")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(picture, dpi=100)


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "files", nargs="+", help="g2o files, also behind the word commands; or one of the words growth, landmarks"
    )
    parser.add_argument("--limit-s", type=float, default=600.0, help="of a peer on a file")
    parser.add_argument("--shapes", nargs="+", default=["manhattan", "torus", "sphere", "grid3d"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[1000, 3000, 10000, 30000, 100000])
    parser.add_argument("--loops-per-pose", type=float, default=1.0, help="4 makes 500,000 edges of 100,000 poses")
    parser.add_argument("--peers", default="", help="folder with the wheels of g2opy and pyceres")
    parser.add_argument("--rounds", type=int, default=3, help="in which peers take turns on a file")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--record", action="store_true", help="keep the times in benchmarks/results")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if args.files == ["growth"]:
            growth(args.shapes, args.sizes, args.loops_per_pose, args.limit_s, folder, args.picture)
        elif args.files == ["landmarks"]:
            landmarks()
        elif args.files[0] == "commands":
            cpu_ms = commands([Path(f) for f in args.files[1:]], args.limit_s, folder, args.peers, args.rounds)
            print(table_of_commands(cpu_ms))
            if args.record:
                kept = results.read(results.record("pose_graph", cpu_ms)).cpu_ms
                page = results.with_table(PAGE.read_text(encoding="utf-8"), table_of_commands(kept), PAGE.name)
                PAGE.write_text(page, encoding="utf-8")
        else:
            cpu_ms = compare([Path(file) for file in args.files], args.limit_s, folder, args.peers, args.rounds)
            if args.record:
                results.record("pose_graph", cpu_ms)


if __name__ == "__main__":
    main()
