"""A car's inertial data with a fix each second, and minutes without any: 3.7 km through Karlsruhe, by filter and graph.

Both take the fixes through the same definition, `position`; there is no camera. Every tenth fix is held out and only
measured against. In runs of their own all fixes of a minute are cut, at several places. Each is done twice: with the
fixes alone, and knowing that this is a car, a `twist` whose speeds say nothing but whose base goes neither sideways nor
up (its yaw and pitch in the body are estimated). Tables and noise of the IMU come with GTSAM's package. Geiger, Lenz,
Stiller and Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013.

    python experiments/kitti_gnss.py --out runs/kitti
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from numpy.typing import NDArray

from vislam.config import load
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array, Frame, ImuSample, Keyframe, KeyframePacket, NavState, no_observations
from vislam.core.readings import Reading
from vislam.ekf.filtering import Filtering
from vislam.frontend.result import identity_motion, lost_motion
from vislam.graph import PoseGraph
from vislam.imu import ImuBuffer, ImuNoise
from vislam.pipeline.reading_intake import ReadingIntake
from vislam.sensors import Suite
from vislam.sensors.kinds.position import Position, PositionSettings
from vislam.sensors.kinds.twist import Twist, TwistSettings

Assumption = Literal["none", "car"]
_WORDS: dict[Assumption, str] = {"none": "inertial data alone", "car": "as a car"}
_NS = 1e9
_FIRST_FIX = 1  # the first one is 3 s before the second, with a hole in the inertial data between them
_HELD_OUT = 10  # one fix of so many
_STRAIGHT = 1e-6  # from a straight line: the tables' digits
_FILLED = 20  # samples in a row that lie on one
_CUT = 60  # fixes, a second each
_AFTER = 10  # fixes from the end of a cut to the end of its run
_CUTS = (72, 102, 132, 345, 375, 398)  # last fix before each: here the inertial data are whole
_CUTS_WITH_HOLES = (185, 260)  # four holes of 1.6 s, and three
_CAR_NS = 100_000_000  # between two times at which the car is thought of: the graph takes ten readings a keyframe
# what is not white: a car leans, its tyres yield by 0.1 m/s, and that for a second or two
_CAR = TwistSettings(sigma_m_s=1e3, sigma_rad_s=1e3, sideways_m_s=0.3, upward_m_s=0.3, mount_sigma_rad=0.02)
_NO_RIG = Rig((Camera(64, 48, 50.0, 50.0, 32.0, 24.0),), (np.eye(4),))  # nobody looks through it
_START_SIGMAS = (0.05, 0.05, 0.1, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0, *[1e-3] * 3, *[0.1] * 3)  # yaw: of the course
_SETTINGS = {
    "graph.coupling": "loose", "ekf.coupling": "loose",
    "graph.gauge_sigma_m": 0.5, "graph.gauge_sigma_rad": 0.1,  # the world is that of the fixes: no free choice
    "machine.max_outage_s": 2.0,  # the holes of the inertial data last 1.6 s
    **dict.fromkeys(("ekf.gap_accel_m_s2", "machine.outage_accel_sigma_m_s2"), 1.0),  # a car in traffic
    **dict.fromkeys(("ekf.gap_gyro_rad_s", "machine.outage_gyro_sigma_rad_s"), 0.1),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The drive, as the tables have it."""

    imu_t_ns: NDArray[np.int64]  # [N]
    imu: Array  # [N, 6] rates and forces
    t_ns: NDArray[np.int64]  # [M] of the fixes
    fixes_m: Array  # [M, 3] east, north, up
    noise: ImuNoise

    def way_m(self, first: int, last: int) -> float:
        """Return the way between two fixes."""
        return float(np.linalg.norm(np.diff(self.fixes_m[first : last + 1], axis=0), axis=1).sum())


def read() -> Table:
    """Read the tables."""
    spec = find_spec("gtsam")
    assert spec is not None and spec.submodule_search_locations is not None
    folder = Path(spec.submodule_search_locations[0]) / "Data"
    imu = np.loadtxt(folder / "KittiEquivBiasedImu.txt", skiprows=1)
    fixes = np.loadtxt(folder / "KittiGps_converted.txt", skiprows=1, delimiter=",")
    told = np.loadtxt(folder / "KittiEquivBiasedImu_metadata.txt", skiprows=1)
    accel, gyro, _, accel_walk, gyro_walk, period_s = told[6:]
    imu = imu[measured(imu[:, 0], imu[:, 2:])]
    return Table(
        _stamps(imu[:, 0]), np.hstack([imu[:, 5:], imu[:, 2:5]]), _stamps(fixes[:, 0]), fixes[:, 1:],
        ImuNoise(gyro, accel, gyro_walk, accel_walk, 1.0 / period_s),
    )  # fmt: skip


