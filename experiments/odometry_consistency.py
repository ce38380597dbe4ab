"""Are motions of visual odometry as sure as they claim? Errors against truth by age since the keyframe.

    .venv/bin/python experiments/odometry_consistency.py SOURCE ... [--truth-mm 1] [--truth-deg 0.05]

Only the front end runs, without an IMU. The clocks of truth are fitted first, that of its turns and that of its ways
apart (motion capture and total stations have their own), by the motions themselves, within 30 ms. What truth itself is
wrong by (1 sigma of one axis of one pose) joins the covariance of the motion, at both ends. NEES is per degree of
freedom: 1 is honest, more is too sure.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from vislam import open_source
from vislam.config import Config
from vislam.core.messages import Array, Frame
from vislam.core.recording import Recording
from vislam.frontend import make_frontend
from vislam.trajectory import Trajectory

AGES_S = (0.0, 0.075, 0.2, 0.5, 1.0, np.inf)
LATEST_S = 0.03  # that a truth may be
TURN_RAD, WAY_M = 0.002, 0.004  # errors beyond which a motion counts less in the fit of the clocks


@dataclass(frozen=True)
class Motions:
    """Measured motions since keyframes."""

    key_ns: Array  # [N]
    t_ns: Array  # [N]
    T_key_body: Array  # [N, 4, 4]
    covariance: Array  # [N, 6, 6] of the right perturbation, rotation first


def measured(recording: Recording, config: Config) -> Motions:
    """Run the front end over a recording."""
    front_end = make_frontend(config.frontend, recording.rig, config.seed)
    keyframes: dict[int, int] = {}
    rows = []
    for frame in recording.events():
        if not isinstance(frame, Frame):
            continue
        result = front_end.track(frame, None)
        vo = result.vo
        if vo.T_keyframe_body is not None and vo.has_scale and vo.keyframe_id in keyframes:
            rows.append((keyframes[vo.keyframe_id], vo.t_ns, vo.T_keyframe_body, vo.covariance))
        if result.keyframe is not None:
            keyframes[result.keyframe.id] = result.keyframe.t_ns
    if not rows:
        raise SystemExit(f"{recording.name}: no metric motions; one camera tells none, use stereo or depth")
    key_ns, t_ns, poses, covariances = zip(*rows, strict=True)
    return Motions(np.array(key_ns), np.array(t_ns), np.array(poses), np.array(covariances))


def within(motions: Motions, truth: Trajectory) -> Motions:
    """Return the motions that truth covers, whatever its clock is off."""
    margin_ns = LATEST_S * 1e9
    inside = (motions.key_ns > truth.t_ns[0] + margin_ns) & (motions.t_ns < truth.t_ns[-1] - margin_ns)
    return Motions(*(values[inside] for values in vars(motions).values()))


def errors(motions: Motions, truth: Trajectory, turns_late_s: float = 0.0, ways_late_s: float = 0.0) -> Array:
    """Return the errors [N, 6] of motions, in the body: rotation vectors in rad, then metres."""

    def true(t_ns: Array) -> Array:
        poses = truth.at(t_ns + round(turns_late_s * 1e9))
        poses[:, :3, 3] = truth.at(t_ns + round(ways_late_s * 1e9))[:, :3, 3]
        return poses

    off = np.linalg.inv(motions.T_key_body) @ np.linalg.inv(true(motions.key_ns)) @ true(motions.t_ns)
    return np.column_stack([Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]])


def lateness(motions: Motions, truth: Trajectory) -> tuple[float, float]:
    """Return by how much truth is late in its turns and in its ways, in seconds, by a robust fit."""

    def cost(late_ms: Array) -> float:
        late_s = np.clip(late_ms * 1e-3, -LATEST_S, LATEST_S)
        scaled = errors(motions, truth, *late_s) / np.repeat([TURN_RAD, WAY_M], 3)
        return float(np.sum(np.sqrt(1.0 + scaled**2)))

    found = minimize(cost, np.zeros(2), method="Nelder-Mead", options={"initial_simplex": [[0, 0], [8, 0], [0, 8]]})
    turns_s, ways_s = np.clip(found.x * 1e-3, -LATEST_S, LATEST_S).tolist()
    return turns_s, ways_s


def nees(off: Array, covariance: Array, truth_rad: float, truth_m: float) -> Array:
    """Return the NEES [N, 2] per degree of freedom of rotation and translation, truth's own noise counted twice."""
    columns = []
    for block, sigma in ((slice(0, 3), truth_rad), (slice(3, 6), truth_m)):
        P = covariance[:, block, block] + 2.0 * sigma**2 * np.eye(3)
        solved = np.linalg.solve(P, off[:, block, None])[:, :, 0]
        columns.append(np.sum(off[:, block] * solved, axis=1) / 3.0)
    return np.column_stack(columns)


def table(motions: Motions, off: Array, values: Array) -> str:
    """Return a row for every span of ages with motions in it, and one for all."""
    age_s = (motions.t_ns - motions.key_ns) * 1e-9
    spans = [*pairwise(AGES_S), (0.0, np.inf)]
    lines = ["| age | motions | NEES turn | NEES way | error (rms) | sigma (rms) |", "|---|---:|---:|---:|---:|---:|"]
    for low, high in spans:
        chosen = (age_s > low) & (age_s <= high)
        if not chosen.any():
            continue
        variance = np.diagonal(motions.covariance[chosen], axis1=1, axis2=2)
        sizes = [
            f"{np.rad2deg(np.sqrt(s[:, :3].sum(1).mean())):.3f} deg {1e3 * np.sqrt(s[:, 3:].sum(1).mean()):.2f} mm"
            for s in (off[chosen] ** 2, variance)
        ]
        turn, way = values[chosen].mean(axis=0)
        lines.append(f"| {low:g} to {high:g} s | {chosen.sum()} | {turn:.2f} | {way:.2f} | {sizes[0]} | {sizes[1]} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table for every source."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", help="recordings with truth and stereo or depth")
    parser.add_argument("--truth-mm", type=float, default=0.0, help="noise of true positions, each axis")
    parser.add_argument("--truth-deg", type=float, default=0.0, help="noise of true orientations, each axis")
    chosen = parser.parse_args(arguments)
    for source in chosen.sources:
        recording = open_source(source)
        truth = recording.truth()
        if truth is None:
            raise SystemExit(f"{source} has no truth to compare with")
        motions = within(measured(recording, Config()), truth)
        late_s = lateness(motions, truth)
        off = errors(motions, truth, *late_s)
        values = nees(off, motions.covariance, np.deg2rad(chosen.truth_deg), 1e-3 * chosen.truth_mm)
        print(f"{source}: truth is late by {1e3 * late_s[0]:+.1f} ms in turns, {1e3 * late_s[1]:+.1f} ms in ways")
        print(table(motions, off, values), flush=True)


if __name__ == "__main__":
    main()
