"""Rides of the virtual cart through the serial bridge, with and without faults, against its true motion; in real time.

    .venv/bin/python experiments/cart_ride.py [--minutes 10] [--every 60] [--faulty-only]

Every `--every` seconds something befalls the board's port, a chip or the camera, one of KINDS after the other. A valid
pose is wrong where its position in `odom` is off by more than 0.05 m and three of its sigmas; where `odom` is, the
surest pose says since it last began anew. A hole in the stamps of the published poses is silent where no pose up to
half a second after it has a health bit that says so. Exits with 1 where a pose was wrong, a hole silent, or the graph's
error above 1.3 times that of the ride without faults.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from vislam.config import SensorsConfig, load
from vislam.core import Array
from vislam.hw import Health
from vislam.live.run_live import LiveRun
from vislam.live.sources import open_live
from vislam.live.wire.publisher import PoseListener
from vislam.runs.folder import prepare
from vislam.trajectory import Trajectory, associate, read_tum

KINDS = {  # s that it lasts
    "unplugged": 0.7, "silent": 0.5, "camera": 3.0, "garbage": 0.5, "no_gyro": 0.5, "frozen": 1.0, "no_accel": 0.5,
}  # fmt: skip
FIRST_S = 5.5  # after the first: it has just begun to drive
MOST_RATIO = 1.3
_LATER_S = 1.5
_SEEN = 200  # valid poses after the last fault
_MEANT = (  # that samples are missing or wrong
    Health.IMU_MISSING | Health.IMU_GAP | Health.ACCEL_FAULT | Health.GYRO_FAULT | Health.BUS_FAULT | Health.CLOCK_STEP
)
_Kept = tuple[int, int, int, int, float, Array]  # of a pose: sequence, t_ns, health, resets, variance, T_odom_base
_PERIOD_NS, _TOLD_NS = 2_500_000, 500_000_000


@dataclass(frozen=True)
class Fault:
    """What befalls the cart, and when, s since the beginning."""

    kind: str
    from_s: float

    @property
    def to_s(self) -> float:
        """When it is over."""
        return self.from_s + KINDS[self.kind]


@dataclass(frozen=True)
class Ride:
    """What became of a ride.

    Attributes:
        poses: that were published and heard.
        valid: times of those that said valid and have a truth [N], ns, with their errors and sigmas [N], m.
        seen: health bits that were set at some time.
        silent_s: holes in the stamps that nothing told of.
        metrics: of the run.
    """

    poses: int
    valid: tuple[Array, Array, Array]
    seen: Health
    silent_s: list[float]
    metrics: dict[str, Any]

    @property
    def wrong_m(self) -> Array:
        """Errors of valid poses beyond what they state."""
        _, error_m, sigma_m = self.valid
        return np.asarray(error_m[error_m >= 0.05 + 3.0 * sigma_m])

    @property
    def graph_m(self) -> float:
        """The final graph's ATE."""
        return float(self.metrics["accuracy"]["graph"]["ate_rmse_m"])

    def __str__(self) -> str:
        _, error_m, sigma_m = self.valid
        counts = {name: count for name, count in self.metrics["live"]["counters"].items() if count}
        return (
            f"{self.poses} poses, {len(error_m)} valid, {len(self.wrong_m)} wrong; error median "
            f"{np.median(error_m):.3f}, worst {error_m.max(initial=0.0):.3f} m; sigma median {np.median(sigma_m):.3f}, "
            f"worst {sigma_m.max(initial=0.0):.3f} m\n  graph ATE {self.graph_m:.4f} m; holes that nothing told of: "
            f"{[f'{hole:.4f}' for hole in self.silent_s]}\n  {counts}\n  imu {self.metrics['counters']['imu']}, "
            f"verdict {self.metrics['verdict']['state']}"
        )


def ride(out: Path, end_s: float, faults: list[Fault], seed: int = 0) -> Ride:
    """Ride for so long, and until the pose has been valid for a while after the last fault; `out` is the run folder."""
    at, name = f"unix:{out.with_suffix('.pose')}", f"vislam-ride-{os.getpid()}"
    prepare(out, overwrite=False)
    base = load(None, {"view.enabled": False, "map.enabled": False, "live.name": name, "live.send_to": (at,)})
    of_board = [fault for fault in faults if fault.kind != "camera"]
    outages = {"imu_out": of_board, "camera_out": [fault for fault in faults if fault.kind == "camera"]}
    asked = f"virtual-cart,bridge,camera_hz=4,image_width_px=160,laps={int(end_s / 40) + 2},seed={seed}"
    for option, chosen in outages.items():
        asked += f",{option}=" + "/".join(f"{fault.from_s}:{fault.to_s}" for fault in chosen) if chosen else ""
    asked += ",imu_fault=" + "/".join(fault.kind for fault in of_board) if of_board else ""
    source, config = open_live(asked, base, SensorsConfig())
    listener, ended = PoseListener(at), threading.Event()
    poses, since = list[_Kept](), list[int]()

    def hear() -> None:
        while (heard := listener.next(0.5)) is not None or not ended.is_set():
            if heard is not None:
                variance = float(np.trace(heard.pose_covariance[:3, :3]))
                said = int(heard.health), heard.reset_counter
                poses.append((heard.sequence, heard.t_ns, *said, variance, heard.T_odom_base))

    def until_it_sees_again(run: LiveRun) -> None:
        path = source.true_path()[-1:]
        if path and path[0].t_s > max([end_s, *(fault.to_s + _LATER_S for fault in faults)]):
            since.append(len(poses))
            if sum(is_valid(Health(health)) for _, _, health, *_ in poses[since[0] :]) >= _SEEN:
                run.stop()

    ear = threading.Thread(target=hear)
    ear.start()
    try:
        metrics = LiveRun(source, config, out, asked, ["vislam", "live"]).execute(until_it_sees_again, end_s + 600.0)
    finally:
        ended.set()
        ear.join()
        listener.close()
    return Ride(len(poses), _judged(poses, out), _all(poses), _silent(poses), metrics)


