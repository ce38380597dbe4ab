"""A robot's gyroscope, wheels and ranges to four anchors over 1.9 and 1.4 km (Plaza 1 and 2), by graph and by filter.

Both get the same measurements, through the same definition of each sensor: turns of the gyroscope as the IMU's (an
accelerometer is not in the tables; a force is put in its place that keeps a turning robot on its curve, and as little
is thought of it), speeds as a `twist`, ranges, and that the floor is level. The anchors are surveyed; where the robot
starts and that this radio's ranges are 7 % too long, both have to find. The tables come with GTSAM's package. Djugash,
Hamner and Roth, "Navigating with ranging radios: five data sets with ground truth", Journal of Field Robotics 2009.

    python experiments/plaza.py --out runs/plaza
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.io import loadmat

from vislam.config import load
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import skew, so3_exp, transform
from vislam.core.messages import Array, Frame, ImuSample, Keyframe, KeyframePacket, NavState, no_observations
from vislam.core.readings import Reading
from vislam.ekf.filtering import Filtering
from vislam.ekf.loose.kernels import ERRORS
from vislam.frontend.result import identity_motion, lost_motion
from vislam.graph import PoseGraph
from vislam.imu import ImuBuffer, ImuNoise
from vislam.pipeline.reading_intake import ReadingIntake
from vislam.sensors import BodyState, Correlated, Sensor, Suite
from vislam.sensors.kinds.anchor_range import AnchorRange, AnchorRangeSettings
from vislam.sensors.kinds.twist import Twist, TwistSettings
from vislam.trajectory import Trajectory

_SETTINGS = {
    "graph.coupling": "loose", "ekf.coupling": "loose",
    "machine.max_gap_s": 1.0,  # samples come five times a second
}  # fmt: skip
_STEP_NS = 1_000_000_000  # between keyframes
_FRAME = 4  # of the own variables of ranges: heading and place of their frame
_TRUTH_M = 0.02  # sigma of the truth per axis: RTK, as the tables' authors have it
_NEES_EVERY = 10  # keyframes of the final graph
_NO_RIG = Rig((Camera(64, 48, 50.0, 50.0, 32.0, 24.0),), (np.eye(4),))  # nobody looks through it
_START_SIGMAS = np.repeat([1e-3, 1e-3, 0.5, 0.01, 0.3], 3)  # rotation, position, velocity, biases


@dataclass(frozen=True, slots=True, eq=False)
class Plaza:
    """One drive, as the tables have it."""

    t_ns: NDArray[np.int64]  # [N] ends of the steps
    steps: Array  # [N, 2] metres and radians of each
    ranges: Array  # [M, 3] time in ns, anchor, metres
    anchors: dict[str, tuple[float, float, float]]
    truth: Trajectory


def read(number: int) -> Plaza:
    """Read drive 1 or 2."""
    spec = find_spec("gtsam")
    assert spec is not None and spec.submodule_search_locations is not None
    table = loadmat(str(Path(spec.submodule_search_locations[0]) / "Data" / f"Plaza{number}_.mat"))
    told, ranges, true = table["DR"], table["TD"], table["GT"]
    poses = np.array([_flat(x, y, yaw) for _, x, y, yaw in true])
    return Plaza(
        np.round(told[:, 0] * 1e9).astype(np.int64),
        told[:, 1:],
        np.column_stack([np.round(ranges[:, 0] * 1e9), ranges[:, 2:]]),
        {str(int(name)): (float(x), float(y), 0.0) for name, x, y in table["TL"]},
        Trajectory(np.round(true[:, 0] * 1e9).astype(np.int64), poses),
    )


class LevelFloor(Sensor):
    """The robot stands upright on a floor, which is in one plane."""

    columns = ("height_m",)
    touches = ("rotation", "position")

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return height and the tilt about two axes [3]."""
        return np.array([values[0] - body.position_m[2], *-body.R_world_body[2, :2]])

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [3, 15] and H_own [3, 0]."""
        H = np.zeros((3, 15))
        H[0, 5] = 1.0
        H[1:, :3] = skew(body.R_world_body[2])[:2]
        return H, np.zeros((3, 0))

    def noise(self, values: Array) -> Array:
        """Return the covariance [3, 3]: what a parking ground is not level by."""
        return np.diag([0.02, 0.02, 0.02]) ** 2


def suite_for(plaza: Plaza, range_sigma_m: float, shared: tuple[float, float] = (0.0, 0.0)) -> Suite:
    """Return the sensors beside the gyroscope; with `shared`, ranges of an anchor err together by m, for s."""
    uwb = AnchorRangeSettings(anchors=plaza.anchors, sigma_m=range_sigma_m, scale_sigma=0.1, frame_z_sigma_m=0.01)
    wheels = TwistSettings(sigma_rad_s=10.0, sigma_m_s=0.05, slip=0.05)  # of their turn the gyroscope tells
    ranges = Correlated(AnchorRange(uwb), shared[:1], shared[1]) if shared[0] else AnchorRange(uwb)
    return Suite({"uwb": ranges, "wheels": Twist(wheels), "floor": LevelFloor()})


class Drive:
    """Filter and graph over one drive."""

    def __init__(self, plaza: Plaza, suite: Suite) -> None:
        """Set both up, knowing nothing of where the robot starts but that it stands."""
        self.config = config = load(None, _SETTINGS)
        self.gravity_m_s2 = config.machine.gravity_m_s2
        period_s = float(np.median(np.diff(plaza.t_ns))) * 1e-9
        noise = ImuNoise(0.01, 0.5, 1e-4, 1e-4, 1.0 / period_s)
        self.filter = Filtering(config.ekf, noise, config.machine, _NO_RIG, suite)
        self.buffer = ImuBuffer(config.imu, config.machine)
        self.intake = ReadingIntake(
            suite, self.filter, self.buffer, self.gravity_m_s2, noise.accelerometer_noise_density
        )
        self.graph = PoseGraph(config.graph, noise, config.machine, _NO_RIG, config.window, suite)
        self._plaza, self._suite = plaza, suite
        self.cpu_s = {"filter": 0.0, "graph": 0.0}
        self.covariances: list[Array] = []  # [2, 2] of the filter's places among the anchors, of each keyframe

    def run(self) -> tuple[Trajectory, Trajectory]:
        """Return the paths of filter, causal, and of the graph, both in the frame of the anchors."""
        plaza, waiting = self._plaza, list(self._plaza.ranges[::-1])
        by_filter: list[tuple[int, Array, Array]] = []
        key_ns = self._begin()
        stamps = [key_ns]
        middles = plaza.t_ns[1:] - np.diff(plaza.t_ns) // 2
        for k, t_ns in enumerate(middles.tolist(), 1):
            dt_s = (plaza.t_ns[k] - plaza.t_ns[k - 1]) * 1e-9
            way_m, turn_rad = plaza.steps[k]
            while waiting and waiting[-1][0] <= t_ns:
                stamp, *values = waiting.pop()
                self.intake.add(Reading("uwb", int(stamp), np.array(values)))
            self.intake.add(Reading("wheels", t_ns, np.array([way_m / dt_s, turn_rad / dt_s])))
            self.intake.add(Reading("floor", t_ns, np.zeros(1)))
            begun_s = time.process_time()
            self._turn(t_ns, turn_rad / dt_s, way_m / dt_s)
            self.cpu_s["filter"] += time.process_time() - begun_s
            state = self.filter.state
            assert state is not None
            if t_ns - key_ns < _STEP_NS:
                continue
            begun_s = time.process_time()
            self._add(len(stamps), t_ns, key_ns, state)
            self.cpu_s["graph"] += time.process_time() - begun_s
            by_filter.append((t_ns, state.T_world_body, self.filter.ekf.own("uwb")[0]))
            self.covariances.append(self._of_filter(state.T_world_body))
            stamps.append(t_ns)
            key_ns = t_ns
        begun_s = time.process_time()
        self.graph.finish()
        self.cpu_s["graph"] += time.process_time() - begun_s
        found = self.graph.own("uwb")
        assert found is not None
        causal = [in_anchors(own, T) for _, T, own in by_filter]
        return (
            Trajectory(np.array([t_ns for t_ns, _, _ in by_filter]), np.array(causal)),
            Trajectory(np.array(stamps), np.array([in_anchors(found[0], T) for T in self.graph.poses()])),
        )

    def of_graph(self, k: int) -> Array | None:
        """Return the covariance [2, 2] of a keyframe's place among the anchors; None where gtsam gives none."""
        joint = self.graph.joint_covariance(k, "uwb")
        found, T = self.graph.own("uwb"), self.graph.poses()[k]
        if joint is None or found is None:
            return None
        turned = np.eye(6 + _FRAME)
        turned[3:6, 3:6] = T[:3, :3]  # from the body's axes
        framed = joint[: 6 + _FRAME, : 6 + _FRAME]
        return in_anchors_covariance(found[0], T, turned @ framed @ turned.T)

    def _of_filter(self, T: Array) -> Array:
        at, P = self._suite.own("uwb").start, self.filter.ekf._state.P
        chosen = [*range(6), *range(ERRORS + at, ERRORS + at + _FRAME)]
        return in_anchors_covariance(self.filter.ekf.own("uwb")[0], T, P[np.ix_(chosen, chosen)])

    def _begin(self) -> int:
        t_ns = int(self._plaza.t_ns[0])
        state = NavState(t_ns, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.diag(_START_SIGMAS**2))
        motion = identity_motion(t_ns, 0, True, 0)
        self._turn(t_ns, 0.0, 0.0)
        self.filter.start(state, motion)
        self.graph.initialise(state)
        self.graph.add(KeyframePacket(_keyframe(0, t_ns), motion, no_observations(), None), (), np.eye(4))
        return t_ns

    def _turn(self, t_ns: int, rate_rad_s: float, speed_m_s: float) -> None:
        force = np.array([0.0, speed_m_s * rate_rad_s, self.gravity_m_s2])
        sample = ImuSample(t_ns, np.array([0.0, 0.0, rate_rad_s]), force)
        self.buffer.add(sample)
        self.filter.ekf.predict(sample)
        self.intake.hand_on(t_ns)

    def _add(self, k: int, t_ns: int, before_ns: int, state: NavState) -> None:
        imu, vo = self.buffer.span(before_ns, t_ns), lost_motion(t_ns, k - 1, True)
        packet = KeyframePacket(_keyframe(k, t_ns), vo, no_observations(), imu)
        self.graph.add(self.intake.pack(packet, before_ns, state), (), state.T_world_body)


