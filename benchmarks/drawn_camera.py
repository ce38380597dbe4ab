"""What does a drawn frame cost, and how far is its blur from brute force: sharp images averaged over the exposure?

    .venv/bin/python benchmarks/drawn_camera.py
    .venv/bin/python benchmarks/drawn_camera.py --world handheld-room --exposure-s 0.02 --width 320
    .venv/bin/python benchmarks/drawn_camera.py --record

Frames spread over a world are rendered, sensed and written as PNG as `vislam simulate` does; each stage's CPU time is
the least of some rounds, compilation and painting not counted. Brute force renders `--moments` sharp images per frame
and adds up their light; both take turns. The difference is the mean over all pixels, in grey levels, without noise. At
the end ten seconds are recorded by `--workers` threads: frames a second, fewer on a loaded machine (cores tells).
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import cv2  # noqa: E402
import numpy as np  # noqa: E402

import results  # noqa: E402
from vislam.core.messages import Array, Frame, ImageF32  # noqa: E402
from vislam.datasets.recorder import Recorder, record  # noqa: E402
from vislam.sim import Simulation, open_world  # noqa: E402
from vislam.sim.scene import Renderer  # noqa: E402
from vislam.sim.sensing import Imager  # noqa: E402

cv2.setNumThreads(1)
_RECORDED_S = 10.0
MARGIN = 0.05  # of the frames are left out at both ends, where the motion rests


T = TypeVar("T")


def timed(times: dict[str, float], stage: str, work: Callable[[], T]) -> T:
    """Return what `work` returns; keeps the least CPU time of each stage."""
    begin = time.process_time()
    done = work()
    times[stage] = min(times.get(stage, np.inf), time.process_time() - begin)
    return done


def brute_force(world: Simulation, renderer: Renderer, t_s: float, moments: int) -> ImageF32:
    """Return the light [H, W, 3] of many sharp images over the exposure, averaged as the renderer averages."""
    light = np.zeros((renderer.camera.height, renderer.camera.width, 3), np.float32)
    exposure_s = world._exposure_s
    for moment in (np.arange(moments) + 0.5) / moments - 0.5:
        pose = world.spline.at(np.array([t_s + exposure_s * moment])).T_world_body[0] @ world.rig.T_body_cams[0]
        light += renderer.render(world.scene, pose)[0] ** 2
    return np.sqrt(light / np.float32(moments))


def grey(light: ImageF32) -> Array:
    """Return grey levels [H, W] that are not rounded."""
    return np.asarray(cv2.cvtColor(light, cv2.COLOR_BGR2GRAY), np.float64)


def measure(args: argparse.Namespace, folder: Path) -> None:
    """Print the table."""
    options = {"image_width_px": args.width, "exposure_changes": False}
    if args.exposure_s is not None:
        options["exposure_s"] = args.exposure_s
    world = open_world(args.world, rig="mono", **options)
    renderer, camera = Renderer(world.rig.cameras[0]), world.rig.cameras[0]
    imager, rng = Imager(camera.width, camera.height, noisy=True), np.random.default_rng(0)
    indices = np.linspace(MARGIN * world.frame_count, (1.0 - MARGIN) * world.frame_count, args.frames).astype(int)
    world.render(0)  # paints and compiles
    recorder = Recorder(folder / "recording", world.rig, None)
    frames: list[dict[str, float]] = []
    differences = []
    for index in indices:
        times: dict[str, float] = {}
        t_s = float(world._frame_s[index])
        for k in range(args.rounds):
            light, _ = timed(times, "render", lambda t_s=t_s: world._see(renderer, world.rig.T_body_cams[0], t_s))
            exact = timed(times, "brute force", lambda t_s=t_s: brute_force(world, renderer, t_s, args.moments))
            picture = timed(times, "noise", lambda light=light: imager.sense(light, 1.0, rng))
            image = timed(times, "grey", lambda picture=picture: cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
            frame = Frame(int(1e9 * t_s) + k, int(index), (image,), picture, None)
            timed(times, "write", lambda frame=frame: recorder.write(frame))
        frames.append(times)
        differences.append(np.abs(grey(light) - grey(exact)).mean())
    mean_ms = {stage: 1e3 * float(np.mean([times[stage] for times in frames])) for stage in frames[0]}
    brute_ms = mean_ms.pop("brute force")
    print(
        f"{args.world}, {camera.width} x {camera.height}, exposure {1e3 * world._exposure_s:.0f} ms; CPU ms per frame"
    )
    for stage, ms in mean_ms.items():
        print(f"{stage:>12} {ms:8.1f}")
    print(f"{'all':>12} {sum(mean_ms.values()):8.1f}")
    ratio = brute_ms / mean_ms["render"]
    print(f"{'brute force':>12} {brute_ms:8.1f}   {args.moments} moments, {ratio:.1f} times as long as render")
    print(f"difference: mean {np.mean(differences):.3f} grey levels, {max(differences):.3f} in the worst frame")
    if args.record:
        setting = f"{args.world}, {args.width} px"
        results.record("drawn_camera", {f"{setting}: {stage}": ms for stage, ms in mean_ms.items()})


def keep_up(args: argparse.Namespace, folder: Path) -> None:
    """Print how many frames a second are recorded by several threads, once the world is painted."""
    options = {"image_width_px": args.width, "exposure_s": args.exposure_s, "workers": args.workers}
    world = open_world(args.world, duration_s=_RECORDED_S, **options)
    world.render(0)
    begin_s, begin_cpu_s = time.perf_counter(), time.process_time()
    frames = record(world, folder / "whole").counts["frames"]
    wall_s, cpu_s = time.perf_counter() - begin_s, time.process_time() - begin_cpu_s
    print(
        f"recorded: {frames} frames in {wall_s:.1f} s by {args.workers} threads, {frames / wall_s:.1f} a second; "
        f"{1e3 * cpu_s / frames:.0f} ms of CPU each, {cpu_s / wall_s:.2f} cores"
    )


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="cart-drive")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--exposure-s", type=float, help="None: the world's own")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--moments", type=int, default=16)
    parser.add_argument("--workers", type=int, default=2, help="threads that render what is recorded")
    parser.add_argument("--record", action="store_true", help="keep the times in benchmarks/results")
    with tempfile.TemporaryDirectory() as folder:
        asked = parser.parse_args()
        measure(asked, Path(folder))
        keep_up(asked, Path(folder))


if __name__ == "__main__":
    main()
