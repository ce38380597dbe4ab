"""What a run makes of a stretch in the dark, with and without placing frames by depth alone.

    .venv/bin/python experiments/depth_alone.py
    .venv/bin/python experiments/depth_alone.py --source tum:FOLDER --dark 1 2 4 --begin 4 --length 10
    .venv/bin/python experiments/depth_alone.py --imu

The images of a recording are made black from `--begin` on, for so many seconds; depth stays as it is. `placed` is the
share of the dark frames that have a pose relative to their keyframe, `drift` how far the keyframes just before and
after the stretch are off relative to each other in the final graph, `ATE` that of all keyframes (SE(3)). `NEES` is
the mean of e' P^-1 e over the frames that depth placed, six when the covariance is right; "frames by depth off by"
says how far they are off from their keyframes (median).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402

from vislam.config import Config  # noqa: E402
from vislam.core.geometry import align_points, invert, se3_log, transform_points  # noqa: E402
from vislam.core.messages import Array, Frame, Tracking  # noqa: E402
from vislam.core.recording import Recording  # noqa: E402
from vislam.pipeline.steps import Step  # noqa: E402
from vislam.runs.sources import open_source  # noqa: E402
from vislam.slam import Slam  # noqa: E402
from vislam.trajectory import Trajectory  # noqa: E402

SOURCES = (
    "sim:handheld-room,camera_hz=15,image_width_px=480",
    "sim:corridor-loop,rig=rgbd,camera_hz=15,image_width_px=480",
)
BLACK = 8  # grey level


@dataclass(frozen=True)
class Outcome:
    """What came out of one run."""

    placed: float
    submaps: int
    drift_m: float
    drift_deg: float
    ate_m: float
    off_m: float
    off_deg: float
    nees: float


def values(recording: Recording, begin_s: float, dark_s: float, length_s: float, imu: bool) -> Iterator[object]:
    """Yield a recording up to a time with black images in the stretch."""
    first: int | None = None
    for value in recording.events():
        if not isinstance(value, Frame):
            if imu:
                yield value
            continue
        first = value.t_ns if first is None else first
        since_s = (value.t_ns - first) * 1e-9
        if since_s > length_s:
            return
        if begin_s <= since_s < begin_s + dark_s:
            yield replace(value, images=tuple(np.full_like(image, BLACK) for image in value.images))
        else:
            yield value


def outcome(recording: Recording, alone: bool, begin_s: float, dark_s: float, length_s: float, imu: bool) -> Outcome:
    """Run, and compare with the truth."""
    config = Config()
    front = replace(config.frontend, depth_alone=alone, mode="rgbd")
    config = replace(config, frontend=front, map=replace(config.map, enabled=False))
    slam = Slam(config, recording.rig, recording.imu_noise if imu else None)
    steps: list[Step] = []
    for value in values(recording, begin_s, dark_s, length_s, imu):
        steps += slam.feed(value)  # type: ignore[arg-type]
    finish = slam.finish()
    steps += finish.steps
    truth = recording.truth()
    assert truth is not None and finish.update is not None
    first = steps[0].front.frame.t_ns
    begin, end = first + round(begin_s * 1e9), first + round((begin_s + dark_s) * 1e9)
    keyframes = {s.front.track.keyframe.id: s.front.frame.t_ns for s in steps if s.front.track.keyframe is not None}
    errors, nees = of_frames(steps, keyframes, truth)
    dark = [s.front.track for s in steps if begin <= s.front.frame.t_ns < end]
    final = {int(i): T for i, T in zip(finish.update.ids, finish.update.T_map_body, strict=True) if int(i) in keyframes}
    ids = sorted(final)
    true = dict(zip(ids, truth.at(np.array([keyframes[i] for i in ids])), strict=True))
    before = max(i for i in ids if keyframes[i] < begin)
    after = min(i for i in ids if keyframes[i] >= end)
    drift = se3_log(invert(invert(final[before]) @ final[after]) @ invert(true[before]) @ true[after])
    found, there = (np.array([poses[i][:3, 3] for i in ids]) for poses in (final, true))
    left = transform_points(align_points(found, there), found) - there
    return Outcome(
        float(np.mean([t.vo.tracking is not Tracking.LOST for t in dark])),
        slam.front.watch.counters["submaps"],
        float(np.linalg.norm(drift[3:])),
        float(np.rad2deg(np.linalg.norm(drift[:3]))),
        float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
        float(np.median(np.linalg.norm(errors[:, 3:], axis=1))) if len(errors) else np.nan,
        float(np.rad2deg(np.median(np.linalg.norm(errors[:, :3], axis=1)))) if len(errors) else np.nan,
        float(np.mean(nees)) if nees else np.nan,
    )


def of_frames(steps: list[Step], keyframes: dict[int, int], truth: Trajectory) -> tuple[Array, list[float]]:
    """Return the errors [N, 6] of frames that depth placed in their keyframes, and their NEES."""
    errors, nees = [], []
    for step in steps:
        vo = step.front.track.vo
        if not step.front.track.by_depth or vo.T_keyframe_body is None:
            continue
        key, now = truth.at(np.array([keyframes[vo.keyframe_id], vo.t_ns]))
        errors.append(se3_log(invert(vo.T_keyframe_body) @ invert(key) @ now))
        nees.append(float(errors[-1] @ np.linalg.solve(vo.covariance, errors[-1])))
    return np.array(errors).reshape(-1, 6), nees


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", nargs="+", default=SOURCES)
    parser.add_argument("--dark", nargs="+", type=float, default=(1.0, 3.0), help="lengths of the stretch in seconds")
    parser.add_argument("--begin", type=float, default=5.0, help="seconds after the first frame")
    parser.add_argument("--length", type=float, default=10.0, help="seconds of the recording")
    parser.add_argument("--imu", action="store_true", help="with the recording's inertial data")
    args = parser.parse_args()
    print("| recording | dark | by depth | placed | submaps | drift | ATE | frames by depth off by | NEES |")
    print("|---|---:|---|---:|---:|---:|---:|---:|---:|")
    for source in args.source:
        for dark_s in args.dark:
            for alone in (False, True):
                recording = open_source(source)
                o = outcome(recording, alone, args.begin, dark_s, args.length, args.imu)
                print(
                    f"| {recording.name} | {dark_s:g} s | {'yes' if alone else 'no'} | {o.placed:.0%} | {o.submaps} "
                    f"| {o.drift_m:.3f} m, {o.drift_deg:.2f}° | {o.ate_m:.3f} m "
                    f"| {1e3 * o.off_m:.1f} mm, {o.off_deg:.2f}° | {o.nees:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
