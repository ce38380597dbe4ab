"""A run folder as `vislam run` leaves it: a drifting filter, a graph that closes loops, and their bookkeeping."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.messages import NavState
from vislam.runs.folder import TRACKING_COLUMNS
from vislam.trajectory import Trajectory, evaluate, write_states_csv, write_tum

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 50_000_000
FRAMES = 1200
LOST = range(700, 742)
DEGRADED = range(680, 700)


def make_run(folder: Path, with_truth: bool = True, loops: int = 60) -> Path:
    """Write a complete run folder and return it."""
    rng = np.random.default_rng(4)
    folder.mkdir(parents=True, exist_ok=True)
    truth = _two_laps()
    ekf, live, graph = _drifted(truth, rng)
    for name, trajectory in (("ekf", ekf), ("live", live), ("graph", graph)):
        write_tum(trajectory, folder / f"trajectory_{name}.tum")
    if with_truth:
        write_tum(truth, folder / "trajectory_truth.tum")
    keyframes = np.arange(0, len(graph), 10)
    for name, trajectory, sigma in (("ekf", ekf, 0.2), ("graph", graph, 0.012)):
        write_states_csv(
            folder / f"states_{name}.csv", range(len(keyframes)), _states(trajectory, keyframes, sigma, rng)
        )
    _write_tracking(folder, truth, rng)
    counts = _write_loops(folder, truth, rng, loops)
    accuracy = {}
    if with_truth:
        accuracy = {name: evaluate(t, truth, "se3") for name, t in (("ekf", ekf), ("live", live), ("graph", graph))}
    _write_json(folder, accuracy, counts, len(keyframes))
    (folder / "map").mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "map" / "picture.png"), _picture(truth))
    return folder


def _two_laps() -> Trajectory:
    phase = np.linspace(0.0, 4 * np.pi, FRAMES)
    x = 6.0 * np.sign(np.cos(phase)) * np.abs(np.cos(phase)) ** 0.7
    y = 3.5 * np.sign(np.sin(phase)) * np.abs(np.sin(phase)) ** 0.7 + 0.15 * np.sin(5 * phase)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    poses[:, :3, :3] = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    poses[:, :3, 3] = np.stack([x, y, 0.35 + 0.004 * np.sin(9 * phase)], axis=1)
    return Trajectory(START_NS + np.arange(FRAMES) * PERIOD_NS, poses)


def _drifted(truth: Trajectory, rng: np.random.Generator) -> tuple[Trajectory, Trajectory, Trajectory]:
    """Integrate the true motion with yaw and scale errors; the graph keeps a tenth of the drift."""
    steps = np.linalg.inv(truth.T_world_body[:-1]) @ truth.T_world_body[1:]
    drift, poses = np.eye(4), [truth.T_world_body[0]]
    yaw_noise = rng.normal(2.5e-4, 1.5e-3, len(steps))
    for step, yaw in zip(steps, yaw_noise, strict=True):
        drift = step.copy()
        drift[:3, 3] *= 1.012
        drift[:3, 3] += rng.normal([0, 0, 1e-4], 8e-4)
        drift[:3, :3] = drift[:3, :3] @ Rotation.from_rotvec([0, 0, yaw]).as_matrix()
        poses.append(poses[-1] @ drift)
    ekf = np.array(poses)
    graph = truth.T_world_body.copy()
    graph[:, :3, 3] += 0.06 * (ekf[:, :3, 3] - truth.positions_m) + 0.004 * np.sin(np.arange(FRAMES) / 60)[:, None]
    live = ekf.copy()
    for start in range(600, FRAMES, 150):  # causal: pulled back at each loop
        live[start:, :3, 3] += 0.8 * (graph[start, :3, 3] - live[start, :3, 3])
    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("z", 0.7).as_matrix()
    world[:3, 3] = [-2.0, 1.0, -0.35]
    ekf_t, live_t, graph_t = (Trajectory(truth.t_ns, world @ poses) for poses in (ekf, live, graph))
    return ekf_t, live_t, graph_t


def _states(trajectory: Trajectory, keyframes, sigma: float, rng) -> list[NavState]:
    states = []
    for k in keyframes:
        share = k / FRAMES
        gyro = np.array([0.004, -0.0025, 0.0012]) * (1 - np.exp(-6 * share)) + rng.normal(0, 5e-5, 3)
        accel = np.array([0.05, -0.03, 0.09]) * (1 - np.exp(-4 * share)) + rng.normal(0, 2e-3, 3)
        sigmas = np.r_[np.full(3, 0.004), np.full(3, sigma), np.full(3, 0.02)]
        sigmas = np.r_[
            sigmas, np.full(3, 2e-4 + 4e-3 * np.exp(-9 * share)), np.full(3, 0.008 + 0.1 * np.exp(-7 * share))
        ]
        pose = trajectory.T_world_body[k]
        states.append(NavState(int(trajectory.t_ns[k]), pose, np.zeros(3), gyro, accel, np.diag(sigmas**2)))
    return states


def _write_tracking(folder: Path, truth: Trajectory, rng) -> None:
    with (folder / "tracking.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(TRACKING_COLUMNS)
        for k, t_ns in enumerate(truth.t_ns.tolist()):
            state, reason, inliers = "ok", "", int(240 + 60 * np.sin(k / 70) + rng.normal(0, 12))
            if k in LOST:
                state, reason, inliers = "lost", "7 inliers of 30, image too dark", 7
            elif k in DEGRADED:
                state, reason, inliers = "degraded", f"{60 - k % 20} inliers", 60 - k % 20
            writer.writerow([t_ns, state, inliers, k // 10, "", 0, reason])


def _write_loops(folder: Path, truth: Trajectory, rng, total: int) -> dict[str, int]:
    counts = {"candidates": total, "accepted": 0, "pending": 0, "rejected": 0}
    header = (
        "from_id,to_id,from_t_ns,to_t_ns,source,score,inliers,supporters,sigma_m,consistency,chi2,weight,moved_rms_m,"
        "moved_max_m,tx,ty,tz,qx,qy,qz,qw,decision,reason"
    )
    with (folder / "loops.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header.split(","))
        for k in range(total):
            decision = ("accepted", "rejected", "rejected", "pending", "rejected")[k % 5]
            counts[decision] += 1
            to_id = 60 + k * 59 // max(total, 1)
            from_id = to_id - 60 if decision == "accepted" else int(rng.integers(0, 40))
            inliers = int(rng.integers(40, 120)) if decision == "accepted" else int(rng.integers(0, 25))
            reason = {
                "accepted": "verified, 3 neighbours agree",
                "pending": "waits for a second witness",
                "rejected": f"{inliers} inliers, 25 needed" if k % 2 else "scene <looks> alike, but 2.4 m apart",
            }[decision]
            good = decision == "accepted"
            row = [from_id, to_id, truth.t_ns[from_id * 10], truth.t_ns[to_id * 10], "appearance"]
            row += [f"{rng.uniform(0.05, 0.5):.3f}", inliers, 2 * inliers, "0.021" if good else "", 3 if good else 0]
            row += ["4.2", "0.97", "0.013", "0.082"] if good else [""] * 4
            row += [*([0.1, 0.2, 0, 0, 0, 0, 1] if good else [""] * 7), decision, reason]
            writer.writerow(row)
    return counts


def _write_json(folder: Path, accuracy: dict, loops: dict[str, int], keyframes: int) -> None:
    def stage(p50: float, p95: float, p99: float, count: int) -> dict[str, float]:
        return {"p50": p50, "p95": p95, "p99": p99, "total_s": p50 * count * 1.15e-3, "count": count}

    metrics = {
        "name": "workshop-cart",
        "track_noise": {"measured_px": 0.53, "graph": {"told_px": 1.0, "used_px": 2.1}},
        "mode": "rgbd",
        "has_imu": True,
        "frames": FRAMES,
        "keyframes": keyframes,
        "duration_s": (FRAMES - 1) * PERIOD_NS * 1e-9,
        "wall_s": 31.8,
        "realtime_factor": 1.89,
        "initialisation": {"status": "static", "reason": "at rest for 1.0 s", "t_s": 1.0},
        "accuracy": accuracy,
        "timing_ms": {
            "ekf": stage(0.021, 0.03, 0.055, 24000),
            "front end": stage(9.1, 14.8, 22.0, FRAMES),
            "loop": stage(11.0, 31.0, 58.0, keyframes),
            "graph": stage(6.2, 22.0, 61.0, keyframes),
            "map": stage(24.0, 38.0, 51.0, keyframes),
            "map move": stage(0.4, 120.0, 240.0, keyframes),
            "graph finish": stage(210.0, 210.0, 210.0, 1),
        },
        "cost": {
            "cpu_s": 28.7, "cpu_ms_per_frame": 23.9, "compile_cpu_s": 0.0, "before_cpu_s": 2.1, "peak_memory_mb": 812.4,
            "first_pose_s": 1.25, "first_pose_cpu_s": 0.42,
            "stages_cpu_ms_per_frame": {"front end": 10.4, "decode": 3.15, "graph": 5.2, "map": 3.8, "other": 1.35},
        },
        "counters": {"front end": {"frames_lost": len(LOST), "frames_degraded": len(DEGRADED), "blurred": 0},
                     "ekf": {"vo_rejected": 3, "rewinds": 1200}},
        "problems": {"unreadable image": 1, "backward IMU stamp": 2},
        "loops": loops,
        "graph_revisions": 121,
        "warnings": ["images were missing from 35.0 s to 37.1 s; the IMU bridged the gap"],
    }  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(metrics))
    config = {"seed": 0, "imu": {"gravity_m_s2": 9.81}, "frontend": {"mode": "rgbd"}, "loop": {"enabled": True}}
    (folder / "config.json").write_text(json.dumps(config))
    manifest = {
        "code_revision": "0123456789abcdef",
        "packages": {"numpy": "2.4.6", "gtsam": "4.3.0"},
        "command": ["vislam", "run", "sim:workshop-cart", "--out", "runs/cart"],
        "machine": {"cpu": "2 cores", "python": "3.11"},
        "source": "sim:workshop-cart",
        "seed": 0,
        "data_sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855",
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))


def _picture(truth: Trajectory) -> np.ndarray:
    """Draw a hall from above, so that the report has a picture of a plausible size."""
    rng = np.random.default_rng(0)
    image = np.full((500, 900, 3), 250, np.uint8)
    for _ in range(60):
        corner = rng.integers([40, 40], [820, 430])
        tone = tuple(int(v) for v in rng.integers(90, 220, 3))
        cv2.rectangle(image, corner.tolist(), (corner + rng.integers(15, 60, 2)).tolist(), tone, -1, cv2.LINE_AA)
    path = (truth.positions_m[:, :2] * [55, -55] + [450, 250]).astype(np.int32)
    cv2.polylines(image, [path], False, (185, 115, 35), 2, cv2.LINE_AA)
    return image
