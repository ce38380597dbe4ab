"""The occupancy map against OctoMap C++: the same points, all four configurations, CPU time, memory and files.

    .venv/bin/python benchmarks/octomap.py
    .venv/bin/python benchmarks/octomap.py --source tum:PATH --frames 30 --every 15

The peer is built from Debian's liboctomap-dev (`apt-get install liboctomap-dev g++`): one thread, -O3. A scan is all
valid pixels of a depth image, placed by the true poses. In each repeat the two run one after the other, so that both
meet the same load; the fastest repeat of each counts, in CPU time per frame. Both write `.ot` and `.bt`, which must not
differ in a byte.
"""

from __future__ import annotations

import argparse
import json
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
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

import results  # noqa: E402
from vislam.config import MapConfig  # noqa: E402
from vislam.core.messages import Array, Frame  # noqa: E402
from vislam.core.recording import Recording  # noqa: E402
from vislam.mapping.depth.image import filter_depth, rgbd_view, scan_points  # noqa: E402
from vislam.mapping.octree.occupancy import Octree  # noqa: E402
from vislam.mapping.octree.octomap_io import encode_bt, encode_ot  # noqa: E402
from vislam.runs.sources import open_source  # noqa: E402

MAX_RANGE_M = 4.0
CONFIGURATIONS = [(r, i) for r in (0.05, 0.02) for i in ("full", "discretised")]
TARGETS = {(0.02, "discretised"): 10.0}  # times as fast as OctoMap; 3 elsewhere
FRAME_TARGETS_MS = {0.05: 4.0, 0.02: 15.0}  # per 640x480 frame, discretised

PEER = r"""
#include <octomap/octomap.h>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <string>
#include <vector>
static double cpu() { timespec t; clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t); return t.tv_sec + 1e-9 * t.tv_nsec; }
int main(int argc, char** argv) {
  octomap::OcTree tree(atof(argv[2]));
  bool discretise = std::string(argv[3]) == "discretised";
  double range = atof(argv[4]), seconds = 0;
  std::ifstream in(argv[1], std::ios::binary);
  int count;
  while (in.read((char*)&count, 4)) {
    float origin[3];
    in.read((char*)origin, 12);
    std::vector<float> p(3 * size_t(count));
    in.read((char*)p.data(), 4 * p.size());
    octomap::Pointcloud cloud;
    cloud.reserve(count);
    for (int i = 0; i < count; i++) cloud.push_back(p[3 * i], p[3 * i + 1], p[3 * i + 2]);
    double begin = cpu();
    tree.insertPointCloud(cloud, octomap::point3d(origin[0], origin[1], origin[2]), range, false, discretise);
    seconds += cpu() - begin;
  }
  size_t nodes = tree.size(), bytes = tree.memoryUsage();
  tree.write(std::string(argv[5]) + ".ot");
  tree.writeBinary(std::string(argv[5]) + ".bt");
  printf("{\"seconds\": %.9g, \"bytes\": %zu, \"nodes\": %zu}\n", seconds, bytes, nodes);
}
"""


def build_peer(folder: Path) -> Path:
    """Return the compiled peer; leaves with what to install when that is not possible."""
    source, program = folder / "peer.cpp", folder / "peer"
    source.write_text(PEER)
    if shutil.which("g++") is None:
        sys.exit("no g++; apt-get install g++ liboctomap-dev")
    command = ["g++", "-O3", "-DNDEBUG", str(source), "-o", str(program), "-loctomap", "-loctomath"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"the peer cannot be built; apt-get install liboctomap-dev\n{done.stderr[-2000:]}")
    return program


def depth_frames(recording: Recording, count: int, every: int) -> list[tuple[Frame, Array]]:
    """Return up to `count` frames with depth, `every` apart, and their true body poses."""
    truth = recording.truth()
    if truth is None or not recording.rig.has_depth:
        sys.exit(f"{recording.name} lacks depth or true poses")
    frames = []
    events = recording.events()
    for event in events:
        if isinstance(event, Frame) and event.depth_m is not None and event.index % every == 0:
            if truth.t_ns[0] <= event.t_ns <= truth.t_ns[-1]:
                frames.append((event, truth.at(event.t_ns)))
            if len(frames) == count:
                break
    return frames