def is_valid(health: Health) -> bool:
    """Return whether a pose may be steered by."""
    return Health.LEVELLED in health and Health.INVALID not in health


def _judged(poses: list[_Kept], out: Path) -> tuple[Array, Array, Array]:
    """Return times, errors and sigmas of the valid poses; `odom` begins anew with each reset that the poses state."""
    truth, found = read_tum(out / "trajectory_truth.tum"), [np.empty((3, 0))]
    valid = {pose[1]: pose for pose in poses if is_valid(Health(pose[2]))}
    for resets in {pose[3]: None for pose in valid.values()}:
        some = {t_ns: pose for t_ns, pose in valid.items() if pose[3] == resets}
        pairs = associate(Trajectory(np.array([*some]), np.array([pose[5] for pose in some.values()])), truth)
        if not len(pairs.t_ns):
            continue
        sigma_m = np.sqrt([some[t_ns][4] for t_ns in pairs.t_ns.tolist()])
        surest = int(np.argmin(sigma_m))
        pairs = pairs.aligned(pairs.reference[surest] @ np.linalg.inv(pairs.estimate[surest]))
        found.append(np.array([pairs.t_ns, pairs.position_errors_m(), sigma_m]))
    t_ns, error_m, sigma_m = np.concatenate(found, axis=1)
    return t_ns, error_m, sigma_m


def _all(poses: list[_Kept]) -> Health:
    return Health(int(np.bitwise_or.reduce([health for _, _, health, *_ in poses])))


def _silent(poses: list[_Kept]) -> list[float]:
    """Return the holes in the stamps, s, of which no health word told soon after."""
    sequence, t_ns, health = np.array([pose[:3] for pose in poses]).T  # of what was not heard nothing is known
    holes = np.flatnonzero((np.diff(sequence) == 1) & (np.diff(t_ns) > 1.5 * _PERIOD_NS) & (t_ns[:-1] > 0))
    told = [np.bitwise_or.reduce(health[k : np.searchsorted(t_ns, t_ns[k + 1] + _TOLD_NS)]) for k in holes]
    pairs = zip(holes, told, strict=True)
    return [float(t_ns[k + 1] - t_ns[k]) * 1e-9 for k, word in pairs if not Health(int(word)) & _MEANT]


def schedule(seconds: float, every_s: float) -> list[Fault]:
    """Return a fault every so many seconds, of each kind in turn."""
    count = max(int((seconds - FIRST_S) / every_s), 1)
    return [Fault([*KINDS][k % len(KINDS)], FIRST_S + k * every_s) for k in range(count)]


def main() -> int:
    """Ride, print, and return whether it was as it has to be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--every", type=float, default=60.0, help="s between faults")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--faulty-only", action="store_true", help="leave out the ride without faults")
    parser.add_argument("--clean-only", action="store_true", help="leave out the ride with faults")
    parser.add_argument("--out", type=Path, help="folder for the runs and the errors of their valid poses")
    given = parser.parse_args()
    faults = schedule(60.0 * given.minutes, given.every)
    rides, good = dict[str, Ride](), True
    with nullcontext(given.out) if given.out else tempfile.TemporaryDirectory() as folder:
        for name, befalls in {"faulty": faults, "clean": list[Fault]()}.items():
            if (name == "faulty" and given.clean_only) or (name == "clean" and given.faulty_only):
                continue
            print(name, *(f"{fault.kind}@{fault.from_s:.0f}" for fault in befalls), flush=True)
            rides[name] = ride(Path(folder) / name, 60.0 * given.minutes, befalls, given.seed)
            print(f"  {rides[name]}", flush=True)
            if given.out:
                np.savez(given.out / f"{name}.npz", *rides[name].valid)
            good = good and not len(rides[name].wrong_m) and not rides[name].silent_s
    if len(rides) == 2:
        ratio = rides["faulty"].graph_m / rides["clean"].graph_m
        print(f"graph with faults over without: {ratio:.2f}")
        good = good and ratio <= MOST_RATIO
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
