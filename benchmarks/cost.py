"""Has a run become dearer? CPU per frame of short simulated runs, stage by stage, beside what it was.

    ./run cost                  # the same as: .venv/bin/python benchmarks/cost.py
    ./run cost --record         # and keep it for this revision; commit the file to make it what later ones are held to

A simulated room, drawn once, goes through the pipeline three times with two cameras and three times with one; of each
number the least counts. A reference that has nothing to do with vislam (Lucas-Kanade, decoding, dense algebra, small
arrays in Python) is timed in the same process between the runs: CPU times are compared as multiples of it, so that
another machine, or one whose clock is lowered by its neighbours, can be compared with too. What takes more than
--factor times as much as in the last record, or as the least so far, is told; only beyond --limit it is an error.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is imported

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from benchmarks import results  # noqa: E402
from vislam.config import from_data  # noqa: E402
from vislam.core.errors import VislamError  # noqa: E402
from vislam.core.recording import Recording  # noqa: E402
from vislam.datasets import open_dataset  # noqa: E402
from vislam.datasets.recorder import record  # noqa: E402
from vislam.runs import execute  # noqa: E402
from vislam.runs.folder import prepare  # noqa: E402
from vislam.runs.sources import open_source  # noqa: E402

SOURCE = "sim:handheld-room,rig=stereo,image_width_px=320,camera_hz=10,exposure_s=0,duration_s=8"
RIGS = ("stereo", "mono")
STAGES = (
    "decode",
    "track",
    "ekf",
    "ekf predict",
    "loop",
    "graph",
    "map",
    "pictures",
)  # those that take enough to repeat
REPEATS = 3
REFERENCES = 3  # before each run: a sixth of a second each
FACTOR, LIMIT = 1.15, 2.0


def reference_s() -> float:
    """Return the CPU seconds of work that no change of vislam can change."""
    begun_s = time.process_time()
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (480, 640), dtype=np.uint8), (0, 0), 2.0)
    moved = np.roll(image, 3, axis=1)
    encoded = cv2.imencode(".png", image)[1]
    corners = cv2.goodFeaturesToTrack(image, 300, 0.01, 10)
    matrix = rng.normal(size=(150, 150)) + 150.0 * np.eye(150)
    for _ in range(20):
        cv2.calcOpticalFlowPyrLK(image, moved, corners, None)
        cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
        np.linalg.solve(matrix, matrix)
        small = np.eye(6)
        for k in range(500):
            small = small @ small.T / (1.0 + k)
    return time.process_time() - begun_s


def run_once(recording: Recording, rig: str, out: Path) -> dict[str, Any]:
    """Run a recording into a new folder; return what it cost."""
    config = from_data({"frontend": {"mode": rig}, "view": {"enabled": False}}, "benchmark")
    prepare(out, overwrite=False)
    return dict(execute(recording, config, out, SOURCE, ["benchmarks/cost.py"])["cost"])


def measured(work: Path) -> Iterator[tuple[str, float]]:
    """Yield metrics of all runs with their CPU milliseconds, among them "reference"."""
    record(open_source(SOURCE, 0), work / "room")
    for repeat in range(REPEATS):
        for rig in RIGS:
            for _ in range(REFERENCES):
                yield "reference", 1e3 * reference_s()
            cost = run_once(open_dataset(f"euroc:{work / 'room'}"), rig, work / f"{rig}{repeat}")
            yield f"{rig}: frame", cost["cpu_ms_per_frame"]
            for stage in STAGES:
                if stage in cost["stages_cpu_ms_per_frame"]:
                    yield f"{rig}: {stage}", cost["stages_cpu_ms_per_frame"][stage]


def main() -> int:
    """Measure, compare, and keep it if that is asked for; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="write benchmarks/results/cost/REVISION.json")
    parser.add_argument("--factor", type=float, default=FACTOR, help="of CPU time that is still no change")
    parser.add_argument("--limit", type=float, default=LIMIT, help="beyond which the exit code is 1")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    least: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as work:
        for metric, cpu_ms in measured(Path(work)):
            least[metric] = min(cpu_ms, least.get(metric, cpu_ms))
    reference_ms = least.pop("reference")
    print(f"reference: {reference_ms:.0f} ms of CPU; whole benchmark {time.process_time():.0f} s; CPU per frame in ms:")
    for rig in RIGS:
        own = {name.removeprefix(f"{rig}: "): ms for name, ms in least.items() if name.startswith(rig)}
        print(f"  {rig}: " + ", ".join(f"{name} {ms:.2f}" for name, ms in own.items()))
    try:
        now = results.result(least, reference_ms)
        is_fine = results.told("cost", [*results.history("cost"), now], args.factor, args.limit)
        if args.record:
            print(results.record("cost", least, reference_ms=reference_ms))
    except VislamError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0 if is_fine else 1


if __name__ == "__main__":
    sys.exit(main())