def measured(t_s: Array, values: Array) -> NDArray[np.bool_]:
    """Return which of values [N, C] at times [N] somebody measured: no noise lies on a straight line for long.

    The tables have eight holes of 1.6 s that were filled by straight lines, as if nothing had been missing.
    """
    share = ((t_s[1:-1] - t_s[:-2]) / (t_s[2:] - t_s[:-2]))[:, None]
    off = np.abs(values[1:-1] - values[:-2] - share * (values[2:] - values[:-2])).max(axis=1)
    straight = np.concatenate([[False], off < _STRAIGHT, [False]])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], straight, [False]]).astype(int)))
    kept = np.ones(len(t_s), dtype=np.bool_)
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin >= _FILLED:
            kept[begin:end] = False
    return kept


def _stamps(t_s: Array) -> NDArray[np.int64]:
    return np.asarray(np.round(t_s * _NS).astype(np.int64))


@dataclass(slots=True, eq=False)
class Path3:
    """Positions and their covariances at fixes, by one estimator."""

    fixes: list[int]
    positions_m: list[Array]
    covariances: list[Array]  # [3, 3]

    def against(self, table: Table, chosen: set[int], sigma_m: float) -> tuple[Array, Array]:
        """Return errors [K, 3] and squared errors over their covariance, that of the fix with it, [K]."""
        rows = [n for n, k in enumerate(self.fixes) if k in chosen]
        errors = np.array([table.fixes_m[self.fixes[n]] - self.positions_m[n] for n in rows]).reshape(-1, 3)
        noise = sigma_m**2 * np.eye(3)
        squares = [e @ np.linalg.solve(self.covariances[n] + noise, e) for e, n in zip(errors, rows, strict=True)]
        return errors, np.array(squares)


class Drive:
    """Filter and graph over the drive, or a part of it, without some fixes."""

    def __init__(self, table: Table, assumption: Assumption, sigma_m: float) -> None:
        """Set both up; `sigma_m` is that of a fix, per axis."""
        self.config = config = load(None, _SETTINGS)
        fixes = Position(PositionSettings(sigma_m=sigma_m, sigma_up_m=sigma_m, frame="known"))
        fixes.gate_probability = 1.0 - 1e-6  # nothing else would bring a filter back that has gated a good one
        suite = Suite({"gnss": fixes} | ({"car": Twist(_CAR)} if assumption == "car" else {}))
        gravity = config.machine.gravity_m_s2
        self.filter = Filtering(config.ekf, table.noise, config.machine, _NO_RIG, suite)
        self.buffer = ImuBuffer(config.imu, config.machine)
        self.intake = ReadingIntake(suite, self.filter, self.buffer, gravity, table.noise.accelerometer_noise_density)
        self.graph = PoseGraph(config.graph, table.noise, config.machine, _NO_RIG, config.window, suite)
        self._table, self._has_car = table, assumption == "car"
        self._car_ns = 0
        self.cpu_s = {"filter": 0.0, "graph": 0.0}

    def run(self, without: set[int], last: int) -> dict[str, Path3]:
        """Return the paths of the filter and of the graph, causal, and of the graph at the end, up to a fix."""
        table = self._table
        paths = {name: Path3([], [], []) for name in ("filter", "graph causal", "graph")}
        at = self._begin(last)
        for k in range(_FIRST_FIX + 1, last + 1):
            t_ns, begun_s = int(table.t_ns[k]), time.process_time()
            while table.imu_t_ns[at - 1] < t_ns:
                self._sample(at)
                at += 1
            body, state = self.filter.ekf.body_at(t_ns), self.filter.state
            assert body is not None and state is not None
            _keep(paths["filter"], k, body.position_m, state.covariance)
            if k not in without:
                self.intake.add(Reading("gnss", t_ns, table.fixes_m[k]))
                self.intake.hand_on(int(table.imu_t_ns[at - 1]))
            self.cpu_s["filter"] += time.process_time() - begun_s
            begun_s = time.process_time()
            self._keyframe(k)
            newest = self._update.newest
            assert newest is not None
            _keep(paths["graph causal"], k, newest.T_world_body[:3, 3], newest.covariance)
            self.cpu_s["graph"] += time.process_time() - begun_s
        begun_s = time.process_time()
        self.graph.finish()
        for k, state in enumerate(self.graph.states(), _FIRST_FIX):
            _keep(paths["graph"], k, state.T_world_body[:3, 3], state.covariance)
        self.cpu_s["graph"] += time.process_time() - begun_s
        return paths

    def _begin(self, last: int) -> int:
        """Begin at a fix, where the first three say, with the course for a heading; return the next sample's number."""
        table, first = self._table, _FIRST_FIX
        one, two, three = table.fixes_m[first : first + 3]
        velocity = -1.5 * one + 2.0 * two - 0.5 * three  # per second, of the parabola through them
        t_ns = int(table.t_ns[first])
        yaw = so3_exp(np.array([0.0, 0.0, np.arctan2(velocity[1], velocity[0])]))
        state = NavState(t_ns, transform(yaw, one), velocity, np.zeros(3), np.zeros(3), np.diag(_START_SIGMAS) ** 2)
        begin = int(np.searchsorted(table.imu_t_ns, t_ns)) - 2
        for at in range(begin, begin + 4):
            self._sample(at)
        motion = identity_motion(t_ns, 0, True, 0)
        self.filter.start(state, motion)
        self.graph.initialise(state)
        packet = KeyframePacket(_keyframe(0, t_ns), motion, no_observations(), None)
        self._update = self.graph.add(packet, (), state.T_world_body)
        return begin + 4

    def _sample(self, at: int) -> None:
        t_ns, values = int(self._table.imu_t_ns[at]), self._table.imu[at]
        sample = ImuSample(t_ns, values[:3], values[3:])
        self.buffer.add(sample)
        self.filter.ekf.predict(sample)
        if self._has_car and self.filter.state is not None and t_ns - self._car_ns >= _CAR_NS:
            self._car_ns = t_ns
            self.intake.add(Reading("car", t_ns, np.zeros(2)))
            self.intake.hand_on(t_ns)

    def _keyframe(self, k: int) -> None:
        table, number = self._table, k - _FIRST_FIX
        before_ns, t_ns = int(table.t_ns[k - 1]), int(table.t_ns[k])
        imu, state = self.buffer.span(before_ns, t_ns), self.filter.state
        assert state is not None
        vo = lost_motion(t_ns, number - 1, True)
        packet = KeyframePacket(_keyframe(number, t_ns), vo, no_observations(), imu)
        self._update = self.graph.add(self.intake.pack(packet, before_ns, state), (), state.T_world_body)


