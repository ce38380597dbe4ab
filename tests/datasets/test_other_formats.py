"""TUM RGB-D, KITTI odometry and plain video, on tiny recordings."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.config import CalibrationConfig
from vislam.core.errors import DataError
from vislam.core.messages import Frame, ImuSample
from vislam.datasets import open_dataset
from worlds.mini_recording import HEIGHT, IMU_YAML, WIDTH, camera_yaml, imu_rows, picture

SIZE = (640, 480)  # of the benchmark's published cameras


def write_tum(folder: Path, size: tuple[int, int] = SIZE) -> Path:
    """Four colour images at 30 Hz; depth 10 ms after frames 0 and 2, and 25 ms after frame 3."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    stamps = [1305031452.791720 + i / 30 for i in range(4)]
    rgb, depth = ["# color images"], ["# depth maps"]
    for i, t in enumerate(stamps):
        cv2.imwrite(str(folder / "rgb" / f"{i}.png"), picture(i, size, color=True))
        rgb.append(f"{t:.6f} rgb/{i}.png")
    for i, t in ((0, stamps[0] + 0.01), (2, stamps[2] + 0.01), (3, stamps[3] + 0.025)):
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.full((size[1], size[0]), 5000 * (i + 1), np.uint16))
        depth.append(f"{t:.6f} depth/{i}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    (folder / "groundtruth.txt").write_text("# t\n" + f"{stamps[0]:.4f} 1 2 3 0 0 0 1\n{stamps[2]:.4f} 1 2 4 0 0 1 0\n")
    return folder


@pytest.mark.parametrize(
    ("name", "fx", "coefficients"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.306408, 5),
        ("fr2_xyz", 520.908620, 5),
        ("rgbd_dataset_freiburg3_office", 535.4, 0),
    ],
)
def test_tum_uses_the_published_camera_of_its_name(tmp_path: Path, name: str, fx: float, coefficients: int) -> None:
    recording = open_dataset(str(write_tum(tmp_path / name)))
    camera = recording.rig.cameras[0]
    assert (camera.fx, len(camera.coefficients)) == (fx, coefficients)
    assert recording.rig.has_depth and recording.imu_noise is None
    np.testing.assert_array_equal(recording.rig.T_body_cams[0], np.eye(4))


def test_tum_yields_every_color_frame_with_the_depth_that_is_near(tmp_path: Path) -> None:
    recording = open_dataset(str(write_tum(tmp_path / "fr1_mini")))
    frames = list(recording.events())
    assert len(frames) == recording.frame_count == 4
    assert all(isinstance(f, Frame) for f in frames)
    assert frames[0].t_ns == 1305031452791720000
    assert [None if f.depth_m is None else float(f.depth_m[7, 9]) for f in frames] == [1.0, None, 3.0, None]
    assert [round(f.depth_lag_s, 6) for f in frames if isinstance(f, Frame)] == [0.01, 0.0, 0.01, 0.0]
    assert np.array_equal(frames[1].color, picture(1, SIZE, color=True))
    assert recording.problems == {"frame without depth": 2}
    truth = recording.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_body[1, :3, 3], [1, 2, 4])
    np.testing.assert_allclose(truth.T_world_body[1, :3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


def test_tum_folder_of_no_known_camera_wants_a_calibration(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "my_kinect", (WIDTH, HEIGHT))
    with pytest.raises(DataError, match=r"write .*my_kinect/sensor.yaml with T_BS: .*depth_units_per_m"):
        open_dataset(str(folder))
    (folder / "sensor.yaml").write_text(camera_yaml(extra="depth_units_per_m: 1000\n"))
    recording = open_dataset(str(folder))
    assert recording.rig.cameras[0].fx == 50.0
    first = next(iter(recording.events()))
    assert float(first.depth_m[0, 0]) == 5.0
    orb = tmp_path / "orb.yaml"
    lens = "Camera.fx: 50.0\nCamera.fy: 50.0\nCamera.cx: 31.5\nCamera.cy: 23.5\nCamera.bf: 4.0"
    orb.write_text(f"{lens}\nCamera.width: {WIDTH}\nCamera.height: {HEIGHT}\nDepthMapFactor: 2000.0\n")
    first = next(iter(open_dataset(str(folder), CalibrationConfig(camera=str(orb))).events()))
    assert float(first.depth_m[0, 0]) == 2.5


def write_kitti(folder: Path, count: int = 3) -> Path:
    sequence = folder / "sequences" / "07"
    for camera in (0, 1):
        (sequence / f"image_{camera}").mkdir(parents=True)
        for i in range(count):
            cv2.imwrite(str(sequence / f"image_{camera}" / f"{i:06d}.png"), picture(10 * camera + i))
    P = "718.856 0 60.5 {} 0 718.856 18.5 0 0 0 1 0"
    (sequence / "calib.txt").write_text(f"P0: {P.format(0)}\nP1: {P.format(-386.1448)}\nTr: 1 0\n")
    (sequence / "times.txt").write_text("".join(f"{i * 0.1036224:e}\n" for i in range(count)))
    (folder / "poses").mkdir()
    row = "1 0 0 {} 0 1 0 0 0 0 1 2"
    (folder / "poses" / "07.txt").write_text("".join(row.format(i) + "\n" for i in range(count)))
    return sequence


def test_kitti_stereo_with_truth(tmp_path: Path) -> None:
    recording = open_dataset(str(write_kitti(tmp_path)))
    frames = list(recording.events())
    assert [f.t_ns for f in frames] == [0, 103622400, 207244800]
    assert np.array_equal(frames[2].images[1], picture(12))
    camera = recording.rig.cameras[0]
    assert (camera.width, camera.fx, camera.cx, camera.distortion) == (WIDTH, 718.856, 60.5, "none")
    np.testing.assert_allclose(recording.rig.T_cam0_cam1[:3, 3], [386.1448 / 718.856, 0, 0])
    truth = recording.truth()
    assert truth is not None and recording.imu_noise is None
    np.testing.assert_allclose(truth.T_world_body[2, :3, 3], [2, 0, 2])


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("times.txt", "0.0\nx\n", "times.txt:2: not a time"),
        ("times.txt", "0.0\n0.2\n0.1\n", "times.txt:3: time 0.1 s does not rise"),
        ("calib.txt", "P0: 1 2 3\n", "no usable line `P0"),
    ],
)
def test_kitti_with_damage_names_the_line(tmp_path: Path, file: str, text: str, message: str) -> None:
    sequence = write_kitti(tmp_path)
    (sequence / file).write_text(text)
    with pytest.raises(DataError, match=message):
        open_dataset(str(sequence))


