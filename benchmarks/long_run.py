"""Does the graph's work grow with the length of a run? Time and memory of keyframe updates, printed and plotted.

    .venv/bin/python benchmarks/long_run.py hour --coupling loose --minutes 60
    .venv/bin/python benchmarks/long_run.py room --keyframes 7200 --all-loops 600 --picture docs/images/loops_growth.png
    .venv/bin/python benchmarks/long_run.py chain --kilometres 10 --step 1.0
    .venv/bin/python benchmarks/long_run.py g2o sphere2500 M3500

`hour` feeds a simulated hour of IMU, stereo tracks, odometry and loops through PoseGraph; `room` drives the round of
`workshop-cart` again and again, with a loop at every keyframe from the second round on; `chain` an open-loop chain of
odometry; `g2o` replays files in key order. Times are CPU time of the thread. Plots go to results/long_run/.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "soak")]

import matplotlib  # noqa: E402
import numpy as np  # noqa: E402
import psutil  # noqa: E402

matplotlib.use("Agg")

from g2o_edges import BEST_CHI2, EdgeFile  # noqa: E402
from matplotlib import pyplot as plt  # noqa: E402
from scipy.interpolate import CubicSpline  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

import vislam.window  # noqa: E402
from vislam.config import GraphConfig, WindowConfig  # noqa: E402
from vislam.core.geometry import align_points, se3_exp, transform  # noqa: E402
from vislam.core.messages import Array, Tracking, VoMeasurement  # noqa: E402
from vislam.graph import Graph, PoseGraph  # noqa: E402
from vislam.sim.motion.path import rounded_path  # noqa: E402
from worlds.endless_lap import STEREO, LapWorld, window_of_truth  # noqa: E402
from worlds.lap import packet_of  # noqa: E402
from worlds.parts import MACHINE  # noqa: E402

RESULTS = ROOT / "results" / "long_run"


def cart_round(lap_s: float = 40.0) -> tuple[Callable[[Array], Array], Callable[[Array], Rotation], float]:
    """Return one round through the hall of `workshop-cart` as a motion of `LapWorld`: it heads where it drives."""
    path = rounded_path(
        [(-4.55, -2.65), (4.55, -2.65), (4.55, 2.65), (-4.55, 2.65), (-4.55, -2.65), (0.0, -2.65)], 1.05
    )
    begin_m, end_m = 4.55, path.length_m  # both in the middle of the first side, one round apart
    t = np.linspace(0.0, lap_s, 81)
    xy, heading = path.at(begin_m + (end_m - begin_m) * t / lap_s)
    xy[-1] = xy[0]
    way = CubicSpline(t, np.column_stack([xy, np.full(len(t), 0.3)]), bc_type="periodic")
    turn = np.unwrap(heading) - 2.0 * np.pi * t / lap_s
    turn[-1] = turn[0]
    rest = CubicSpline(t, turn, bc_type="periodic")

    def rotation(s: Array) -> Rotation:
        yaw = rest(np.mod(s, lap_s)) + 2.0 * np.pi * s / lap_s
        return Rotation.from_euler("z", yaw[:, None])

    return lambda s: way(np.mod(s, lap_s)), rotation, lap_s


@dataclass
class Meter:
    """CPU time and resident memory of each update."""

    title: str
    times_ms: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    process: psutil.Process = field(default_factory=psutil.Process)

    def start(self) -> None:
        """Begin an update."""
        self._began = time.thread_time()

    def stop(self, note: str = "") -> None:
        """End it; `note` is what the graph had to say."""
        self.times_ms.append((time.thread_time() - self._began) * 1e3)
        self.memory_mb.append(self.process.memory_info().rss / 2**20)
        if note:
            self.notes.append(f"{len(self.times_ms) - 1}: {note}")
        if len(self.times_ms) % 1000 == 0:
            p50, p99 = np.percentile(self.times_ms[-1000:], [50, 99])
            print(f"  {len(self.times_ms)}: p50 {p50:.2f} p99 {p99:.2f} ms, {self.memory_mb[-1]:.0f} MB", flush=True)

    def report(self) -> None:
        """Print percentiles by quarters of the run, and plot all."""
        times, memory = np.array(self.times_ms), np.array(self.memory_mb)
        print(f"{self.title}: {len(times)} updates, {times.sum() / 1e3:.1f} s")
        print("  part         p50 ms   p95 ms   p99 ms   max ms   MB at end")
        parts = {f"quarter {n + 1}": rows for n, rows in enumerate(np.array_split(np.arange(len(times)), 4))}
        for name, rows in (parts | {"all": np.arange(len(times))}).items():
            part = times[rows]
            p50, p95, p99 = np.percentile(part, [50, 95, 99])
            print(f"  {name:11s} {p50:7.2f}  {p95:7.2f}  {p99:7.2f}  {part.max():7.1f}  {memory[rows[-1]]:7.0f}")
        for note in self.notes[:10]:
            print(f"  note at {note}")
        print(f"  notes: {len(self.notes)}; plot: {self._plot(times, memory).relative_to(ROOT)}", flush=True)

    def _plot(self, times: np.ndarray, memory: np.ndarray) -> Path:
        RESULTS.mkdir(parents=True, exist_ok=True)
        figure, (upper, lower) = plt.subplots(2, 1, sharex=True, figsize=(9, 6))
        upper.semilogy(times, ".", markersize=2)
        upper.set_ylabel("CPU time of an update, ms")
        upper.axhline(50.0, color="tab:red", linewidth=0.8)
        upper.set_title(self.title)
        lower.plot(memory)
        lower.set_ylabel("resident memory, MB")
        lower.set_xlabel("keyframe")
        path = RESULTS / f"{self.title.replace(' ', '_').replace(',', '')}.png"
        figure.savefig(path, dpi=120)
        plt.close(figure)
        return path


def hour(coupling: str, minutes: float, loop_every: int, tracks: int) -> None:
    """Feed minutes of a simulated run through PoseGraph; without tracks, tight means the graph alone."""
    world = LapWorld(tracks=tracks, loop_every=loop_every)
    count = round(minutes * 60 * world.keyframe_hz)
    config = GraphConfig(coupling="tight" if coupling == "tight" else "loose")
    if coupling == "tight" and tracks == 0:
        vislam.window.SlidingWindow = lambda *_: window_of_truth(world, count)
    graph = PoseGraph(config, world.noise, MACHINE, STEREO, WindowConfig())
    graph.initialise(world.initial_state())
    meter = Meter(f"{minutes:.0f} min {coupling}, loop every {loop_every}, {tracks} tracks")
    truth = []
    for step in world.steps(count):
        meter.start()
        update = graph.add(step.packet, step.edges)
        meter.stop(update.note)
        truth.append(step.truth)
    meter.report()
    error = graph.poses()[:, :3, 3] - np.stack(truth)[:, :3, 3]
    print(f"  position rmse {np.sqrt(np.mean(np.sum(error**2, axis=1))):.3f} m, {update.details}")


def room(keyframes: int, all_loops: int, tracks: int, seed: int, picture: Path | None) -> None:
    """Drive rounds in one hall with a loop at every keyframe; for comparison also with a factor for every loop."""
    thinned, rest = GraphConfig(), GraphConfig(loop_gain_min=0.0, anchor_after=10**9)
    meters = {"as it is": _rounds("as it is", thinned, keyframes, tracks, seed)}
    if all_loops:
        meters["a factor for every loop"] = _rounds("a factor for every loop", rest, all_loops, tracks, seed)
    if picture is None:
        return
    figure, axes = plt.subplots(figsize=(9, 4))
    for name, meter in meters.items():
        times = np.array(meter.times_ms)
        parts = np.array_split(np.arange(len(times)), max(len(times) // 50, 1))
        middle = [float(np.mean(rows)) for rows in parts]
        (line,) = axes.semilogy(middle, [np.median(times[rows]) for rows in parts], label=f"{name}, median of 50")
        p95 = [np.percentile(times[rows], 95) for rows in parts]
        axes.semilogy(middle, p95, color=line.get_color(), linewidth=0.7, linestyle=":", label="the same, 95 %")
    axes.set_xlabel("keyframe")
    axes.set_ylabel("CPU time of a keyframe in the graph, ms")
    axes.legend()
    figure.savefig(picture, dpi=110, bbox_inches="tight")
    plt.close(figure)


def _rounds(name: str, config: GraphConfig, count: int, tracks: int, seed: int) -> Meter:
    world = LapWorld(seed=seed, tracks=tracks, loop_every=1, motion=cart_round())
    real = vislam.window.SlidingWindow
    if tracks == 0:
        vislam.window.SlidingWindow = lambda *_: window_of_truth(world, count)
    graph = PoseGraph(config, world.noise, MACHINE, STEREO, WindowConfig())
    vislam.window.SlidingWindow = real
    graph.initialise(world.initial_state())
    meter, truth, offered, causal = Meter(f"room, {name}, {count} keyframes, {tracks} tracks"), [], 0, []
    for step in world.steps(count):
        meter.start()
        update = graph.add(step.packet, step.edges)
        meter.stop(update.note)
        graph.take_record()
        truth.append(step.truth[:3, 3])
        causal.append(graph.poses()[-1, :3, 3].copy())
        offered += len(step.edges)
    meter.report()
    redundant = sum("redundant" in report.reason for report in graph.edge_reports())
    quarter = count // 4
    growth_kb = (meter.memory_mb[-1] - meter.memory_mb[quarter]) * 1024 / (count - quarter)
    places = graph.poses()[:, :3, 3]
    T = align_points(places, np.stack(truth))
    live = np.sqrt(np.mean(np.sum((places - truth) ** 2, axis=1)))
    shape = np.sqrt(np.mean(np.sum((places @ T[:3, :3].T + T[:3, 3] - truth) ** 2, axis=1)))
    newest = np.sqrt(np.mean(np.sum((np.stack(causal) - truth) ** 2, axis=1)))
    print(f"  {offered} loops, {redundant} of them redundant; memory grows by {growth_kb:.0f} kB a keyframe")
    print(
        f"  position rmse: newest keyframe {newest:.4f} m, map at the end {live:.4f} m, aligned {shape:.4f} m",
        flush=True,
    )
    return meter


def chain(kilometres: float, step_m: float) -> None:
    """Feed an open-loop chain through PoseGraph without an IMU: 1 mrad and 2 mm per step."""
    rng = np.random.default_rng(3)
    sigmas = np.repeat([0.001, 0.002], 3)
    graph = PoseGraph(
        GraphConfig(coupling="loose", vo_inflation=1.0, vo_floor_deg=0.0, vo_floor_m=0.0),
        None,
        MACHINE,
        STEREO,
        WindowConfig(),
    )
    graph.initialise(None)
    meter = Meter(f"{kilometres:g} km in steps of {step_m:g} m")
    step = transform(np.eye(3), np.array([step_m, 0.0, 0.0]))
    for k in range(round(kilometres * 1e3 / step_m)):
        measured = step @ se3_exp(rng.normal(size=6) * sigmas)
        vo = VoMeasurement(k * 10**9, max(k - 1, 0), measured, np.diag(sigmas**2), True, Tracking.OK, 100)
        packet = packet_of(k, k * 10**9, vo)
        meter.start()
        meter.stop(graph.add(packet).note)
    meter.report()


def g2o(folder: Path, names: list[str]) -> None:
    """Replay files in key order and say how far from the optimum they end."""
    for name in names:
        file, graph = EdgeFile(folder / f"{name}.g2o"), Graph()
        meter = Meter(f"{name} replay")
        file.replay(graph, meter)
        meter.report()
        before = file.chi2(graph.poses())
        graph.optimise()
        after = file.chi2(graph.poses())
        best = BEST_CHI2[name] or file.optimum_from(graph.poses())
        print(f"  chi2 {before:.6g}, in batch {after:.8g}, optimum {best:.8g}", flush=True)


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verb = verbs.add_parser("hour")
    verb.add_argument("--coupling", choices=["loose", "tight"], default="tight")
    verb.add_argument("--minutes", type=float, default=60.0)
    verb.add_argument("--loop-every", type=int, default=10, help="keyframes between loops; 0: none")
    verb.add_argument("--tracks", type=int, default=80, help="0: the graph alone, on odometry or edges from truth")
    verb = verbs.add_parser("room")
    verb.add_argument("--keyframes", type=int, default=7200)
    verb.add_argument("--all-loops", type=int, default=0, help="keyframes to drive with a factor for every loop, too")
    verb.add_argument("--tracks", type=int, default=0, help="0: the graph alone, on edges from truth")
    verb.add_argument("--seed", type=int, default=1)
    verb.add_argument("--picture", type=Path, default=None, help="where the curves go")
    verb = verbs.add_parser("chain")
    verb.add_argument("--kilometres", type=float, default=10.0)
    verb.add_argument("--step", type=float, default=1.0, help="metres")
    verb = verbs.add_parser("g2o")
    verb.add_argument("names", nargs="*", default=list(BEST_CHI2))
    verb.add_argument(
        "--folder", type=Path, default=Path(os.environ.get("VISLAM_DATA", ROOT.parent / "shared/data")) / "g2o"
    )
    asked = parser.parse_args()
    if asked.verb == "hour":
        hour(asked.coupling, asked.minutes, asked.loop_every, asked.tracks)
    elif asked.verb == "room":
        room(asked.keyframes, asked.all_loops, asked.tracks, asked.seed, asked.picture)
    elif asked.verb == "chain":
        chain(asked.kilometres, asked.step)
    else:
        g2o(asked.folder, asked.names)


if __name__ == "__main__":
    main()