def in_anchors(own: Array, T: Array) -> Array:
    """Return a pose [4, 4] in the anchors' frame, whose heading and place own variables tell."""
    return transform(so3_exp(np.array([0.0, 0.0, own[0]])), own[1:4]) @ T


def in_anchors_covariance(own: Array, T: Array, joint: Array) -> Array:
    """Return the covariance [2, 2] of east and north in the anchors' frame.

    `joint` [10, 10] is that of the body's rotation and its position in world, and of the frame's heading and place.
    """
    R = so3_exp(np.array([0.0, 0.0, own[0]]))
    J = np.hstack([np.zeros((3, 3)), R, np.cross([0.0, 0.0, 1.0], R @ T[:3, 3])[:, None], np.eye(3)])
    return np.asarray((J @ joint @ J.T)[:2, :2])


def nees_per_dof(path: Trajectory, covariances: list[Array | None], truth: Trajectory, after_s: float) -> float:
    """Return the mean squared horizontal error over its covariance and that of the truth, per degree of freedom."""
    squares = []
    for t_ns, position, P in zip(path.t_ns.tolist(), path.positions_m, covariances, strict=True):
        if P is not None and truth.t_ns[0] + after_s * 1e9 <= t_ns <= truth.t_ns[-1]:
            away = position[:2] - truth.at(t_ns)[:2, 3]
            squares.append(away @ np.linalg.solve(P + _TRUTH_M**2 * np.eye(2), away))
    return float(np.mean(squares)) / 2.0