def test_kitti_without_an_image_skips_it(tmp_path: Path) -> None:
    sequence = write_kitti(tmp_path)
    (sequence / "image_1" / "000001.png").unlink()
    recording = open_dataset(f"kitti:{sequence}")
    assert len(list(recording.events())) == 2
    assert recording.problems == {"missing image (first: image_1/000001.png)": 1}


def write_video(folder: Path, count: int = 5) -> Path:
    path = folder / "ride.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (WIDTH, HEIGHT))
    for i in range(count):
        writer.write(np.full((HEIGHT, WIDTH, 3), 40 * i, np.uint8))
    writer.release()
    (folder / "ride.csv").write_text("timestamp\n" + "".join(f"{1000 + i * 50}\n" for i in range(count)))
    (folder / "ride.yaml").write_text(camera_yaml())
    return path


def test_video_with_stamps_and_imu(tmp_path: Path) -> None:
    path = write_video(tmp_path)
    (tmp_path / "ride.imu.csv").write_text("#t\n" + "\n".join(imu_rows(3)) + "\n")
    (tmp_path / "ride.imu.yaml").write_text(IMU_YAML)
    recording = open_dataset(str(path))
    events = list(recording.events())
    frames = [e for e in events if isinstance(e, Frame)]
    assert [f.t_ns for f in frames] == [1000, 1050, 1100, 1150, 1200]
    assert [abs(float(f.images[0].mean()) - 40 * i) < 5 for i, f in enumerate(frames)] == [True] * 5
    assert frames[0].color is not None and frames[0].color.shape == (HEIGHT, WIDTH, 3)
    assert sum(isinstance(e, ImuSample) for e in events) == 3
    assert recording.problems == {}


def test_video_keeps_stamps_and_frames_together_when_a_stamp_is_bad(tmp_path: Path) -> None:
    path = write_video(tmp_path)
    (tmp_path / "ride.csv").write_text("timestamp\n1000\nbroken7\n1100\n1150\n1200\n1250\n")
    recording = open_dataset(str(path))
    frames = list(recording.events())
    assert [(f.t_ns, round(float(f.images[0].mean()) / 40)) for f in frames] == [
        (1000, 0),
        (1100, 2),
        (1150, 3),
        (1200, 4),
    ]
    assert sum(recording.problems.values()) == 2  # the bad stamp, and the stamp without a frame


@pytest.mark.parametrize(
    ("missing", "message"),
    [("ride.csv", "write one row a frame"), ("ride.yaml", "write the calibration into it")],
)
def test_video_says_what_to_write_beside_it(tmp_path: Path, missing: str, message: str) -> None:
    path = write_video(tmp_path)
    (tmp_path / missing).unlink()
    with pytest.raises(DataError, match=f"{missing} is missing; {message}"):
        open_dataset(str(path))


def test_video_that_is_none_or_of_another_size(tmp_path: Path) -> None:
    path = write_video(tmp_path)
    (tmp_path / "ride.yaml").write_text(camera_yaml(size=(32, 24)))
    with pytest.raises(DataError, match=r"ride.avi is 64x48 but its calibration is for 32x24"):
        open_dataset(str(path))
    path.write_bytes(b"no video")
    with pytest.raises(DataError, match="cannot be opened as a video"):
        open_dataset(str(path))
