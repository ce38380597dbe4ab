"""ASL folders: values, order, re-expression in the IMU frame, and every fault a recording comes with."""

import itertools
import threading
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.core.errors import DataError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.recording import with_camera
from vislam.datasets import open_dataset
from worlds.mini_recording import (
    BEGIN_NS,
    FRAME_NS,
    HEIGHT,
    IMU_NS,
    IMU_YAML,
    WIDTH,
    camera_yaml,
    edit_lines,
    imu_rows,
    picture,
    write_asl,
    write_camera,
    write_imu,
)
from worlds.parts import R_BODY_CAM


def frames_of(recording) -> list[Frame]:
    return [value for value in recording.events() if isinstance(value, Frame)]


def imu_of(recording) -> list[ImuSample]:
    return [value for value in recording.events() if isinstance(value, ImuSample)]


def test_stereo_recording_gives_what_was_written(tmp_path: Path) -> None:
    write_asl(tmp_path, frames=6)
    recording = open_dataset(f"euroc:{tmp_path}")
    assert recording.name == tmp_path.name and recording.frame_count == 6
    camera = recording.rig.cameras[0]
    assert (camera.width, camera.height, camera.fx, camera.cy) == (WIDTH, HEIGHT, 50.0, 23.5)
    assert camera.distortion == "radtan" and camera.coefficients == (-0.1, 0.01, 1e-4, 2e-4)
    np.testing.assert_allclose(recording.rig.T_cam0_cam1[:3, 3], [0.1, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(recording.rig.T_body_cams[0][:3, :3], R_BODY_CAM)
    assert recording.imu_noise is not None and recording.imu_noise.accelerometer_random_walk == 3e-3
    frames = frames_of(recording)
    assert [f.t_ns for f in frames] == [BEGIN_NS + i * FRAME_NS for i in range(6)]
    assert [f.index for f in frames] == list(range(6))
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.images[0], picture(i)) and np.array_equal(frame.images[1], picture(100 + i))
        assert frame.color is None and frame.depth_m is None
    samples = imu_of(recording)
    assert len(samples) == 51
    np.testing.assert_array_equal(samples[7].gyro_rad_s, [7e-6, 0.0, 0.0])
    np.testing.assert_array_equal(samples[7].accel_m_s2, [0.0, 0.0, 9.81])
    assert recording.problems == {} and recording.truth() is None


def test_time_order_with_imu_before_a_frame_of_the_same_stamp(tmp_path: Path) -> None:
    write_asl(tmp_path, frames=4)
    events = list(open_dataset(str(tmp_path)).events())
    keys = [(e.t_ns, isinstance(e, Frame)) for e in events]
    assert keys == sorted(keys) and len(keys) == 31 + 4


@pytest.mark.parametrize("path", ["", "mav0"])
def test_the_folder_or_its_mav0_may_be_given(tmp_path: Path, path: str) -> None:
    write_asl(tmp_path, frames=2)
    assert open_dataset(str(tmp_path / path)).frame_count == 2


def test_a_second_pass_gives_the_same_and_counts_anew(tmp_path: Path) -> None:
    root = write_asl(tmp_path)
    (root / "cam0" / "data" / f"{BEGIN_NS + 2 * FRAME_NS}.png").unlink()
    recording = open_dataset(str(tmp_path))
    first = [(e.t_ns, type(e)) for e in recording.events()]
    counts = dict(recording.problems)
    assert [(e.t_ns, type(e)) for e in recording.events()] == first
    assert recording.problems == counts and sum(counts.values()) == 1


def test_abandoned_pass_leaves_no_thread(tmp_path: Path) -> None:
    write_asl(tmp_path, frames=30, stereo=False)
    running = threading.active_count()
    events = open_dataset(str(tmp_path)).events()
    for _ in range(20):
        next(events)
    assert threading.active_count() > running
    events.close()
    assert threading.active_count() == running


def test_unpaired_stereo_images_are_skipped_and_counted(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=6)
    edit_lines(root / "cam1" / "data.csv", {2: None})  # frame 1 has no right image
    edit_lines(root / "cam0" / "data.csv", {6: None})  # frame 5 has no left one
    recording = open_dataset(str(tmp_path))
    assert recording.frame_count == 4
    assert [(f.t_ns - BEGIN_NS) // FRAME_NS for f in frames_of(recording)] == [0, 2, 3, 4]
    assert recording.problems == {"stereo image without partner": 2}


@pytest.mark.parametrize("stereo", [True, False])
def test_a_camera_that_looks_elsewhere_may_lack_images(stereo: bool, tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=5, stereo=stereo, rear=True)
    rear = root / ("cam2" if stereo else "cam1")
    edit_lines(rear / "data.csv", {2: None})
    (rear / "data" / f"{BEGIN_NS + 3 * FRAME_NS}.png").write_text("no image")
    recording = open_dataset(str(tmp_path))
    frames = frames_of(recording)
    assert recording.rig.is_stereo == stereo and recording.rig.further == (len(recording.rig.cameras) - 1,)
    assert [(f.t_ns - BEGIN_NS) // FRAME_NS for f in frames] == [0, 1, 2, 3, 4]
    assert [f.images[-1].size > 0 for f in frames] == [True, False, True, False, True]
    assert all(image.size for f in frames for image in f.images[:-1])
    assert [key.split(" (")[0] for key in recording.problems] == [
        f"frame without an image of {rear.name}, or the reverse", "unreadable image",
    ]  # fmt: skip


def test_stereo_stamps_may_differ_by_little(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=3)
    stamps = [BEGIN_NS + i * FRAME_NS for i in range(3)]
    rows = [f"{stamps[0] + 1_900_000},{stamps[0]}.png", f"{stamps[1] + 2_100_000},{stamps[1]}.png"]
    edit_lines(root / "cam1" / "data.csv", {1: rows[0], 2: rows[1]})
    recording = open_dataset(str(tmp_path))
    assert [f.t_ns for f in frames_of(recording)] == [stamps[0], stamps[2]]


def test_missing_and_unreadable_images_are_skipped_and_counted(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=6)
    images = [root / "cam0" / "data" / f"{BEGIN_NS + i * FRAME_NS}.png" for i in range(6)]
    images[1].unlink()
    images[3].write_bytes(images[3].read_bytes()[:50])
    (root / "cam1" / "data" / images[4].name).write_text("no image")
    recording = open_dataset(str(tmp_path))
    frames = frames_of(recording)
    assert [(f.t_ns - BEGIN_NS) // FRAME_NS for f in frames] == [0, 2, 5]
    assert [f.index for f in frames] == [0, 1, 2]
    assert recording.problems == {
        f"missing image (first: mav0/cam0/data/{images[1].name})": 1,
        f"unreadable image (first: mav0/cam0/data/{images[3].name})": 2,
    }


def test_recording_cut_short(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=6)
    for name in ("imu0", "cam0"):
        table = root / name / "data.csv"
        table.write_bytes(table.read_bytes()[:-12])  # half a last line
    for i in (4, 5):  # the list is longer than the files
        (root / "cam1" / "data" / f"{BEGIN_NS + i * FRAME_NS}.png").unlink()
    recording = open_dataset(str(tmp_path))
    assert len(frames_of(recording)) == 4
    assert recording.problems["imu0/data.csv: last line cut short (first: line 52)"] == 1
    assert len(imu_of(recording)) == 50


def test_backward_and_duplicate_imu_stamps_are_dropped(tmp_path: Path) -> None:
    root = write_asl(tmp_path)
    rows = imu_rows(51)
    rows[10] = rows[9]
    rows[20] = rows[15].replace("9.81", "55.0")
    write_lines = ["#t", *rows]
    (root / "imu0" / "data.csv").write_text("\n".join(write_lines) + "\n")
    recording = open_dataset(str(tmp_path))
    samples = imu_of(recording)
    assert len(samples) == 49 and all(a.t_ns < b.t_ns for a, b in itertools.pairwise(samples))
    assert all(s.accel_m_s2[2] == 9.81 for s in samples)
    assert recording.problems == {
        f"imu: duplicate stamp (first: {BEGIN_NS + 9 * IMU_NS} ns)": 1,
        f"imu: backward stamp (first: {BEGIN_NS + 15 * IMU_NS} ns)": 1,
    }


def test_nan_in_a_csv_is_dropped_and_named(tmp_path: Path) -> None:
    root = write_asl(tmp_path)
    edit_lines(root / "imu0" / "data.csv", {5: imu_rows(5)[4].replace("9.81", "nan")})
    recording = open_dataset(str(tmp_path))
    samples = imu_of(recording)
    assert len(samples) == 50 and all(np.all(np.isfinite(s.accel_m_s2)) for s in samples)
    assert recording.problems == {"imu0/data.csv: rows with NaN or infinity (first: line 6)": 1}


def test_a_csv_of_nan_is_an_error_with_file_and_line(tmp_path: Path) -> None:
    root = write_asl(tmp_path)
    lines = [row.replace("9.81", "nan") for row in imu_rows(51)]
    (root / "imu0" / "data.csv").write_text("#t\n" + "\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"imu0/data.csv:2: .* 51 of the 51"):
        list(open_dataset(str(tmp_path)).events())


def test_gaps_pass_through_and_are_told(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=100, stereo=False)
    rows = imu_rows(991)
    write = [row for i, row in enumerate(rows) if not 200 < i < 404]
    (root / "imu0" / "data.csv").write_text("#t\n" + "\n".join(write) + "\n")
    edit_lines(root / "cam0" / "data.csv", dict.fromkeys(range(20, 80)))
    recording = open_dataset(str(tmp_path))
    assert len(frames_of(recording)) == 40
    t0 = BEGIN_NS * 1e-9
    assert recording.problems == {
        f"imu0: gap of 1.02 s at t={t0 + 1.0:.3f} s": 1,
        f"cam0: gap of 3.05 s at t={t0 + 18 * 0.05:.3f} s": 1,
    }


def test_calibration_of_the_wrong_size_says_asked_and_got(tmp_path: Path) -> None:
    root = write_asl(tmp_path)
    (root / "cam1" / "sensor.yaml").write_text(camera_yaml(0.1, size=(752, 480)))
    with pytest.raises(DataError, match=r"cam1/data/\d+.png is 64x48 but its calibration is for 752x480"):
        open_dataset(str(tmp_path))


def test_a_single_image_of_another_size_is_an_error_when_met(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=6)
    cv2.imwrite(str(root / "cam0" / "data" / f"{BEGIN_NS + 4 * FRAME_NS}.png"), picture(0, (32, 24)))
    events = open_dataset(str(tmp_path)).events()
    with pytest.raises(DataError, match="is 32x24"):
        list(events)


def test_color_recording_keeps_color(tmp_path: Path) -> None:
    write_asl(tmp_path, frames=2, stereo=False, color=True)
    frame = frames_of(open_dataset(str(tmp_path)))[1]
    assert frame.color is not None and np.array_equal(frame.color, picture(1, color=True))


def test_depth_magnetometer_skew_and_equidistant(tmp_path: Path) -> None:
    root = tmp_path / "mav0"
    write_camera(root, "cam0", 3)
    text = camera_yaml(extra="skew_px: 0.25\n").replace("radial-tangential", "equidistant")
    (root / "cam0" / "sensor.yaml").write_text(text)
    (root / "depth0" / "data").mkdir(parents=True)
    (root / "depth0" / "sensor.yaml").write_text("sensor_type: depth\ndepth_units_per_m: 2000\n")
    raw = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    cv2.imwrite(str(root / "depth0" / "data" / "d.png"), raw)
    (root / "depth0" / "data.csv").write_text(f"#t\n{BEGIN_NS + FRAME_NS + 10_000_000},d.png\n")
    (root / "mag0").mkdir()
    (root / "mag0" / "data.csv").write_text(f"#t\n{BEGIN_NS + 1},20.0,0.5,-44.0\n")
    recording = open_dataset(str(tmp_path))
    camera = recording.rig.cameras[0]
    assert (camera.distortion, camera.skew_px, recording.rig.has_depth) == ("equidistant", 0.25, True)
    assert recording.imu_noise is None
    events = list(recording.events())
    assert [type(e) for e in events] == [Frame, MagSample, Frame, Frame]
    np.testing.assert_array_equal(events[1].field_ut, [20.0, 0.5, -44.0])
    depths = [e.depth_m for e in events if isinstance(e, Frame)]
    assert depths[0] is None and depths[2] is None and depths[1] is not None
    np.testing.assert_allclose(depths[1], raw / 2000.0, rtol=1e-6)
    assert recording.problems == {"frame without depth": 2}


def test_an_imu_with_a_pose_of_its_own_becomes_the_body(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=2, stereo=False)
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T_file_imu = np.eye(4)
    T_file_imu[:3, :3], T_file_imu[:3, 3] = R, [1.0, 2.0, 3.0]
    (root / "imu0" / "sensor.yaml").write_text(IMU_YAML + f"T_BS: {T_file_imu.ravel().tolist()}\n")
    (root / "state_groundtruth_estimate0").mkdir()
    pose = "5.0,6.0,7.0,1.0,0.0,0.0,0.0,0.1,0.2,0.3,0,0,0,0,0,0"
    (root / "state_groundtruth_estimate0" / "data.csv").write_text(f"#t\n{BEGIN_NS},{pose}\n{BEGIN_NS + 9},{pose}\n")
    (root / "state_groundtruth_estimate0" / "sensor.yaml").write_text(
        "sensor_type: pose\nT_BS: {data: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}\n"
    )
    recording = open_dataset(str(tmp_path))
    T_file_cam = np.eye(4)
    T_file_cam[:3, :3] = R_BODY_CAM
    np.testing.assert_allclose(T_file_imu @ recording.rig.T_body_cams[0], T_file_cam, atol=1e-12)
    truth = recording.truth()
    assert truth is not None
    T_world_file = np.eye(4)
    T_world_file[:3, 3] = [5.0, 6.0, 7.0]
    np.testing.assert_allclose(truth.T_world_body[0], T_world_file @ T_file_imu, atol=1e-12)


@pytest.mark.parametrize("folder", ["depth0", "mag0", "mocap0"])
def test_a_scale_or_clock_in_any_sensors_file_is_refused_and_a_truth_in_another_order(
    folder: str, tmp_path: Path
) -> None:
    root = write_asl(tmp_path, frames=2)
    (root / folder).mkdir(exist_ok=True)
    row = f"{BEGIN_NS},1,2,3,0,0,0,1\n"
    (root / folder / "data.csv").write_text(f"#timestamp [ns],x,y,z,qw,qx,qy,qz\n{row}")
    (root / folder / "sensor.yaml").write_text("time_offset: 0.1\n")
    with pytest.raises(DataError, match=f"{folder}/sensor.yaml: not read: time_offset; .*write (T_BS|depth)"):
        open_dataset(str(tmp_path))
    (root / folder / "sensor.yaml").write_text("comment: none\n")
    for names in ("timestamp [ns],x,y,z,qx,qy,qz,qw", "t_s,x,y,z,qw,qx,qy,qz", "t,x_mm,y_mm,z_mm,qw,qx,qy,qz"):
        (root / folder / "data.csv").write_text(f"#{names}\n{row}")
        if folder == "mocap0":
            with pytest.raises(DataError, match=r"mocap0/data.csv: its header names another order or unit"):
                open_dataset(str(tmp_path)).truth()


@pytest.mark.parametrize("names", ["a_x,a_y,a_z,w_x,w_y,w_z", "linear x,y,z,angular x,y,z", "wx [deg/s],wy,wz,ax,ay,az",
                                   "wx,wy,wz,ax_g,ay_g,az_g"])  # fmt: skip
def test_a_table_that_names_forces_first_or_other_units_is_refused(names: str, tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=2)
    rows = (root / "imu0" / "data.csv").read_text().partition("\n")[2]
    (root / "imu0" / "data.csv").write_text(f"#timestamp [ns],{names}\n{rows}")
    with pytest.raises(DataError, match=r"data.csv: its header names .*; write rates x, y, z in rad/s, then forces"):
        list(open_dataset(str(tmp_path)).events())


def test_mocap_truth_is_the_body_and_survives_a_cut(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=2)
    (root / "mocap0").mkdir()
    half = np.sqrt(0.5)
    row = f"{{}}, 1.0, 2.0, 3.0, {half}, 0.0, 0.0, {half}\n"
    text = "#t\n" + row.format(100) + row.format(200) + row.format(300)
    (root / "mocap0" / "data.csv").write_text(text[:-20])
    recording = open_dataset(str(tmp_path))
    truth = recording.truth()
    assert truth is not None and truth.t_ns.tolist() == [100, 200]
    list(recording.events())
    assert recording.problems == {"mocap0/data.csv: last line cut short (first: line 4)": 1}
    expected = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
    np.testing.assert_allclose(truth.T_world_body[1], expected, atol=1e-12)


def test_tum_vi_brings_kalibr_files(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=2, stereo=False)
    (root / "cam0" / "sensor.yaml").unlink()
    (root / "imu0" / "sensor.yaml").unlink()
    (tmp_path / "dso").mkdir()
    T_cam_imu = np.eye(4)
    T_cam_imu[:3, :3], T_cam_imu[:3, 3] = R_BODY_CAM.T, [0.1, 0.2, 0.3]
    (tmp_path / "dso" / "camchain.yaml").write_text(
        f"cam0:\n  T_cam_imu: {T_cam_imu.tolist()}\n  camera_model: pinhole\n  distortion_model: equidistant\n"
        f"  distortion_coeffs: [0.003, 0.0007, -0.002, 0.0002]\n  intrinsics: [50, 50, 32, 24]\n"
        f"  resolution: [{WIDTH}, {HEIGHT}]\n"
    )
    (tmp_path / "dso" / "imu_config.yaml").write_text(IMU_YAML.replace("rate_hz", "update_rate"))
    recording = open_dataset(str(tmp_path))
    assert recording.rig.cameras[0].distortion == "equidistant"
    np.testing.assert_allclose(recording.rig.T_body_cams[0] @ T_cam_imu, np.eye(4), atol=1e-12)
    assert recording.imu_noise is not None and recording.imu_noise.rate_hz == 200.0


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ("sensor_type: camera\n", "resolution must be 2 finite numbers, got None; a camera's file holds"),
        (camera_yaml().replace("51.0", ".nan"), "intrinsics must be 4 finite numbers"),
        (camera_yaml().replace("radial-tangential", "magic"), "'magic' is not supported"),
        (camera_yaml().replace(", 0.0001, 0.0002]", "]").replace(", 1e-4, 2e-4]", "]"), "takes .* coefficients"),
        (camera_yaml().replace("[0.0, 0.0, 1.0", "[0.0, 0.0, 3.0"), "T_BS is not a rigid transform"),
        ("a: [1, 2", "cannot be read as YAML"),
        ("[1, 2]", "must hold `key: value` lines"),
        ("x: 1\n" * 100_000, "bytes, more than"),
    ],
)
def test_unusable_calibration_names_file_key_and_remedy(tmp_path: Path, sensor: str, message: str) -> None:
    root = write_asl(tmp_path, frames=2)
    (root / "cam0" / "sensor.yaml").write_text(sensor)
    with pytest.raises(DataError, match=message) as caught:
        open_dataset(str(tmp_path))
    assert "cam0/sensor.yaml" in str(caught.value) and "\n" not in str(caught.value)


def test_missing_sensor_files_say_what_to_write(tmp_path: Path) -> None:
    root = write_asl(tmp_path, frames=2)
    (root / "imu0" / "sensor.yaml").unlink()
    with pytest.raises(DataError, match=r"imu0/sensor.yaml is missing; write the IMU's noise"):
        open_dataset(str(tmp_path))
    (root / "cam0" / "sensor.yaml").unlink()
    write_imu(tmp_path / "other", [])
    (root / "imu0" / "sensor.yaml").write_text(IMU_YAML)
    with pytest.raises(DataError, match=r"cam0/sensor.yaml is missing; write the calibration into it: T_BS"):
        open_dataset(str(tmp_path))


def test_an_inertial_recording_is_opened_without_a_camera(tmp_path: Path) -> None:
    write_imu(tmp_path / "mav0", imu_rows(10))
    recording = open_dataset(str(tmp_path))
    assert recording.rig.is_blind and recording.frame_count == 0
    assert [type(value).__name__ for value in recording.events()] == ["ImuSample"] * 10
    with pytest.raises(DataError, match="holds no camera images, which this works on"):
        with_camera(recording)


def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    peaks = []
    for count in (3_000, 30_000):
        root = write_asl(tmp_path / str(count), frames=2, stereo=False)
        (root / "imu0" / "data.csv").write_text("#t\n" + "\n".join(imu_rows(count)) + "\n")
        recording = open_dataset(str(root))
        tracemalloc.start()
        assert sum(1 for _ in recording.events()) == count + 2
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 50_000  # bytes; the rows themselves are 27000 times 200 more


@pytest.mark.parametrize("rows", [3, 7])
def test_an_imu_whose_file_tells_no_rate_has_the_one_of_its_samples(rows: int, tmp_path: Path) -> None:
    root = write_asl(tmp_path)
    (root / "imu0" / "sensor.yaml").write_text(IMU_YAML.replace("rate_hz: 200\n", ""))
    table = root / "imu0" / "data.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:rows]))
    noise = open_dataset(str(tmp_path)).imu_noise
    assert noise is not None
    assert noise.rate_hz == pytest.approx(200.0)


def test_an_imu_without_rate_and_samples_is_refused(tmp_path: Path) -> None:
    root = write_asl(tmp_path)
    (root / "imu0" / "sensor.yaml").write_text(IMU_YAML.replace("rate_hz: 200\n", ""))
    table = root / "imu0" / "data.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(DataError, match="no file states the IMU's rate, and it has 1 samples"):
        open_dataset(str(tmp_path))
