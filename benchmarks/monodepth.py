"""The monocular depth filter against the slambook's loop in C++: the same matches, CPU time, and errors of depth.

    .venv/bin/python benchmarks/monodepth.py
    .venv/bin/python benchmarks/monodepth.py --frames 12 --accuracy-frames 60
    .venv/bin/python benchmarks/monodepth.py --tum PATH --run RUN

A camera (640x480, f 481 px) moves 12 mm per frame over a table at about 2 m; images with noise, exact depth and poses.
The peer, `benchmarks/peers/depth_filter.cpp`, is built with g++ -O3 -march=native: as the book writes it, with vectors,
and with arrays on the stack. Both search the same places, so inverse depths agree to single precision; ours then runs
without its gates. The second part is ours as it is by default but with the Gaussian filter, for accuracy and time.
With `--tum` and a finished RGB-D run of it, depth comes from its grey images and the run's poses alone, and is compared
with the sensor's.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from vislam.config import MonoDepthConfig  # noqa: E402
from vislam.core.camera import Rig  # noqa: E402
from vislam.core.geometry import so3_exp  # noqa: E402
from vislam.core.messages import Frame  # noqa: E402
from vislam.mapping.depth.image import mono_camera  # noqa: E402
from vislam.mapping.depth.mono import DepthFilter, MonoDepth, SeenFrame  # noqa: E402
from vislam.mapping.depth.mono.matching import LEAST_SCORE  # noqa: E402
from vislam.runs.session import Session  # noqa: E402
from vislam.runs.sources import open_source  # noqa: E402
from vislam.trajectory.odometry_keyframe import OdometryKeyframe  # noqa: E402
from worlds.table import camera, frame, motion, pose, view  # noqa: E402

WIDTH = 640
K = camera(WIDTH).K
OURS = replace(MonoDepthConfig(), fusion="gaussian", converged=0.01, threads=1)
PLAIN = replace(
    OURS, uniqueness=1.0, min_gradient=0.0, max_sigma_ratio=np.inf, max_misses=255, min_matches=0, warp_px=None
)  # what the peer does too
PATHS = ("sideways", "rolls", "approaches", "recedes")
PATH_FRAMES, PATH_STEP = 48, 4
ROLL_DEG, NEARER_M = 40.0, 0.8  # in all of a path; the table is at about 2 m
VARIANTS: dict[str, dict[str, Any]] = {
    "derotation": {"warp_px": None, "derotate_deg": 1.5},
    "warp": {},  # as by default
    "warp and derotation": {"derotate_deg": 1.5},
    "derotation, photometric": {"warp_px": None, "derotate_deg": 1.5, "model_sigma_px": 0.5},
    "warp, photometric": {"model_sigma_px": 0.5},
}
STAMP_NS = 8_000_000  # a frame of the recording and one of the session this near are the same


def ours(images: list[NDArray[np.uint8]], config: MonoDepthConfig) -> tuple[DepthFilter, list[float]]:
    """Return the filter after all images and its CPU time for each in ms."""
    DepthFilter(images[0], K, config).update(images[1], motion(1))  # compiles
    filter_, times = DepthFilter(images[0], K, config), []
    for i, image in enumerate(images[1:], 1):
        start = time.process_time()
        filter_.update(image, motion(i))
        times.append(1e3 * (time.process_time() - start))
    return filter_, times


def peer(images: list[NDArray[np.uint8]], flags: list[str], folder: Path) -> tuple[NDArray[np.float32], list[float]]:
    """Return the peer's inverse depth [h, w] after all images and its CPU time for each in ms."""
    source, program = ROOT / "benchmarks" / "peers" / "depth_filter.cpp", folder / "peer"
    subprocess.run(["g++", "-O3", "-march=native", *flags, "-o", program, source], check=True)
    height, width = images[0].shape
    settings = [
        K[0, 0], K[1, 1], K[0, 2], K[1, 2], 1.0 / PLAIN.max_depth_m, 1.0 / PLAIN.min_depth_m, PLAIN.search_sigmas,
        PLAIN.step_px, PLAIN.reach_px, LEAST_SCORE["zncc"], PLAIN.sigma_px, PLAIN.converged,
    ]  # fmt: skip
    data = np.array([width, height, len(images) - 1], np.int32).tobytes() + np.array(settings).tobytes()
    for i in range(1, len(images)):
        T = np.linalg.inv(motion(i))
        data += T[:3, :3].tobytes() + T[:3, 3].tobytes()
    (folder / "in").write_bytes(data + b"".join(image.tobytes() for image in images))
    subprocess.run([program, folder / "in", folder / "out"], check=True)
    raw = (folder / "out").read_bytes()
    times = np.frombuffer(raw[: 8 * (len(images) - 1)])
    rho = np.frombuffer(raw[times.nbytes : times.nbytes + 4 * width * height], np.float32)
    return rho.reshape(height, width), times.tolist()


