"""Drive the virtual cart around a course on the published pose alone, and say how well it kept to it.

    .venv/bin/python experiments/follow_path.py --out results/follow_path

The controller (pure pursuit) knows nothing but what `vislam live` publishes: the newest pose in `odom`, from shared
memory, predicted to when the wheels will answer. It stops while the health word says INVALID. The cart is a unicycle
with limited accelerations whose wheels answer 0.1 to 0.15 s late; its IMU is an emulated GY-85 under the real driver,
its camera is rendered. Everything runs in real time: on a machine that is busy otherwise, frames are dropped and the
result is worse. Writes follow_path.json and follow_path.png beside the run.
"""

from __future__ import annotations

import argparse
import json
import threading
import time
from pathlib import Path

import numpy as np

ANSWER_NS = 125_000_000  # until the wheels do what is commanded, on average
PERIOD_S = 0.02
START_S = 4.0  # standing, so that gravity is found


def steer(name: str, command_name: str, course_odom: np.ndarray, stop: threading.Event, log: list[tuple]) -> None:
    """Follow the course [N, 2] in odom from the published pose until its end, or `stop`."""
    from vislam.core.errors import DataError
    from vislam.hw.health import Health
    from vislam.live.virtual.pilot import CommandWriter, PathFollower
    from vislam.live.wire.publisher import PoseReader

    wheels, follower = CommandWriter(command_name), PathFollower(course_odom)
    reader: PoseReader | None = None
    levelled_ns: int | None = None
    try:
        while not stop.is_set():
            time.sleep(PERIOD_S)
            try:
                reader = reader or PoseReader(name)
            except DataError:
                continue
            pose = reader.latest()
            if pose is None or Health.INVALID in pose.health:
                wheels.command(0.0, 0.0)
                continue
            levelled_ns = levelled_ns or pose.t_ns
            if pose.t_ns - levelled_ns < START_S * 1e9:
                continue
            then = pose.predict(time.monotonic_ns() + ANSWER_NS).T_odom_base
            yaw = float(np.arctan2(then[1, 0], then[0, 0]))
            speed, rate, is_done = follower.command(float(then[0, 3]), float(then[1, 3]), yaw)
            wheels.command(speed, rate)
            log.append((pose.t_ns, *pose.T_odom_base[:2, 3].tolist(), pose.vision_age_s, pose.map_revision))
            if is_done:
                wheels.command(0.0, 0.0)
                time.sleep(1.0)
                stop.set()
    finally:
        wheels.close()


def write_picture(path: Path, course: np.ndarray, driven: np.ndarray, believed: np.ndarray, title: str) -> None:
    """Draw the course, where the cart was, and where the published pose had it."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5), layout="constrained")
    axes.plot(*course.T, color="0.7", linewidth=4, label="course")
    axes.plot(*driven.T, color="tab:blue", label="driven (truth)")
    axes.plot(*believed.T, color="tab:orange", linewidth=1, label="published pose, odom")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    axes.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run it."""
    from vislam.config import load, load_sensors
    from vislam.core.files import write_json
    from vislam.live.run_live import LiveRun
    from vislam.live.sources import open_live
    from vislam.live.status import status_line
    from vislam.live.virtual.cart import VirtualCart
    from vislam.live.virtual.pilot import PathFollower
    from vislam.live.virtual.place import course
    from vislam.runs.folder import prepare

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/follow_path"))
    parser.add_argument("--laps", type=int, default=1)
    parser.add_argument("--camera-hz", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=180.0, help="give up after so long")
    arguments = parser.parse_args()
    asked = f"virtual-cart,steered=true,camera_hz={arguments.camera_hz:g},laps={arguments.laps}"
    source, config = open_live(asked, load(None, {"view.enabled": False}), load_sensors())
    assert isinstance(source, VirtualCart)
    prepare(arguments.out, overwrite=True)
    way = course(arguments.laps)
    stop, log, shown = threading.Event(), [], [0.0]
    controller = threading.Thread(
        target=steer, args=(config.live.name, source.command_name, way - way[0], stop, log), daemon=True
    )
    truth: list = []

    def show(run: LiveRun) -> None:
        truth[:] = source.true_path() or truth
        if stop.is_set():
            run.stop()
        if time.monotonic() - shown[0] > 5.0:
            shown[0] = time.monotonic()
            print(status_line(run), flush=True)

    controller.start()
    metrics = LiveRun(source, config, arguments.out, asked, ["follow_path"]).execute(show, arguments.seconds)
    stop.set()
    driven = np.array([[s.x_m, s.y_m] for s in truth])
    moved = np.linalg.norm(np.diff(driven, axis=0), axis=1)
    is_moving = np.concatenate([[False], moved > 1e-4])
    follower = PathFollower(way)
    errors = []
    for s in np.array(truth, dtype=object)[is_moving]:
        follower.command(s.x_m, s.y_m, s.yaw_rad)
        errors.append(follower.error_m(s.x_m, s.y_m))
    ages = np.array([row[3] for row in log])
    result = {
        "course_m": follower.length_m,
        "driven_m": float(moved.sum()),
        "reached_end": bool(np.linalg.norm(driven[-1] - way[-1]) < 1.0),
        "end_error_m": float(np.linalg.norm(driven[-1] - way[-1])),
        "tracking_rms_m": float(np.sqrt(np.mean(np.square(errors)))),
        "tracking_max_m": float(np.max(errors)),
        "commands": len(log),
        "vision_age_p99_s": float(np.percentile(ages[np.isfinite(ages)], 99)),
        "accuracy": metrics["accuracy"],
        "latency_ms": metrics.get("live", {}),
    }
    write_json(arguments.out / "follow_path.json", result)
    believed = np.array([row[1:3] for row in log]) + way[0]
    title = f"tracking error {result['tracking_rms_m']:.3f} m rms, {result['tracking_max_m']:.3f} m at most"
    write_picture(arguments.out / "follow_path.png", way, driven, believed, title)
    print(json.dumps({name: value for name, value in result.items() if name != "accuracy"}, indent=1))


if __name__ == "__main__":
    main()
