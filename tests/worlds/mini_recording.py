"""Tiny recordings for tests, written with plain code that shares nothing with the recorder."""

from pathlib import Path

import cv2
import numpy as np

from worlds.parts import R_BODY_CAM

WIDTH, HEIGHT = 64, 48
BEGIN_NS = 1_400_000_000_000_000_000
FRAME_NS, IMU_NS = 50_000_000, 5_000_000


def picture(seed: int, size: tuple[int, int] = (WIDTH, HEIGHT), color: bool = False) -> np.ndarray:
    """A textured image that depends on the seed only."""
    shape = (size[1], size[0], 3) if color else (size[1], size[0])
    return cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8), (5, 5), 1.0)


def camera_yaml(
    x_m: float = 0.0, extra: str = "", size: tuple[int, int] = (WIDTH, HEIGHT), is_rear: bool = False
) -> str:
    T = np.eye(4)
    T[:3, :3] = R_BODY_CAM
    T[:3, 3] = R_BODY_CAM @ [x_m, 0.0, 0.0]
    if is_rear:
        T[:2] *= -1.0
    return (
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {T.ravel().tolist()}\nrate_hz: 20\n"
        f"resolution: [{size[0]}, {size[1]}]\ncamera_model: pinhole\nintrinsics: [50.0, 51.0, 31.5, 23.5]\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 1e-4, 2e-4]\n{extra}"
    )


IMU_YAML = (
    "sensor_type: imu\nrate_hz: 200\ngyroscope_noise_density: 1.7e-04\ngyroscope_random_walk: 2e-5\n"
    "accelerometer_noise_density: 2e-3\naccelerometer_random_walk: 3e-3\n"
)


def write_camera(
    root: Path, name: str, count: int, x_m: float = 0.0, color: bool = False, seed: int = 0, is_rear: bool = False
) -> None:
    folder = root / name
    (folder / "data").mkdir(parents=True)
    (folder / "sensor.yaml").write_text(camera_yaml(x_m, is_rear=is_rear))
    rows = ["#timestamp [ns],filename"]
    for i in range(count):
        t_ns = BEGIN_NS + i * FRAME_NS
        assert cv2.imwrite(str(folder / "data" / f"{t_ns}.png"), picture(seed + i, color=color))
        rows.append(f"{t_ns},{t_ns}.png")
    (folder / "data.csv").write_text("\n".join(rows) + "\n")


def imu_rows(count: int) -> list[str]:
    """Rest: a gyro of small numbers that differ by row, gravity up."""
    return [f"{BEGIN_NS + i * IMU_NS},{i * 1e-6},0.0,-0.0,0.0,0.0,9.81" for i in range(count)]


def write_imu(root: Path, rows: list[str]) -> None:
    (root / "imu0").mkdir(parents=True)
    (root / "imu0" / "sensor.yaml").write_text(IMU_YAML)
    (root / "imu0" / "data.csv").write_text("\n".join(["#timestamp [ns],wx,wy,wz,ax,ay,az", *rows]) + "\n")


def write_asl(folder: Path, frames: int = 6, stereo: bool = True, color: bool = False, rear: bool = False) -> Path:
    """A recording of `frames` frames at 20 Hz with an IMU of 200 Hz over the same time; returns its mav0.

    With `rear` there is a camera that looks back.
    """
    root = folder / "mav0"
    write_camera(root, "cam0", frames, color=color)
    if stereo:
        write_camera(root, "cam1", frames, x_m=0.1, seed=100)
    if rear:
        write_camera(root, "cam2" if stereo else "cam1", frames, seed=200, is_rear=True)
    write_imu(root, imu_rows((frames - 1) * (FRAME_NS // IMU_NS) + 1))
    return root


def edit_lines(path: Path, change: dict[int, str | None]) -> None:
    """Replace lines by index (0: the header); None deletes one."""
    lines = path.read_text().splitlines()
    kept = [change.get(i, line) for i, line in enumerate(lines)]
    path.write_text("\n".join(line for line in kept if line is not None) + "\n")
