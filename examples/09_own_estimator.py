"""9. Your own estimator beside vislam's: two doors, an answer, and the same measurements, seeds and statistics.

    python examples/09_own_estimator.py

Stereo odometry of a page: the points of a frame are laid onto those of the last one, and the motions chained.
`vislam compare PLAN --estimator examples/09_own_estimator.py` runs it in any plan whose world has two cameras' tracks.
"""

import csv
import tempfile
from pathlib import Path

import numpy as np

from vislam.core import Frame, ImuSample, Observations, align_points, level_rotation, transform
from vislam.experiment import CompareOptions, Setup, run_comparison
from vislam.trajectory import Trajectory

PLAN = """
name = "own"
config = {"loop.enabled" = false}
seeds = [0, 1]
members = 1
sequences = [{name = "laps", source = "points:laps", options = {rig = "stereo", duration_s = 5.0, camera_hz = 10.0}}]
estimators = [{name = "vislam", outputs = ["ekf"]}, {name = "mine", program = "PROGRAM", options = {keep = 0.7}}]
"""


class StereoOdometry:
    """Chains the rigid motions between the triangulated points of one frame and the next."""

    def __init__(self, setup: Setup, keep: float) -> None:
        self.rig, self.keep = setup.rig, keep  # keep: share of the points that fit best
        self.up, self.T_world_body, self.points, self.poses = np.zeros(3), None, {}, []

    def inertial(self, sample: ImuSample) -> None:
        self.up += sample.accel_m_s2 if self.T_world_body is None else 0.0  # which way is up at the start

    def frame(self, frame: Frame) -> np.ndarray:
        points = self.triangulated(frame.tracks)
        if self.T_world_body is None:
            self.T_world_body = transform(level_rotation(self.up), np.zeros(3))
        common = [i for i in points if i in self.points]
        now, before = (np.array([where[i] for i in common]) for where in (points, self.points))
        if len(common) >= 10:
            for _ in range(2):  # a second time without what fits worst
                T = align_points(now, before)
                errors_m = np.linalg.norm(now @ T[:3, :3].T + T[:3, 3] - before, axis=1)
                now, before = (p[errors_m <= np.quantile(errors_m, self.keep)] for p in (now, before))
            self.T_world_body = self.T_world_body @ T
        self.points = points
        self.poses.append((frame.t_ns, self.T_world_body))
        return self.T_world_body

    def answer(self) -> Trajectory:
        return Trajectory(*map(np.array, zip(*self.poses, strict=True)))  # nothing is known better in the end

    def triangulated(self, seen: Observations) -> dict[int, np.ndarray]:
        """Return points in the body frame by track: those of cam0's rays that come nearest to cam1's."""
        (u, p), (v, q) = ((camera.unproject(px) @ T[:3, :3].T, T[:3, 3]) for camera, px, T in zip(
            self.rig.cameras, (seen.pixels_px, seen.right_px), self.rig.T_body_cams, strict=True))  # fmt: skip
        uu, uv, vv = (u * u).sum(axis=1), (u * v).sum(axis=1), (v * v).sum(axis=1)
        s = (uv * (v @ (p - q)) - vv * (u @ (p - q))) / (uu * vv - uv**2)
        good = (s > 0.2) & (s < 12.0)  # NaN is neither
        return dict(zip(seen.track_ids[good].tolist(), (p + s[:, None] * u)[good], strict=True))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        plan = Path(folder) / "plan.toml"
        plan.write_text(PLAN.replace("PROGRAM", str(Path(__file__).resolve())))
        places = {"out": Path(folder) / "out", "store": Path(folder) / "results.db", "cache": Path(folder) / "cache"}
        run_comparison(CompareOptions(plan, **places), ["examples/09_own_estimator.py"])
        rows = list(csv.DictReader((places["out"] / "runs.csv").open()))  # report.html beside it has the pictures
    for row in rows:
        print(f"{row['estimator']:7} {row['output']:7} seed {row['seed']}  ATE {100 * float(row['ate_m']):5.2f} cm")
    assert {row["estimator"] for row in rows if row["status"] == "ok"} == {"vislam", "mine"}
