"""Planar odometry of a cart: joint fit against split at the horizon (Karpov 2026), and what tilt and height cost.

    .venv/bin/python experiments/planar_odometry.py [--source sim:cart-drive] [--height-m 0.6] [--out results/planar]

Every variant is the front half of the pipeline alone, without graph and loops: the chain of visual motions, and the
filter that takes them. Errors are those of motions over 2 m, of the end after the whole way, and of the heading,
against the truth of the recording. Rendering takes most of the time; `vislam simulate cart-drive --out FOLDER` first,
and `--source FOLDER`, does it once for all variants.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from vislam import open_source
from vislam.config import Config, PlanarConfig
from vislam.core.clock import StageClock
from vislam.core.files import write_text
from vislam.core.geometry import interpolate, invert
from vislam.core.messages import Array, NavState, Tracking
from vislam.core.recording import Recording
from vislam.frontend.planar.odometry import PlanarFrontEnd
from vislam.pipeline.front import Front, odometry
from vislam.pipeline.steps import FrontStep
from vislam.trajectory import Trajectory
from vislam.trajectory.consistency import anees

SEGMENT_M = 2.0
EVERY = 5  # frames between segments


@dataclass(frozen=True)
class Errors:
    """How far poses are off."""

    per_segment: float  # of the way, mean over segments
    scale: float  # length of segments over the true one
    yaw_deg_per_segment: float  # mean
    end: float  # of the way, without any alignment but that of the first pose
    end_yaw_deg: float


@dataclass(frozen=True)
class Row:
    """One variant."""

    name: str
    vision: Errors
    filtered: Errors | None
    lost: int
    degraded: int
    cpu_ms: float  # median per frame, of the front end
    cpu_p95_ms: float
    calibration: dict[str, float]
    camera_offset_s: float
    anees: dict[str, float]  # of the filter, per degree of freedom


def follow(recording: Recording, config: Config, name: str) -> tuple[Row, Array, Array]:
    """Run one variant; return its row, the true poses and those of vision [N, 4, 4]."""
    front = Front(config, recording.rig, recording.imu_noise, StageClock())
    assert isinstance(front.frontend, PlanarFrontEnd)
    truth = recording.truth()
    assert truth is not None, "a recording without truth cannot tell errors"
    steps, cpu = drive(front, recording)
    true = np.array([pose_at(truth, step.frame.t_ns) for step in steps])
    T_key, seen = np.eye(4), []
    for step in steps:
        T = step.track.vo.T_keyframe_body
        seen.append(T_key if T is None else T_key @ T)
        if step.track.keyframe is not None:
            T_key = seen[-1]
    filtered = [(T, step.T_odom_body) for T, step in zip(true, steps, strict=True) if step.T_odom_body is not None]
    states = [step.state for step in steps if step.state is not None]
    tracking = [step.track.vo.tracking for step in steps]
    row = Row(
        name, errors(true, np.array(seen)),
        errors(*(np.array(poses) for poses in zip(*filtered, strict=True))) if filtered else None,
        tracking.count(Tracking.LOST), tracking.count(Tracking.DEGRADED), *np.percentile(cpu, (50, 95)).tolist(),
        front.frontend.calibration, front.camera_clock.applied_s, consistency(states, truth),
    )  # fmt: skip
    return row, true, np.array(seen)


def drive(front: Front, recording: Recording) -> tuple[list[FrontStep], Array]:
    """Feed a recording; return what came of every frame, and the CPU time of its front end in ms."""
    cpu = []
    track = front.frontend.track

    def timed(*arguments: object) -> object:
        begin = time.process_time()
        answer = track(*arguments)  # type: ignore[arg-type]
        cpu.append((time.process_time() - begin) * 1e3)
        return answer

    front.frontend.track = timed  # type: ignore[assignment, method-assign]
    steps = list(odometry(front, recording.events()))
    return steps, np.array(cpu)


def pose_at(truth: Trajectory, t_ns: int) -> Array:
    """Return the true pose at a time, interpolated; the ends are held."""
    i = int(np.clip(np.searchsorted(truth.t_ns, t_ns) - 1, 0, len(truth.t_ns) - 2))
    share = (t_ns - truth.t_ns[i]) / (truth.t_ns[i + 1] - truth.t_ns[i])
    return interpolate(truth.T_world_body[i], truth.T_world_body[i + 1], float(np.clip(share, 0.0, 1.0)))


def errors(true: Array, seen: Array) -> Errors:
    """Compare poses [N, 4, 4] by segments and at the end."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))])
    off, scale, yaw = [], [], []
    for i in range(0, len(true), EVERY):
        j = int(np.searchsorted(way, way[i] + SEGMENT_M))
        if j >= len(true):
            break
        a, b = invert(true[i]) @ true[j], invert(seen[i]) @ seen[j]
        off.append(np.linalg.norm((a - b)[:2, 3]) / SEGMENT_M)
        scale.append(np.linalg.norm(b[:3, 3]) / np.linalg.norm(a[:3, 3]))
        yaw.append(abs(heading_deg(a[:3, :3].T @ b[:3, :3])))
    last = true[0] @ invert(seen[0]) @ seen[-1]
    end = float(np.linalg.norm((last - true[-1])[:2, 3]) / (way[-1] if off else np.nan))
    end_yaw = heading_deg(true[-1][:3, :3].T @ last[:3, :3])
    means = (float(np.mean(values or [np.nan])) for values in (off, scale, yaw))  # NaN: shorter than a segment
    return Errors(*means, end, end_yaw)