def compare_speed(images: list[NDArray[np.uint8]]) -> None:
    """Print CPU times of ours and of the peer, run one after the other, and how far they agree."""
    filter_, mine = ours(images, PLAIN)
    print(f"{len(images) - 1} frames, ms of CPU each on one thread")
    print(f"  vislam              {np.mean(mine):8.0f}   {np.round(mine).astype(int).tolist()}")
    if shutil.which("g++") is None:
        print("  no g++: the peer was not built")
        return
    for name, flags in (("book's vectors", []), ("arrays", ["-DARRAYS"])):
        with tempfile.TemporaryDirectory() as folder:
            rho, theirs = peer(images, flags, Path(folder))
        same = np.mean(np.abs(filter_.belief.rho - rho) < 1e-3 * rho)
        print(f"  C++, {name:14s} {np.mean(theirs):8.0f}   {np.round(theirs).astype(int).tolist()}")
        print(f"    {np.sum(theirs) / np.sum(mine):.1f} times ours; {same:.4%} of the inverse depths agree to 0.1 %")


def measure_accuracy(images: list[NDArray[np.uint8]], truth: NDArray[np.float32]) -> None:
    """Print density, error and time of our filter."""
    filter_, times = ours(images, OURS)
    known = filter_.known
    errors_m = np.abs(1.0 / filter_.belief.rho[known] - truth[known])
    depth = filter_.depth_m()
    smooth_m = np.abs(depth - truth)[depth > 0.0]
    print(f"{len(images) - 1} frames, Gaussian filter: {known.mean():.1%} of the pixels known")
    if known.any():
        print(f"  median error {1e3 * np.median(errors_m):.1f} mm, within 5 cm {np.mean(errors_m < 0.05):.1%}")
    if smooth_m.size:
        print(f"  smoothed     {1e3 * np.median(smooth_m):.1f} mm, within 5 cm {np.mean(smooth_m < 0.05):.1%}")
    print(f"  CPU per frame: first {times[0]:.0f} ms, mean {np.mean(times):.0f}, last ten {np.mean(times[-10:]):.0f}")


def path(name: str, i: int) -> NDArray[np.float64]:
    """Return T_world_cam of frame i: of the table's motion, rolled by up to 40 degrees, or going near as well."""
    T = pose(i).copy()
    if name == "rolls":
        T[:3, :3] = T[:3, :3] @ so3_exp(np.array([0.0, 0.0, np.deg2rad(ROLL_DEG) * i / PATH_FRAMES]))
    elif name == "approaches":
        T[:3, 3] += NEARER_M * i / PATH_FRAMES * T[:3, 2]
    elif name == "recedes":
        T[:3, 3] -= NEARER_M * i / PATH_FRAMES * T[:3, 2]
    return T


def compare_variants(seed: int, paths: list[str], chosen: list[str]) -> None:
    """Print what warped patches and photometric sigmas bring, on motions that turn and scale patches."""
    for name in paths:
        views = [view(path(name, i), WIDTH, seed + i) for i in range(0, PATH_FRAMES + 1, PATH_STEP)]
        T_ref_world, truth = np.linalg.inv(path(name, 0)), views[0][1]
        motions = [T_ref_world @ path(name, i) for i in range(0, PATH_FRAMES + 1, PATH_STEP)]
        for variant in chosen:
            config = replace(MonoDepthConfig(), threads=1, **VARIANTS[variant])
            DepthFilter(views[0][0], K, config).update(views[1][0], motions[1])  # compiles
            filter_, start = DepthFilter(views[0][0], K, config), time.process_time()
            for (image, _), T in zip(views[1:], motions[1:], strict=True):
                filter_.update(image, T)
            cpu_ms = 1e3 * (time.process_time() - start) / (len(views) - 1)
            known, rho = filter_.known, filter_.belief.rho
            if not known.any():
                print(f"{name:10s} {variant:22s} no pixel known, CPU {cpu_ms:.0f} ms", flush=True)
                continue
            off = np.abs(1.0 / rho[known] - truth[known]) / truth[known]
            sigmas = np.abs(rho[known] - 1.0 / truth[known]) / np.sqrt(filter_.belief.variance[known])
            print(
                f"{name:10s} {variant:22s} known {known.mean():6.1%}, median error {np.median(off):.3%}, "
                f"off by more than 5 % {np.mean(off > 0.05):.2%}, within 1, 2, 3 sigma "
                f"{' '.join(f'{np.mean(sigmas < n):.1%}' for n in (1, 2, 3))}, CPU {cpu_ms:.0f} ms",
                flush=True,
            )


