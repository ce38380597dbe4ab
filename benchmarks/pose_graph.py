"""Pose-graph optimisers side by side: every peer on the same file, one after the other, and cost against size.

    .venv/bin/python benchmarks/pose_graph.py FILE.g2o ...
    .venv/bin/python benchmarks/pose_graph.py growth --sizes 1000 10000 100000 --picture growth.png

Each peer runs in a process of its own, reads the file, solves and writes a g2o file; times are its CPU seconds. Results
are then judged alike: chi2 of the written poses (`PoseGraphProblem`: Log residuals, full information, no factor 1/2),
and whether `certify` proves them; peers minimise costs that differ a little, so theirs can be 1e-4 above the best one
and still be a minimum of their own. The first round of ours, which loads compiled code, does not count. g2o comes from
the wheel g2opy, in a virtual environment that is made for it (needs the network); a peer that cannot be had or fails is
listed with the reason. Ceres is not here: pycolmap's `RelativePosePriorCost` takes a pose as a block of seven numbers,
and pyceres has no manifold for such a block.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import Any

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from vislam.batch.graph_certificate import certify  # noqa: E402
from vislam.batch.graph_files import read_pose_graph  # noqa: E402
from vislam.batch.graph_g2o import write_g2o  # noqa: E402
from vislam.batch.graph_problem import PoseGraphProblem  # noqa: E402
from vislam.batch.graph_worlds import simulate_graph  # noqa: E402
from vislam.config import GraphWorldConfig  # noqa: E402
from vislam.errors import VislamError  # noqa: E402

PEER = ROOT / "benchmarks" / "peers" / "pose_graph_peer.py"
OURS, GTSAM, CHORDAL, G2O = "vislam", "gtsam_lm", "gtsam_chordal_lm", "g2o_lm"
# SE-Sync's published costs (IJRR 2019); where the tables lack a file, of a run of its program
SE_SYNC = {
    "intel": 52.348, "MIT": 61.154, "manhattan": 6431.4, "parking-garage": 1.2625, "sphere2500": 1687.01,
    "smallGrid3D": 1025.40,
}  # fmt: skip


def run_peer(name: str, python: str, source: Path, result: Path, limit_s: float) -> dict[str, Any]:
    """Return the times of a peer, or {"reason": why there are none}."""
    command = [python, str(PEER), name, str(source), str(result)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=False, env=environment)
    except subprocess.TimeoutExpired:
        return {"reason": f"not done after {limit_s:g} s"}
    if done.returncode:
        lines = [line for line in done.stderr.strip().splitlines() if line.strip()] or [f"exit code {done.returncode}"]
        return {"reason": lines[-1][:90]}
    return json.loads(done.stdout.strip().splitlines()[-1])


def g2o_python(folder: Path) -> tuple[str, str]:
    """Return a python that has g2opy, or "" and the reason why there is none."""
    try:
        venv.create(folder, with_pip=True)
        python = str(folder / "bin" / "python")
        subprocess.run([python, "-m", "pip", "install", "-q", "g2opy"], check=True, capture_output=True, timeout=300)
    except (OSError, subprocess.SubprocessError) as error:
        return "", f"g2opy cannot be installed: {type(error).__name__}"
    return python, ""


def judge(problem: PoseGraphProblem, result: Path) -> tuple[str, str]:
    """Return chi2 and the certificate's word of the poses that a peer wrote."""
    try:
        poses = read_pose_graph(result).poses
        certificate = certify(problem, poses)
    except VislamError as error:
        return "-", str(error)[:40]
    return f"{certificate.chi2:.7g}", certificate.word


def compare(files: list[Path], limit_s: float, folder: Path, g2o: str) -> None:
    """Print the table of all peers on files."""
    python, reason = (g2o, "") if g2o else g2o_python(folder / "g2o")
    print("| file | poses, edges | peer | load s | solve s | total s | wall s | chi2 | certified |")
    print("|---|---|---|---:|---:|---:|---:|---:|---|")
    for source in files:
        problem = read_pose_graph(source)
        size = f"{len(problem.ids)}, {len(problem.edges)}"
        best = None
        for peer in (OURS, GTSAM, CHORDAL, G2O):
            result = folder / f"{source.stem}_{peer}.g2o"
            own = python if peer == G2O else sys.executable
            times = run_peer(peer, own, source, result, limit_s) if own else {"reason": reason}
            if "reason" in times:
                print(f"| {source.stem} | {size} | {peer} | | | | | | {times['reason']} |", flush=True)
                continue
            chi2, word = judge(problem, result)
            numbers = " | ".join(f"{times[key]:.3f}" for key in ("load", "solve", "total", "wall"))
            print(f"| {source.stem} | {size} | {peer} | {numbers} | {chi2} | {word} |", flush=True)
            if peer == OURS:
                best = certify(problem, read_pose_graph(result).poses)
        if best is not None:
            theirs = f", published {SE_SYNC[source.stem]:g}" if source.stem in SE_SYNC else ""
            print(f"\n{source.stem}: SE-Sync's cost {best.isotropic_cost:.6g}{theirs}; {best.text}\n", flush=True)


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
            times = run_peer(OURS, sys.executable, source, folder / "result.g2o", limit_s)
            if "reason" in times:
                print(f"| {shape} | {size} | {edges} | {times['reason']} | | | | |", flush=True)
                continue
            ratio = problem.chi2(read_pose_graph(folder / "result.g2o").poses) / (problem.tangent * (edges - size + 1))
            numbers = " | ".join(f"{times[key]:.2f}" for key in ("load", "solve", "total"))
            print(f"| {shape} | {size} | {edges} | {numbers} | {times['peak_mb']:.0f} | {ratio:.4f} |", flush=True)
            rows.append({"shape": shape, "poses": size, **times})
    if picture is not None:
        draw(rows, picture)


def draw(rows: list[dict[str, Any]], picture: Path) -> None:
    """Draw CPU time and memory over size, with a line of n log n."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

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
    parser.add_argument("files", nargs="+", help="g2o files, or the word growth")
    parser.add_argument("--limit-s", type=float, default=600.0, help="of a peer on a file")
    parser.add_argument("--shapes", nargs="+", default=["manhattan", "torus", "sphere", "grid3d"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[1000, 3000, 10000, 30000, 100000])
    parser.add_argument("--loops-per-pose", type=float, default=1.0, help="4 makes 500,000 edges of 100,000 poses")
    parser.add_argument("--g2o-python", default="", help="a python that has g2opy, instead of making one")
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if args.files == ["growth"]:
            growth(args.shapes, args.sizes, args.loops_per_pose, args.limit_s, folder, args.picture)
        else:
            compare([Path(file) for file in args.files], args.limit_s, folder, args.g2o_python)


if __name__ == "__main__":
    main()