def _keep(path: Path3, k: int, position_m: Array, covariance: Array) -> None:
    path.fixes.append(k)
    path.positions_m.append(position_m)
    path.covariances.append(covariance[3:6, 3:6])


def _keyframe(k: int, t_ns: int) -> Keyframe:
    return Keyframe(k, t_ns, Frame(t_ns, k, ()), np.empty((0, 2)), np.empty((0, 32), np.uint8), None)


def held_out(table: Table, assumption: Assumption, sigma_m: float) -> tuple[dict[str, Any], dict[str, Path3]]:
    """Return what the run with one fix of ten held out gives, and its paths."""
    last = len(table.t_ns) - 2  # the inertial data end with the last but one
    held = set(range(_FIRST_FIX + _HELD_OUT, last, _HELD_OUT))
    drive = Drive(table, assumption, sigma_m)
    paths = drive.run(held, last)
    entry: dict[str, Any] = {"fixes_held_out": len(held), "cpu_s": drive.cpu_s}
    for name, path in paths.items():
        errors, squares = path.against(table, held, sigma_m)
        entry[name] = {
            "rmse_horizontal_m": float(np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean())),
            "rmse_up_m": float(np.sqrt((errors[:, 2] ** 2).mean())),
            "max_m": float(np.linalg.norm(errors, axis=1).max()),
            "nees_per_dof": float(squares.mean() / 3.0),
        }
    nis = drive.filter.ekf.nis_statistics
    entry["filter"]["nis_per_dof"] = {name: total / dof for name, (_, total, dof) in nis.items() if dof}
    return entry, paths


def cut(table: Table, assumption: Assumption, sigma_m: float, before: int) -> tuple[dict[str, Any], dict[str, Path3]]:
    """Return what a minute without fixes after one of them costs, and the paths."""
    end = before + _CUT
    paths = Drive(table, assumption, sigma_m).run(set(range(before + 1, end + 1)), end + _AFTER)
    way_m = table.way_m(before, end)
    entry: dict[str, Any] = {"assumption": assumption, "before": before, "way_m": way_m}
    for name, path in paths.items():
        _, squares = path.against(table, {end}, sigma_m)
        within, after = (
            np.linalg.norm(path.against(table, set(chosen), sigma_m)[0], axis=1)
            for chosen in (range(before + 1, end + 1), range(end + 2, end + _AFTER + 1))
        )
        entry[name] = {
            "end_m": float(within[-1]), "end_share": float(within[-1]) / way_m,
            "max_m": float(within.max()), "max_share": float(within.max()) / way_m,
            "after_max_m": float(after.max()), "end_nees_per_dof": float(squares[0]) / 3.0,
        }  # fmt: skip
    return entry, paths


