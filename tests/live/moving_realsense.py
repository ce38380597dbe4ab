"""A RealSense that stands before a painted wall and goes to and fro: its images and its IMU tell the same motion.

What is done to it stands in files of a folder, for it lives in another process: `go` has the time of CLOCK_MONOTONIC
[ns] when it begins to move, `unplugged` is there while it is unplugged; it leaves `stopped` when it was given back.
"""

from pathlib import Path

import cv2
import numpy as np

from tests.hw.fake_realsense import ANGLE, BASELINE_M, World

AMPLITUDE_M, PERIOD_S = 0.25, 3.0
NOISE = np.repeat([3e-3, 3e-2], 3)  # of one sample
WALL_M, PX_PER_M = 2.0, 250.0
K = np.array([[380.0, 0.0, 319.5], [0.0, 381.0, 239.5], [0.0, 0.0, 1.0]])


class MovingWorld(World):
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        super().__init__()
        self.period_s = 1.0 / 15.0
        self.rng = np.random.default_rng(5)
        rough = [
            cv2.resize(self.rng.random((n, n)), (1600, 1600), interpolation=cv2.INTER_CUBIC) for n in (25, 100, 300)
        ]
        self.wall = np.clip(255.0 * sum(rough) / 3.0, 0, 255).astype(np.uint8)
        self.grain = self.rng.integers(0, 6, (5, 480, 640), dtype=np.uint8)  # without, it would look stuck at rest
        self.motion, self.picture = self.moved, self.seen
        self.began_ns = 0

    @property
    def running(self) -> int:
        return self.pipelines

    @running.setter
    def running(self, value: int) -> None:
        if value < getattr(self, "pipelines", 0):
            (self.folder / "stopped").touch()
        self.pipelines = value

    @property
    def unplugged(self) -> bool:
        return (self.folder / "unplugged").exists()

    @unplugged.setter
    def unplugged(self, value: bool) -> None:
        assert not value

    def phase(self, t_ns: int) -> float:
        """Angle of the motion at a time, 0 before it begins."""
        if self.began_ns == 0 and (self.folder / "go").exists():
            self.began_ns = int((self.folder / "go").read_text() or 0)
        is_moving = 0 < self.began_ns < t_ns
        return (t_ns - self.began_ns) * 1e-9 * 2.0 * np.pi / PERIOD_S if is_moving else -1.0

    def moved(self, t_ns: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        phase = self.phase(t_ns)
        accel = AMPLITUDE_M * (2.0 * np.pi / PERIOD_S) ** 2 * np.cos(phase) if phase > 0.0 else 0.0
        noise = NOISE * self.rng.standard_normal(6)
        return tuple(noise[:3]), (accel + noise[3], -9.81 + noise[4], noise[5])

    def seen(self, stream: str, index: int, t_ns: int) -> np.ndarray:
        """The wall, 2 m ahead, from where the camera is."""
        phase = self.phase(t_ns)
        x_m = AMPLITUDE_M * (1.0 - np.cos(phase)) if phase > 0.0 else 0.0
        if stream == "depth":
            return np.full((480, 640), round(WALL_M * 1000), np.uint16)
        R, t = np.eye(3), np.array([-x_m, 0.0, 0.0])
        if index == 2:
            c, s = np.cos(ANGLE), np.sin(ANGLE)
            R_2_1 = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
            R, t = R_2_1, R_2_1 @ t + np.array([-BASELINE_M, 0.0, 0.0])
        wall = np.column_stack([R[:, 0], R[:, 1], WALL_M * R[:, 2] + t])
        pixels = np.array([[1.0, 0.0, -800.0], [0.0, 1.0, -800.0], [0.0, 0.0, PX_PER_M]]) / PX_PER_M
        image = cv2.warpPerspective(self.wall, K @ wall @ pixels, (640, 480))
        image = cv2.add(image, self.grain[self.number % 5])
        return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if stream == "color" else image
