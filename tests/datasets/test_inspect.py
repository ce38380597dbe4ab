"""The doctor: every fault is found and told, and no damage gives a traceback."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from test_other_formats import write_kitti, write_tum, write_video

from vislam.config import CalibrationConfig
from vislam.core import (
    NO_IMAGE,
    Camera,
    DataError,
    Frame,
    MaskedRecording,
    Rig,
    UsageError,
    invert,
    se3_exp,
    so3_exp,
    so3_log,
)  # fmt: skip
from vislam.datasets import open_dataset
from vislam.datasets.calibration_text import camera_text
from vislam.datasets.camera_turns import fit_turns, follow_turns, judged_turns
from vislam.datasets.extrinsics import contradicted_extrinsics, judged_cameras
from vislam.datasets.inspect import Inspection, inspect
from vislam.live.replay import ReplaySource
from worlds.bag_writer import from_asl, types_of, write_bag
from worlds.mini_recording import BEGIN_NS, FRAME_NS, camera_yaml, edit_lines, imu_rows, picture, write_asl, write_imu
from worlds.room import ring


def told(inspection: Inspection, severity: str, what: str) -> bool:
    return any(f.severity == severity and what in f.what for f in inspection.findings)


def test_a_sound_recording_has_streams_and_no_error(tmp_path: Path) -> None:
    write_asl(tmp_path, frames=20, stereo=False)
    result = inspect(str(tmp_path))
    assert result.format == "euroc" and result.worst == "ok"
    streams = {s.name: s for s in result.streams}
    assert streams["cam0"].count == 20 and streams["cam0"].rate_hz == pytest.approx(20.0)
    assert streams["imu0"].count == 191 and streams["imu0"].rate_hz == pytest.approx(200.0)
    assert result.duration_s == pytest.approx(0.95) and result.size_bytes > 20 * 64 * 48 // 2
    assert told(result, "ok", "specific force 9.81 m/s^2 over")
    assert told(result, "ok", "every frame lies within the time of the IMU")
    assert told(result, "ok", "gravity is 0 deg from the vertical")


def test_what_becomes_of_sixteen_bits_is_said(tmp_path: Path) -> None:
    mav0 = write_asl(tmp_path / "folder", frames=20, stereo=False)
    for path in (mav0 / "cam0" / "data").iterdir():
        cv2.imwrite(str(path), 7000 + 6 * cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16))
    for source in (tmp_path / "folder", write_bag(tmp_path, "mcap", from_asl(mav0, types_of("mcap")))):
        assert told(inspect(str(source)), "ok", "decoded; of 16 bits")
        noise = CalibrationConfig(imu_noise=mav0 / "imu0" / "sensor.yaml")
        frames = [event for event in open_dataset(str(source), noise).events() if isinstance(event, Frame)]
        assert len(frames) == 20 and all(30.0 < frame.images[0].std() < 80.0 for frame in frames)


def test_every_fault_is_told_at_once(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=40)
    images = [root / "cam0" / "data" / f"{BEGIN_NS + i * FRAME_NS}.png" for i in range(40)]
    images[3].unlink()
    images[5].write_bytes(images[5].read_bytes()[:80])
    cv2.imwrite(str(images[7]), picture(0, (32, 24)))
    edit_lines(root / "cam1" / "data.csv", {9: None})
    edit_lines(root / "cam0" / "data.csv", dict.fromkeys(range(20, 33)))
    rows = imu_rows(200)
    rows[10], rows[11] = rows[9], rows[4]
    rows[20] = rows[20].replace("9.81", "nan")
    rows[30:130] = []
    (root / "imu0" / "data.csv").write_text("#t\n" + "\n".join(rows) + "\n12,3")
    result = inspect(str(tmp_path))
    assert result.worst == "error"
    assert told(result, "error", "cam0: 1 of 27: image of wrong size")
    assert told(result, "error", "is 32x24 but its calibration is for 64x48")
    for what in (
        "cam0: 1 of 27: missing image", "cam0: 1 of 27: unreadable image", "stereo image without partner",
        "imu: duplicate stamp", "imu: backward stamp", "rows with NaN or infinity (first: line 22)",
        "imu0: gap of 0.5", "cam0: gap of 0.70 s", "last line cut short", "frames lie outside the time of the IMU",
    ):  # fmt: skip
        assert told(result, "warning", what), what
    assert all(f.next_step for f in result.findings if f.severity == "warning")


@pytest.mark.parametrize(
    ("accel", "severity", "what"),
    [
        ("0.0,0.0,1.0", "error", "the unit seems to be g"),
        ("0.0,0.0,0.0", "error", "gravity is missing"),
        ("0.0,0.0,10.4", "warning", "expected 9.81"),
        ("0.0,0.0,-9.81", "warning", "gravity is 180 deg from the vertical"),
        ("9.81,0.0,0.0", "warning", "gravity is 90 deg from the vertical"),
    ],
)
def test_gravity_that_contradicts(tmp_path: Path, accel: str, severity: str, what: str) -> None:
    root = write_asl(tmp_path, frames=10, stereo=False)
    rows = [row.replace("0.0,0.0,9.81", accel) for row in imu_rows(100)]
    (root / "imu0" / "data.csv").write_text("#t\n" + "\n".join(rows) + "\n")
    assert told(inspect(str(tmp_path)), severity, what)


def test_stuck_samples_and_frozen_and_dark_images_are_named_with_their_times(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=60, stereo=False)
    names = [root / "cam0" / "data" / f"{BEGIN_NS + i * FRAME_NS}.png" for i in range(60)]
    assert not told(inspect(str(tmp_path)), "warning", "cam0")
    for path in names[10:20]:
        path.write_bytes(names[9].read_bytes())
    rng = np.random.default_rng(2)
    for path in names[40:50]:
        cv2.imwrite(str(path), rng.integers(0, 4, (48, 64)).astype(np.uint8))
    rows = imu_rows(600)
    stuck = rows[299].partition(",")[2]
    rows[300:400] = [f"{row.partition(',')[0]},{stuck}" for row in rows[300:400]]
    (root / "imu0" / "data.csv").write_text("\n".join(rows) + "\n")
    result = inspect(str(tmp_path))
    assert told(result, "warning", "imu0: stuck at one value from 1.50 to 2.00 s")
    assert told(result, "warning", "cam0: images that equal the one before from 0.50 to 0.95 s (10)")
    assert told(result, "warning", "cam0: dark or blank images from 2.00 to 2.50 s (10)")


def written(root: Path, rows: list[tuple[float, list[float]]]) -> Path:
    """A recording of 12 s whose IMU has the given rows, with times in seconds since the first frame."""
    mav0 = write_asl(root, frames=240, stereo=False)
    lines = [f"{BEGIN_NS + round(t_s * 1e9)}," + ",".join(map(repr, values)) for t_s, values in rows]
    (mav0 / "imu0" / "data.csv").write_text("#t\n" + "\n".join(lines) + "\n")
    return root


@pytest.mark.parametrize(
    ("changed", "what", "at_s"),
    [
        (lambda t, _: max(t, 5.3) if 5.0 < t < 5.3 else t, "rows that came together have stamps of their arrival", 5.0),
        (lambda t, _: t if t < 5 else (t * 0.699 + 1.505) // 1e-3 * 1e-3, "stamps are rounded, or set right", 5.0),
        (lambda t, _: t + 3.0 * (t > 5.0), "the clock stepped forth by", 5.0),
        (lambda t, _: t - 3.0 * (t > 5.0), "the clock stepped back by", 5.0),
        (lambda t, k: t - 6.0 * (k >= 1200), "played again from its first row, back by", 6.0),
        (lambda t, _: t + 500.0 * (t > 5.0), "another log follows, off by 500.0", 5.0),
    ],
)  # fmt: skip
def test_what_happens_to_the_clock_of_the_imu_is_named_with_its_time(tmp_path: Path, changed, what: str, at_s: float):
    rng = np.random.default_rng(5)
    values = [[*rng.normal(0.0, 0.01, 3), 0.0, rng.normal(0.0, 0.1), 9.81] for _ in range(1200)] * 2
    rows = [(changed(k * 0.005, k), list(map(float, row))) for k, row in enumerate(values)]
    result = inspect(str(written(tmp_path, rows)))
    (said,) = [f.what for f in result.findings if f.what.startswith(f"imu0: {what}") and f.severity == "warning"]
    assert float(re.search(r"(?:from|at) ([\d.]+)", said)[1]) == pytest.approx(at_s, abs=0.1)


def test_clipped_axes_and_images_out_of_focus_are_named_with_their_times(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    t_s = np.arange(0.0, 12.0, 0.005)
    gyro = np.column_stack([3.0 * np.sin(2.0 * t_s) * (np.abs(t_s - 6.0) < 1.6) + rng.normal(0.0, 0.01, len(t_s))] * 3)
    gyro[:, 0] = np.minimum(gyro[:, 0], 2.0)
    rows = [(float(t), [*map(float, w), 0.0, 0.0, 9.81]) for t, w in zip(t_s, gyro, strict=True)]
    root = written(tmp_path, rows)
    images = sorted((root / "mav0" / "cam0" / "data").glob("*.png"))
    for path in images[100:160]:
        cv2.imwrite(str(path), cv2.GaussianBlur(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (0, 0), 4.0))
    result = inspect(str(root))
    (clip,) = [f.what for f in result.findings if "the range ends where the motion does not" in f.what]
    begin_s, end_s = (float(text) for text in clip.split("from ")[1].split(" s ")[0].split(" to "))
    true_s = t_s[gyro[:, 0] == 2.0]
    assert (begin_s, end_s) == pytest.approx((true_s[0], true_s[-1]), abs=0.1)
    assert clip.startswith("imu0 gyro x: ")
    assert told(result, "warning", "cam0: images blurred all over from 5.00 to 8.00 s (60)")


def test_rates_units_and_clocks_that_do_not_fit(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=10, stereo=False)
    rows = [f"{BEGIN_NS + 10**12 + i * 50_000_000},0,0,60.0,0,0,9.81" for i in range(80)]
    (root / "imu0" / "data.csv").write_text("#t\n" + "\n".join(rows) + "\n")
    result = inspect(str(tmp_path))
    assert told(result, "ok", "imu0: 80 at 20.0 Hz")
    assert told(result, "warning", "imu0: another rate than the stated one from 1000.00 to 1003.10 s")
    assert told(result, "warning", "only 20 Hz of IMU")
    assert told(result, "error", "the unit seems to be deg/s")
    assert told(result, "error", "no frame lies within the time of the IMU")


def test_unusable_parts_do_not_hide_the_others(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=5)
    (root / "cam0" / "sensor.yaml").write_text("nonsense")
    (root / "imu0" / "data.csv").write_text("#t\n" + "x\n" * 50)
    (root / "mocap0").mkdir()
    (root / "mocap0" / "data.csv").write_text("1,nan,0,0,1,0,0,0\n" * 50)
    result = inspect(str(tmp_path))
    assert told(result, "error", "sensor.yaml must hold")
    assert told(result, "error", "imu0/data.csv:2")
    assert told(result, "warning", "truth cannot be used")
    assert {s.name for s in result.streams} == {"cam0", "cam1"}


def test_inertial_recording_is_looked_at(tmp_path: Path) -> None:
    write_imu(tmp_path / "mav0", imu_rows(300))
    result = inspect(str(tmp_path))
    assert told(result, "ok", "no camera: it runs by the IMU") and told(result, "ok", "specific force 9.81")


def test_other_formats(tmp_path: Path) -> None:
    tum = inspect(str(write_tum(tmp_path / "fr1_mini")))
    assert tum.worst != "error" and {s.name for s in tum.streams} == {"cam0", "depth0", "truth"}
    assert told(tum, "ok", "no IMU")
    kitti = inspect(str(write_kitti(tmp_path / "kitti")))
    assert {s.name for s in kitti.streams} == {"cam0", "cam1", "truth"}
    (tmp_path / "video").mkdir()
    path = write_video(tmp_path / "video")
    assert inspect(str(path)).worst == "ok"
    (tmp_path / "video" / "ride.yaml").write_text(camera_yaml(size=(32, 24)))
    assert told(inspect(str(path)), "error", "is 64x48")
    path.write_bytes(b"")
    assert told(inspect(str(path)), "error", "cannot be opened as a video")


def test_what_is_no_recording_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is empty"):
        inspect(str(tmp_path))
    with pytest.raises(UsageError, match="no format"):
        inspect("rosbag:x")


@pytest.mark.parametrize(
    "name", ["cam0/data.csv", "cam1/data.csv", "imu0/data.csv", "cam0/sensor.yaml", "imu0/sensor.yaml"]
)
@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"\xff\xfe" * 900, b"1,2,3\n" * 2000, b"a: {b: [1"])
def test_any_damage_is_a_finding_or_a_clean_error(tmp_path: Path, name: str, content: bytes) -> None:
    root = write_asl(tmp_path, frames=4)
    (root / name).write_bytes(content)
    assert inspect(str(tmp_path)).worst in ("warning", "error")
    (root / name).unlink()
    inspect(str(tmp_path))


SIZE = (320, 240)
CAMERA = Camera(*SIZE, 250.0, 250.0, 159.5, 119.5)


def turned_view(R_world_cam: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """The view of a far textured world: a pure rotation is a homography of one large picture."""
    world = picture(0, (900, 800))
    world = cv2.GaussianBlur(cv2.resize(cv2.resize(world, (300, 266)), (900, 800)), (5, 5), 0)
    K_world = np.array([[250.0, 0, 449.5], [0, 250.0, 399.5], [0, 0, 1]])
    H = CAMERA.K @ R_world_cam.T @ np.linalg.inv(K_world)
    return cv2.warpPerspective(world, H, SIZE)


def test_turn_seen_by_camera_and_gyro() -> None:
    R_body_cam = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rate = np.array([0.2, -0.5, 0.6])
    rows = [(i * 10_000_000, [*rate, 0.0, 0.0, 9.81]) for i in range(120)]
    t_ns = np.arange(5_000_000, 1_000_000_000, 50_000_000)
    images = [turned_view(R_body_cam.T @ so3_exp(rate * (i % 4) * 0.05) @ R_body_cam) for i in range(20)]
    places = [[range(first, first + 4)] for first in range(0, 20, 4)]  # each turns by the same 0.15 s
    tracks = follow_turns(places, t_ns, lambda frame: [images[frame]])
    right = fit_turns(CAMERA, R_body_cam, tracks, rows, np.zeros(3))
    wrong = fit_turns(CAMERA, R_body_cam.T, tracks, rows, np.zeros(3))
    assert right is not None and right.places == 5 and right.differ < 0.1
    turn = so3_exp(rate * 0.15)
    expected = np.linalg.norm(so3_log(R_body_cam @ turn.T @ R_body_cam.T @ R_body_cam.T @ turn @ R_body_cam))
    assert wrong is not None and wrong.differ > 0.5
    assert wrong.differ == pytest.approx(expected / np.linalg.norm(rate * 0.15), abs=0.1)
    for R, tried in ((R_body_cam.T, "with the inverse they differ by"), (np.diag([1.0, -1, -1]) @ R_body_cam, "check")):
        (judged,) = judged_turns(CAMERA, R, tracks, lambda: rows, np.zeros(3))
        assert judged.severity == "error" and judged.next_step.startswith(tried)
    at_rest = [(t, [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]) for t, _ in rows]
    still = follow_turns(places, t_ns, lambda _: [images[0]])
    assert len(still) == 5 and fit_turns(CAMERA, R_body_cam, still, at_rest, np.zeros(3)) is None
    assert fit_turns(CAMERA, R_body_cam, tracks, rows[:5], np.zeros(3)) is None  # too thin
    assert follow_turns(places, t_ns, lambda frame: [images[frame]] if frame % 4 else []) == []  # lost images


def test_what_explains_a_pair_that_does_not_fit_is_tried() -> None:
    T0, T01 = se3_exp(np.array([0.5, 0.3, -1.0, 0.3, -0.2, 0.1])), se3_exp(np.array([0.0, 0.1, 0.06, 0.1, 0.02, 0.0]))
    R = T01[:3, :3]
    left, right = turned_view(np.eye(3)), np.roll(turned_view(R), -10, axis=1)  # about as 2.5 m away
    for T_body_cams, images, step in (
        ((T0, T0 @ T01), (left, right), ""),
        ((invert(T0), invert(T0 @ T01)), (left, right), "write the inverse of both T_BS ("),
        ((T0, T0 @ invert(T01)), (left, right), "write the inverse of cam1's pose in cam0 ("),
        ((T0, T0 @ T01), (right, left), "write the inverse of cam1's pose in cam0 ("),
        ((T0, T0 @ T01), (left, np.rot90(right, 2).copy()), "check T_BS of both cameras"),
    ):
        (found,) = judged_cameras(Rig((CAMERA, CAMERA), T_body_cams), [images])
        assert found.next_step.startswith(step) and (found.severity == "ok") == (not step), found
        assert ("or swap their images (" in found.next_step) == ("pose in cam0" in step)
        assert step or re.search(r"9\d % of (\d+) matches", found.what)
    unlike = replace(CAMERA, cx=CAMERA.cx + 12.0)  # only the cables then explain it
    rig, shown = Rig((CAMERA, unlike), (T0, T0 @ T01)), (left, np.roll(right, 12, axis=1))
    swapped = shown[::-1]
    for pairs, step in (
        ([swapped], "swap their images ("),
        ([shown, swapped, swapped], "swap their images in 2 of 3 "),
    ):
        (found,) = judged_cameras(rig, pairs)
        assert found.next_step.startswith(step) and found.severity == "error"


def test_a_run_asks_what_it_saw_and_recordings_within_others(tmp_path: Path) -> None:
    T0, T01 = np.eye(4), se3_exp(np.array([0.0, 0.1, 0.06, 0.1, 0.02, 0.0]))
    left, right = turned_view(np.eye(3)), np.roll(turned_view(T01[:3, :3]), -10, axis=1)
    for name, T, image in (("cam0", T0, left), ("cam1", T0 @ invert(T01), right)):
        (tmp_path / "mav0" / name / "data").mkdir(parents=True)
        (tmp_path / "mav0" / name / "sensor.yaml").write_text(camera_text(CAMERA, T, ""))
        stamps = [BEGIN_NS + i * FRAME_NS for i in range(6)]
        (tmp_path / "mav0" / name / "data.csv").write_text("".join(f"{t},{t}.png\n" for t in stamps))
        for t in stamps:
            cv2.imwrite(str(tmp_path / "mav0" / name / "data" / f"{t}.png"), image)
    write_imu(tmp_path / "mav0", imu_rows(60))
    recording = open_dataset(str(tmp_path))
    (said,) = contradicted_extrinsics(recording, [(right, left)])  # on disk
    assert "the extrinsics do not fit: write the inverse of " in said and "or swap their images (" in said
    masked = MaskedRecording(MaskedRecording(recording, lambda frame: ()), lambda frame: ())
    for played in (masked, ReplaySource(str(tmp_path))):
        assert contradicted_extrinsics(played, []) == (said,)
        assert contradicted_extrinsics(played, [(right, left)] * 3) == ()  # what the run saw was swapped, and fits
    sensors = SimpleNamespace(rig=recording.rig)  # nothing on disk
    (seen,) = contradicted_extrinsics(sensors, [(left, right)] * 3)
    assert seen.partition("lines")[2] == said.partition("lines")[2] and contradicted_extrinsics(sensors, []) == ()


def test_cameras_that_show_the_same_are_named_where_they_look_past_each_other() -> None:
    rig = ring(180.0)
    ahead, behind = (picture_of(k, rig.cameras[0]) for k in (1, 2))
    assert [f.severity for f in judged_cameras(rig, [(ahead, behind)] * 3)] == ["ok"]
    found = judged_cameras(rig, [(ahead, ahead)] * 3)
    assert [f.severity for f in found] == ["error"] and "cam0 and cam1 show the same" in found[0].what
    assert judged_cameras(rig, [(ahead, NO_IMAGE), ()])[0].severity == "ok"


def picture_of(seed: int, camera: Camera) -> np.ndarray:
    """Return an image that no other seed's looks like."""
    noise = np.random.default_rng(seed).integers(0, 255, (camera.height // 8, camera.width // 8), dtype=np.uint8)
    return cv2.resize(noise, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