def compare_with_sensor(source: str, run: Path, config: MonoDepthConfig) -> None:
    """Print how depth from grey images and a run's poses compares with the depth images of the same recording."""
    session, recording = Session(run / "session.db"), open_source(source)
    packets, keyframes = session.packets(), {k.id: k for k in session.keyframes()}
    seen_at = {entry.t_ns: entry for entry in session.frames()}
    stamps = np.array(sorted(seen_at))
    rig = Rig(recording.rig.cameras[:1], recording.rig.T_body_cams[:1])
    stage, ideal = MonoDepth(config, rig), mono_camera(rig, config)
    maps = rig.cameras[0].resampling_maps(np.linalg.inv(ideal.K), np.eye(3), (ideal.width, ideal.height))
    depths: dict[int, NDArray[np.float32]] = {}
    seen: list[SeenFrame] = []
    rows, cpu_ms = [], []
    for value in recording.events():
        if not isinstance(value, Frame):
            continue
        t_ns = int(stamps[np.abs(stamps - value.t_ns).argmin()])
        if abs(t_ns - value.t_ns) > STAMP_NS:
            continue
        packet = next((p for p in packets if p.keyframe.t_ns == t_ns), None)
        T = seen_at[t_ns].T_keyframe_body
        if packet is None:
            if T is not None:
                seen.append(SeenFrame(t_ns, value.images[0], seen_at[t_ns].keyframe_id, T))
            continue
        stored = keyframes[packet.keyframe.id]
        if value.depth_m is not None:
            depths[stored.id] = value.depth_m
        image_only = replace(packet.keyframe, frame=Frame(t_ns, value.index, value.images[:1]))
        start = time.process_time()
        late = stage.add(
            OdometryKeyframe(replace(packet, keyframe=image_only), stored.T_odom_body), stored.T_map_body, seen
        )
        cpu_ms.append(1e3 * (time.process_time() - start))
        seen = []
        if late is not None and late.keyframe_id in depths:
            sensor = cv2.remap(depths[late.keyframe_id], *maps, cv2.INTER_NEAREST)
            both = (late.depth_m > 0.0) & (sensor > 0.3) & (sensor < 5.0)
            rows.append((np.mean(late.depth_m > 0.0), late.depth_m[both] / sensor[both] - 1.0))
    errors = np.concatenate([row[1] for row in rows])
    print(f"{recording.name}: {len(rows)} keyframes with depth of {stage.counters['depth_references']} begun")
    print(f"  density {np.mean([row[0] for row in rows]):.1%}, median relative error {np.median(np.abs(errors)):.2%}")
    print(f"  median deviation {np.median(errors):+.2%}, off by more than 20 %: {np.mean(np.abs(errors) > 0.2):.1%}")
    print(f"  CPU per keyframe {np.mean(cpu_ms):.0f} ms")


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12, help="against the peer")
    parser.add_argument("--accuracy-frames", type=int, default=60)
    parser.add_argument(
        "--variants", nargs="*", choices=list(VARIANTS), help="compare these, none: all; without a peer"
    )
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=PATHS, help="for --variants")
    parser.add_argument("--seed", type=int, default=0, help="of the images' noise, for --variants")
    parser.add_argument("--tum", default="", help="a recording with depth: tum:PATH")
    parser.add_argument("--run", type=Path, help="a finished run of it")
    parser.add_argument("--fusion", choices=("gaussian", "beta"), default="beta", help="for --tum")
    args = parser.parse_args()
    if args.variants is not None and not args.tum:
        compare_variants(args.seed, args.paths, args.variants or list(VARIANTS))
        return
    if args.tum:
        if args.run is None:
            parser.error("--tum needs --run, a finished RGB-D run of the recording, for its poses")
        for variant in args.variants or ["warp"]:
            print(variant)
            compare_with_sensor(args.tum, args.run, replace(MonoDepthConfig(), fusion=args.fusion, **VARIANTS[variant]))
        return
    count = max(args.frames, args.accuracy_frames) + 1
    images, depths = zip(*(frame(i, WIDTH) for i in range(count)), strict=True)
    if args.frames:
        compare_speed(list(images[: args.frames + 1]))
    if args.accuracy_frames:
        measure_accuracy(list(images[: args.accuracy_frames + 1]), depths[0])


if __name__ == "__main__":
    main()