def _flat(x: float, y: float, yaw: float) -> Array:
    return transform(so3_exp(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.0]))


def _keyframe(k: int, t_ns: int) -> Keyframe:
    return Keyframe(k, t_ns, Frame(t_ns, k, ()), np.empty((0, 2)), np.empty((0, 32), np.uint8), None)


def errors_m(path: Trajectory, truth: Trajectory, after_s: float) -> Array:
    """Return horizontal distances [N] from the truth, in the anchors' frame: nothing is aligned."""
    inside = (path.t_ns >= truth.t_ns[0] + round(after_s * 1e9)) & (path.t_ns <= truth.t_ns[-1])
    away = path.positions_m[inside] - truth.at(path.t_ns[inside])[:, :3, 3]
    return np.linalg.norm(away[:, :2], axis=1)


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))


def main(
    out: Path | None = None, drives: tuple[int, ...] = (1, 2), range_sigma_m: float = 0.6, settled_s: float = 150.0,
    shared: tuple[float, float] = (0.0, 0.0),
) -> None:  # fmt: skip
    """Run the drives.

    Args:
        out: folder for results.json.
        drives: which of the two.
        range_sigma_m: of a range, once its scale is known.
        shared: error that ranges of one anchor share: sigma in m, and s in which it forgets all but 1/e; 0: none.
        settled_s: errors count from then on: before, both look for the anchors' frame; the rest says `with_start`.
    """
    answer: dict[str, Any] = {}
    for number in drives:
        plaza = read(number)
        drive = Drive(plaza, suite_for(plaza, range_sigma_m, shared))
        by_filter, by_graph = drive.run()
        entry: dict[str, Any] = {"way_m": plaza.truth.path_m, "cpu_s": drive.cpu_s}
        for name, path in (("filter", by_filter), ("graph", by_graph)):
            errors, whole = (errors_m(path, plaza.truth, after_s) for after_s in (settled_s, 0.0))
            entry[name] = {"rmse_m": _rms(errors), "max_m": float(errors.max()), "with_start_rmse_m": _rms(whole)}
        some = [drive.of_graph(k) if k % _NEES_EVERY == 0 else None for k in range(len(by_graph))]
        entry["filter"]["nees_per_dof"] = nees_per_dof(by_filter, list(drive.covariances), plaza.truth, settled_s)
        entry["graph"]["nees_per_dof"] = nees_per_dof(by_graph, some, plaza.truth, settled_s)
        nis = drive.filter.ekf.nis_statistics
        entry["filter"]["nis_per_dof"] = {name: total / dof for name, (_, total, dof) in nis.items() if dof}
        answer[f"plaza{number}"] = entry
    print(json.dumps(answer, indent=2))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "results.json").write_text(json.dumps(answer, indent=2))


if __name__ == "__main__":
    tyro.cli(main)