def told(answer: dict[str, Any]) -> str:
    """Return the results as a plain table."""
    lines = ["held-out fixes    horizontal RMSE   up RMSE   max [m]   NEES per degree"]
    for assumption, entry in answer["held_out"].items():
        for name in ("filter", "graph causal", "graph"):
            one = entry[name]
            numbers = (one["rmse_horizontal_m"], one["rmse_up_m"], one["max_m"], one["nees_per_dof"])
            lines.append(f"{assumption:5} {name:13}" + "".join(f"{number:12.3f}" for number in numbers))
    lines.append("60 s without fixes, error of the way within them [%]: at the end by filter and graph, most of it by")
    lines.append("the graph that has all; and what is left 2 to 10 s later [m], by filter and graph")
    for entry in answer["cuts"]:
        shares = [100.0 * entry[name]["end_share"] for name in ("filter", "graph causal")]
        shares.append(100.0 * entry["graph"]["max_share"])
        left = [entry[name]["after_max_m"] for name in ("filter", "graph causal")]
        text = "".join(f"{number:9.2f}" for number in (*shares, *left))
        lines.append(f"{entry['assumption']:5} after fix {entry['before']:3} {entry['way_m']:6.0f} m {text}")
    return "\n".join(lines)


def _rows(paths: dict[str, Path3], table: Table) -> Iterable[str]:
    yield "path,t_ns,fix_east_m,fix_north_m,fix_up_m,east_m,north_m,up_m,sigma_east_m,sigma_north_m,sigma_up_m"
    for name, path in paths.items():
        for k, position, P in zip(path.fixes, path.positions_m, path.covariances, strict=True):
            numbers = (*table.fixes_m[k], *position, *np.sqrt(np.diag(P)))
            yield ",".join([name, str(table.t_ns[k]), *(f"{number:.4f}" for number in numbers)])


def _draw(out: Path, table: Table, whole: dict[str, Path3], cuts: dict[Assumption, dict[str, Path3]]) -> None:
    """Draw the whole drive, and the minute of one cut with and without the assumption."""
    figure, axes = plt.subplots(1, 2, figsize=(13, 6), layout="constrained")
    last = len(table.t_ns) - 1
    axes[0].plot(*table.fixes_m[_FIRST_FIX:last, :2].T, color="0.6", linewidth=4, label="fixes")
    for name, style in (("filter", "C0-"), ("graph", "C1--")):
        axes[0].plot(*np.array(whole[name].positions_m)[:, :2].T, style, linewidth=1, label=name)
    axes[0].set_title(f"one fix of ten held out, {_WORDS[list(cuts)[-1]]}")
    begin = min(paths["filter"].fixes[-1] for paths in cuts.values()) - _CUT - _AFTER
    axes[1].plot(*table.fixes_m[begin - 5 : begin + _CUT + _AFTER + 1, :2].T, color="0.6", linewidth=4, label="fixes")
    for n, (assumption, paths) in enumerate(cuts.items()):
        for name, style in (("filter", "-"), ("graph", "--")):
            rows = [i for i, k in enumerate(paths[name].fixes) if k >= begin - 5]
            points = np.array(paths[name].positions_m)[rows, :2]
            whose = name if name == "filter" else "graph at its end"
            axes[1].plot(*points.T, f"C{2 * n + 2}{style}", linewidth=1.2, label=f"{whose}, {_WORDS[assumption]}")
    axes[1].set_title(f"60 s without fixes after fix {begin}")
    for axis in axes:
        axis.set_aspect("equal")
        axis.set_xlabel("east [m]")
        axis.set_ylabel("north [m]")
        axis.legend()
    figure.savefig(out / "paths.png", dpi=100)
    plt.close(figure)


def main(
    out: Path | None = None, sigma_m: float = 0.12, assumptions: tuple[Assumption, ...] = ("none", "car"),
    cuts: tuple[int, ...] = _CUTS + _CUTS_WITH_HOLES,
) -> None:  # fmt: skip
    """Run the drive.

    Args:
        out: folder for results.json, held_out.csv of the last assumption, and paths.png.
        sigma_m: of a fix, per axis.
        assumptions: of what moves; "car": it goes neither sideways nor up.
        cuts: the last fix before each cut of a minute.
    """
    table = read()
    answer: dict[str, Any] = {"sigma_m": sigma_m, "held_out": {}, "cuts": []}
    whole: dict[str, Path3] = {}
    first: dict[Assumption, dict[str, Path3]] = {}
    for assumption in assumptions:
        answer["held_out"][assumption], whole = held_out(table, assumption, sigma_m)
        for before in cuts:
            entry, paths = cut(table, assumption, sigma_m, before)
            answer["cuts"].append(entry)
            first.setdefault(assumption, paths)
    print(told(answer))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "results.json").write_text(json.dumps(answer, indent=2))
        (out / "held_out.csv").write_text("\n".join(_rows(whole, table)) + "\n")
        if first:
            _draw(out, table, whole, first)


if __name__ == "__main__":
    tyro.cli(main)