def heading_deg(R: Array) -> float:
    """Return the heading of a rotation [3, 3]."""
    return float(np.rad2deg(np.arctan2(R[1, 0], R[0, 0])))


def consistency(states: Sequence[NavState], truth: Trajectory) -> dict[str, float]:
    """Return the filter's average NEES per degree of freedom; 1 when its covariance tells the truth."""
    return {} if len(states) < 2 else {name: found.mean for name, found in anees(states, truth).items()}


def variants(height_m: float) -> list[tuple[str, PlanarConfig]]:
    """Return what is compared."""
    joint = PlanarConfig(height_m=height_m)
    split = replace(joint, method="split")
    return [
        ("joint fit", joint),
        ("split at the horizon (Karpov 2026)", split),
        ("joint, height told 1 % too low", replace(joint, height_m=0.99 * height_m)),
        ("joint, springs ignored", replace(joint, vibration_s=1e-3, vibration_known_deg=0.001, heave_m=1e-5)),
    ]


def turned(joint: PlanarConfig, tilt_deg: float, roll_deg: float, off_deg: float) -> list[tuple[str, PlanarConfig]]:
    """Return both methods with a camera that is tilted by `off_deg` more than they are told."""
    told = replace(joint, tilt_deg=tilt_deg - off_deg, roll_deg=roll_deg)
    return [
        (f"joint, tilt told {off_deg} deg too low", told),
        ("the same, split at the horizon", replace(told, method="split")),
    ]


def table(rows: Sequence[Row]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "| variant | error per 2 m | scale | yaw per 2 m | end error | yaw at the end | filter: end, per 2 m | lost "
        "| CPU ms p50 / p95 |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        v, f = row.vision, row.filtered
        by_filter = "–" if f is None else f"{f.end:.2%}, {f.per_segment:.2%}"
        lines.append(
            f"| {row.name} | {v.per_segment:.2%} | {v.scale:.4f} | {v.yaw_deg_per_segment:.3f}° | {v.end:.2%} | "
            f"{v.end_yaw_deg:+.2f}° | {by_filter} | {row.lost} | {row.cpu_ms:.1f} / {row.cpu_p95_ms:.1f} |"
        )
    return "\n".join(lines) + "\n"


def draw(path: Path, true: Array, seen: dict[str, Array]) -> None:
    """Draw where each variant thinks the cart was, and how its error grows."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))])
    left.plot(true[:, 0, 3], true[:, 1, 3], color="0.6", linewidth=3, label="truth")
    for name, poses in seen.items():
        placed = np.einsum("ij,njk->nik", true[0] @ invert(poses[0]), poses)
        (line,) = left.plot(placed[:, 0, 3], placed[:, 1, 3], linewidth=1, label=name)
        off = np.linalg.norm((placed - true)[:, :2, 3], axis=1)
        right.plot(way, 100 * off, linewidth=1, color=line.get_color(), label=name)
    left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="vision alone, no loops")
    left.legend(fontsize=7, loc="center")
    right.set(xlabel="way [m]", ylabel="error of position [cm]", yscale="symlog", ylim=(0, None))
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    """Run all variants on one recording and write table, picture and numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="sim:cart-drive", help="recording with truth, of one camera and an IMU")
    parser.add_argument("--height-m", type=float, default=0.6, help="of the camera above the floor")
    parser.add_argument("--out", type=Path, default=Path("results/planar_odometry"))
    arguments = parser.parse_args()
    recording = open_source(arguments.source)
    chosen = variants(arguments.height_m)
    usual = Config()
    mount = PlanarFrontEnd(replace(usual.frontend, mode="planar", planar=chosen[0][1]), recording.rig, usual.seed).mount
    chosen += turned(chosen[0][1], mount.tilt_deg, mount.roll_deg, 0.5)
    rows, seen, true = [], {}, np.empty((0, 4, 4))
    for name, planar in chosen:
        config = replace(usual, frontend=replace(usual.frontend, mode="planar", planar=planar))
        row, true, seen[name] = follow(recording, config, name)
        rows.append(row)
        print(table([row]).splitlines()[-1], flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_text(arguments.out / "table.md", table(rows))
    write_text(arguments.out / "rows.json", json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    draw(arguments.out / "paths.png", true, {name: seen[name] for name, _ in chosen[:2]})
    print(f"{arguments.out}/table.md, rows.json, paths.png")


if __name__ == "__main__":
    main()