def scans_of(recording: Recording, frames: list[tuple[Frame, Array]]) -> list[tuple[NDArray[np.float32], Array]]:
    """Return all valid pixels of each frame as points [N, 3] in the map frame, and the camera's position."""
    config = replace(MapConfig(), pixel_step=1, max_range_m=MAX_RANGE_M, edge_px=0, speckle_pixels=0)
    view = rgbd_view(recording.rig, config)
    scans = []
    for frame, T in frames:
        depth = filter_depth(frame.depth_m, 1, view, config)
        scans.append(scan_points(depth, view, T, 0.05))
    return scans


def ours(scans: list[tuple[NDArray[np.float32], Array]], resolution: float, insertion: Any) -> tuple[float, Octree]:
    """Return CPU seconds of all insertions, and the map."""
    grid = Octree(resolution)
    seconds = 0.0
    for points, origin in scans:
        begin = time.process_time()
        grid.insert(points, origin, MAX_RANGE_M, insertion)
        seconds += time.process_time() - begin
    return seconds, grid


def compare(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Run both in all configurations; return one row for each."""
    recording = open_source(args.source)
    scans = scans_of(recording, depth_frames(recording, args.frames, args.every))
    points = sum(len(p) for p, _ in scans)
    print(f"{recording.name}: {len(scans)} frames, {points / len(scans):.0f} points per frame")
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        peer = build_peer(folder)
        with (folder / "scans").open("wb") as file:
            for cloud, origin in scans:
                file.write(np.int32(len(cloud)).tobytes() + origin.astype(np.float32).tobytes() + cloud.tobytes())
        ours(scans[:1], 0.1, "full"), ours(scans[:1], 0.1, "discretised")  # compilation does not count
        for resolution, insertion in CONFIGURATIONS:
            theirs_s, ours_s = [], []
            for _ in range(args.repeats):
                command = [peer, folder / "scans", resolution, insertion, MAX_RANGE_M, folder / "tree"]
                done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=True)
                answer = json.loads(done.stdout.splitlines()[-1])
                theirs_s.append(answer["seconds"])
                seconds, grid = ours(scans, resolution, insertion)
                ours_s.append(seconds)
            same = encode_ot(grid.leaves()) == (folder / "tree.ot").read_bytes()
            same &= encode_bt(grid.max_likelihood_leaves()) == (folder / "tree.bt").read_bytes()
            rows.append(
                {
                    "resolution_m": resolution, "insertion": insertion, "files_equal": same,
                    "octomap_ms": 1e3 * min(theirs_s) / len(scans), "ours_ms": 1e3 * min(ours_s) / len(scans),
                    "ratio": min(theirs_s) / min(ours_s), "octomap_mb": answer["bytes"] / 1e6,
                    "ours_mb": grid.nbytes / 1e6, "nodes": answer["nodes"],
                }
            )  # fmt: skip
            print_row(rows[-1])
    return rows


def print_row(row: dict[str, Any]) -> None:
    """Print what one configuration took, beside its targets."""
    key = (row["resolution_m"], row["insertion"])
    wanted = f"{TARGETS.get(key, 3.0):g}x" + (f", {FRAME_TARGETS_MS[key[0]]:g} ms" if key[1] == "discretised" else "")
    print(
        f"| {key[0]:g} m {key[1]} | {row['octomap_ms']:.1f} | {row['ours_ms']:.1f} | {row['ratio']:.1f} ({wanted}) | "
        f"{row['octomap_mb']:.1f} | {row['ours_mb']:.1f} | {row['nodes']} | {'yes' if row['files_equal'] else 'NO'} |",
        flush=True,
    )


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["compare"], nargs="?", default="compare")
    parser.add_argument("--source", default="sim:handheld-room,camera_hz=1", help="a recording with depth and truth")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--every", type=int, default=1, help="frames between those that are taken")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--record", action="store_true", help="keep the times in benchmarks/results")
    args = parser.parse_args()
    print("| configuration | OctoMap ms | ours ms | ratio (target) | OctoMap MB | ours MB | nodes | files equal |")
    rows = compare(args)
    if args.record:
        label = f"{args.source.split(',')[0].split('/')[-1]}, {args.frames} frames"
        times = {f"{label}, {row['resolution_m']:g} m {row['insertion']}": row["ours_ms"] for row in rows}
        results.record("octomap", times)


if __name__ == "__main__":
    main()
