"""Files of cameras, IMUs and magnetometers: what is written reads back, and a recording takes them."""

import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.cli import run_verb
from vislam.config import CalibrationConfig, Config, load
from vislam.core.camera import Camera, CameraSigmas, Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import se3_exp
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.datasets import open_dataset
from vislam.datasets.calibrated import with_clock
from vislam.datasets.calibration_text import camera_text, imu_text
from vislam.datasets.camera_files import CameraCalibration, camchain_text, camera_info_text, read_cameras
from vislam.datasets.imu_files import (
    calibration_text,
    imu_noise_text,
    read_imu_calibration,
    read_mag_calibration,
    read_noise,
)
from vislam.imu import ImuCalibration, ImuNoise, MagCalibration
from vislam.runs.sources import open_source
from worlds import mini_recording as mini
from worlds.calibration import T0_NS, write_table

NOISE = ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3, 50.0)
CAMERA = Camera(64, 48, 50.0, 51.0, 31.5, 23.5, 0.0, "radtan", (-0.1, 0.01, 1e-4, 2e-4))

numbers = st.floats(-0.5, 0.5)
lenses = st.one_of(
    st.just(("none", ())),
    st.tuples(st.just("radtan"), st.tuples(*[numbers] * 4)),
    st.tuples(st.just("radtan"), st.tuples(*[numbers] * 5)),
    st.tuples(st.just("equidistant"), st.tuples(*[numbers] * 4)),
    st.tuples(st.just("rational"), st.tuples(*[numbers] * 8)),
    st.tuples(st.just("ucm"), st.tuples(st.floats(0.0, 1.0))),
    st.tuples(st.just("eucm"), st.tuples(st.floats(0.0, 1.0), st.floats(0.1, 0.9))),
)
cameras = st.builds(
    lambda size, f, c, skew, lens: Camera(*size, *f, *c, skew, *lens),
    st.tuples(st.integers(1, 5792), st.integers(1, 5792)),
    st.tuples(st.floats(1e-2, 1e5), st.floats(1e-2, 1e5)),
    st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
    st.sampled_from([0.0, 0.25, -3e-5]),
    lenses,
)
poses = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(lambda xi: se3_exp(np.array(xi)))
matrices = st.lists(st.floats(-0.2, 0.2), min_size=9, max_size=9).map(lambda x: np.eye(3) + np.reshape(x, (3, 3)))
vectors = st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3).map(np.array)


def written(text: str) -> Path:
    path = Path(tempfile.mkdtemp()) / "file.yaml"
    path.write_text(text)
    return path


def same_camera(a: Camera, b: Camera) -> bool:
    """Equal but for coefficients that are zero anyway."""

    def key(camera: Camera) -> tuple[object, ...]:
        k = [*camera.coefficients, *[0.0] * (8 - len(camera.coefficients))]
        model = "radtan" if camera.distortion == "rational" and not any(k[5:]) else camera.distortion
        return replace(camera, distortion="none", coefficients=()), model if any(k) else "none", k

    return key(a) == key(b)


@given(cameras, poses, st.none() | st.floats(-0.1, 0.1))
def test_kalibr_chains_read_back(camera: Camera, T: np.ndarray, offset_s: float | None) -> None:
    second = CameraCalibration(CAMERA, T @ T)
    text = camchain_text([CameraCalibration(camera, T, offset_s, 1e-3), second], "two\nlines")
    first, other = read_cameras(written(text))
    assert first.camera == camera
    assert first.time_offset_s == offset_s and first.time_offset_sigma_s == 1e-3
    assert first.T_body_cam == pytest.approx(T, abs=1e-9) and other.T_body_cam == pytest.approx(T @ T, abs=1e-9)
    alone = read_cameras(written(camchain_text([CameraCalibration(camera)], "")))[0]
    assert alone.camera == camera and alone.T_body_cam is None and alone.time_offset_s is None


def test_how_well_a_camera_is_known_reads_back_and_has_a_default() -> None:
    known = replace(CAMERA, sigmas=CameraSigmas(0.001, 0.0, 0.01))
    for text in (camchain_text([CameraCalibration(known)], ""), camera_text(known, None, "c")):
        assert read_cameras(written(text))[0].camera == known
        silent = "".join(line for line in text.splitlines(keepends=True) if "_sigma" not in line)
        assert read_cameras(written(silent))[0].camera == CAMERA
        with pytest.raises(DataError, match="focal_sigma"):
            read_cameras(written(text.replace("focal_sigma: 0.001", "focal_sigma: -1")))


@given(cameras, st.none() | poses)
def test_asl_sensor_files_read_back(camera: Camera, T: np.ndarray | None) -> None:
    (found,) = read_cameras(written(camera_text(camera, T, "c")))
    assert found.camera == camera
    assert found.T_body_cam is None if T is None else np.array_equal(found.T_body_cam, T)


@given(cameras.filter(lambda camera: camera.distortion not in ("ucm", "eucm")))
def test_ros_files_read_back(camera: Camera) -> None:
    (found,) = read_cameras(written(camera_info_text(camera, "webcam")))
    assert same_camera(found.camera, camera)


def test_kalibrs_relative_poses_are_followed() -> None:
    T_body_cam0, T_cam1_cam0 = (
        se3_exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])),
        se3_exp(np.array([0.0] * 3 + [-0.1, 0, 0])),
    )
    text = camchain_text([CameraCalibration(CAMERA, T_body_cam0), CameraCalibration(CAMERA)], "")
    rows = "".join(f"  - {row}\n" for row in T_cam1_cam0.tolist())
    found = read_cameras(written(text.replace("cam1:\n", "cam1:\n  T_cn_cnm1:\n" + rows)))
    assert found[1].T_body_cam == pytest.approx(T_body_cam0 @ np.linalg.inv(T_cam1_cam0))


def chain_of(*pairs: tuple[str, np.ndarray], more: str = "") -> str:
    """A chain with one pose a camera, under any name."""
    text = camchain_text([CameraCalibration(CAMERA, np.eye(4)) for _ in pairs], "")
    blocks = re.split(r"^(?=cam\d:)", text, flags=re.MULTILINE)[1:]
    for k, (name, T) in enumerate(pairs):
        rows = "".join(f"  - {row}\n" for row in T.tolist())
        blocks[k] = re.sub(r"  T_cam_imu:\n(  - .*\n){4}", f"  {name}:\n{rows}{more}", blocks[k])
    return "%YAML:1.0\n" + "".join(blocks)


def test_openvins_writes_the_pose_that_kalibr_inverts() -> None:
    T0, T1 = (se3_exp(np.array(xi)) for xi in ([0.1, 0.2, 0.3, 1.0, 2.0, 3.0], [-0.3, 0.1, 0.2, 0.4, 0.5, 0.6]))
    theirs = read_cameras(written(chain_of(("T_imu_cam", T0), ("T_imu_cam", T1))))
    kalibr = read_cameras(written(chain_of(("T_cam_imu", np.linalg.inv(T0)), ("T_cam_imu", np.linalg.inv(T1)))))
    for one, other, T in zip(theirs, kalibr, (T0, T1), strict=True):
        assert one.T_body_cam == pytest.approx(T) and other.T_body_cam == pytest.approx(T)
    both = chain_of(("T_imu_cam", T0)) + "".join(f"{r}\n" for r in ["  T_cam_imu:", *(f"  - {r}" for r in T0.tolist())])
    with pytest.raises(DataError, match="not inverse"):
        read_cameras(written(both))


@pytest.mark.parametrize("key", ["T_cam_body", "body_T_cam0", "T_i_c", "T_BC", "Tbc", "timeshift_imu_cam", "scale"])
@pytest.mark.parametrize(
    "make",
    [
        lambda key: chain_of((key, se3_exp(np.full(6, 0.1)))),
        lambda key: chain_of(("T_cam_imu", np.eye(4)), more=f"  {key}: 0.25\n"),
        lambda key: camera_text(CAMERA, None, "") + f"{key}: [0.5]\n",
    ],
)
def test_a_pose_clock_or_scale_that_is_not_known_is_refused_by_name(make: Callable[[str], str], key: str) -> None:
    path = written(make(key))
    with pytest.raises(DataError, match=rf"{path}: not read: {key}.*write T_"):
        read_cameras(path)


def test_other_keys_that_are_not_used_are_named_once(caplog: pytest.LogCaptureFixture) -> None:
    path = written(chain_of(("T_cam_imu", np.eye(4)), more="  vignette: [3.0]\n  gamma: 0.0\n"))
    assert read_cameras(path)[0].camera == read_cameras(path)[0].camera == CAMERA
    assert [record.getMessage() for record in caplog.records] == [f"{path}: not used: vignette"]


RATIONAL = camera_info_text(replace(CAMERA, coefficients=(-0.1, 0.01, 1e-4, 2e-4, 0.5)), "c")
RATIONAL = RATIONAL.replace("plumb_bob", "rational_polynomial").replace("0.5]", "0.5, 0.1, 0.1, 0.1, 0.1]")


def kalibr(model: str, intrinsics: str, coefficients: str = "[]") -> str:
    """As Kalibr writes it: what the model takes, then focal lengths and principal point."""
    name = "none" if coefficients == "[]" else "radtan"
    return (
        f"cam0:\n  cam_overlaps: []\n  camera_model: {model}\n  distortion_coeffs: {coefficients}\n"
        f"  distortion_model: {name}\n  intrinsics: [{intrinsics}]\n  resolution: [64, 48]\n  rostopic: /cam0/i\n"
    )


KALIBR = {
    "ds": kalibr("ds", "-0.2, 0.6, 40.0, 40.8, 31.5, 23.5"),
    "eucm": kalibr("eucm", "0.6, 1.1, 50.0, 51.0, 31.5, 23.5"),
    "ucm": kalibr("eucm", "0.6, 1.0, 50.0, 51.0, 31.5, 23.5"),
    "omni": kalibr("omni", "1.5, 125.0, 127.5, 31.5, 23.5", "[-0.1, 0.01, 0.0001, 0.0002]"),
    "bare": kalibr("omni", "1.5, 125.0, 127.5, 31.5, 23.5"),
}


@pytest.mark.parametrize(
    ("text", "model", "coefficients"),
    [
        (KALIBR["ds"], "ds", (-0.2, 0.6)), (KALIBR["eucm"], "eucm", (0.6, 1.1)), (KALIBR["ucm"], "ucm", (0.6,)),
        (KALIBR["omni"], "omni", (1.5, -0.1, 0.01, 1e-4, 2e-4)), (KALIBR["bare"], "omni", (1.5, 0.0, 0.0, 0.0, 0.0)),
    ],
)  # fmt: skip
def test_lenses_over_spheres_are_read_as_kalibr_writes_them_and_written_back(
    text: str, model: str, coefficients: tuple[float, ...]
) -> None:
    camera = read_cameras(written(text))[0].camera
    assert (camera.distortion, camera.coefficients) == (model, coefficients)
    assert (camera.fx, camera.fy) == pytest.approx((50.0, 51.0))  # in the middle of the image
    for again in (camchain_text([CameraCalibration(camera)], ""), camera_text(camera, None, "c")):
        second = read_cameras(written(again))[0].camera
        assert replace(second, fx=camera.fx, fy=camera.fy) == camera and second.fx == pytest.approx(camera.fx)
    with pytest.raises(DataError, match=f"ROS has no {model} lens"):
        camera_info_text(camera, "c")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("camera_matrix: {rows: 3, cols: 3, data: [1, 2]}\nimage_width: 4\nimage_height: 4\n", "camera_matrix must"),
        ("cam0:\n  camera_model: ds\n  distortion_model: radtan\n", "'ds', 'radtan' is not supported"),
        ("cam0:\n  camera_model: catadioptric\n", "'catadioptric', 'none' is not supported"),
        (KALIBR["ds"].replace("-0.2", "-1.2"), "ds distortion has xi from -0.99 to 0.99, got -1.2"),
        (KALIBR["ds"].replace("-0.2, ", ""), "intrinsics must be 6 finite numbers"),
        (RATIONAL, "not supp"),
        (camchain_text([CameraCalibration(CAMERA, np.eye(4))], "").replace("1.0, 0.0]", "2.0, 0.0]"), "not a rigid"),
        (camera_info_text(CAMERA, "c").replace("image_width: 64", "image_width: wide"), "image_width"),
        ("- 1\n", "key: value"),
    ],
)  # fmt: skip
def test_wrong_camera_files_are_named(text: str, said: str) -> None:
    with pytest.raises(DataError, match=said):
        read_cameras(written(text))


@given(vectors, matrices, vectors, matrices)
def test_imu_and_mag_files_read_back(b: np.ndarray, A: np.ndarray, c: np.ndarray, B: np.ndarray) -> None:
    if min(abs(np.linalg.det(A)), abs(np.linalg.det(B))) < 1e-3:
        return
    given_imu = ImuCalibration(b, c, A, B)
    found = read_imu_calibration(written(calibration_text(given_imu, "x")))
    for name in ("gyro_bias_rad_s", "accel_bias_m_s2", "gyro_matrix", "accel_matrix"):
        assert np.array_equal(getattr(found, name), getattr(given_imu, name))
    mag = read_mag_calibration(written(calibration_text(MagCalibration(b, A), "x")))
    assert np.array_equal(mag.bias_ut, b) and np.array_equal(mag.matrix, A)
    sample = ImuSample(0, b, c)
    both = given_imu.apply_to(np.concatenate([b, c])[None])[0]
    applied = given_imu.apply(sample)
    assert both == pytest.approx(np.concatenate([applied.gyro_rad_s, applied.accel_m_s2]))


@pytest.mark.parametrize(
    "text",
    ["gyro_bias_rad_s: [0, 0, 0]\n", "a: 1\n", calibration_text(ImuCalibration(), "").replace("1.0", "0.0")],
)
def test_partial_or_singular_imu_files_are_refused(text: str) -> None:
    with pytest.raises(DataError, match="calibrat"):
        read_imu_calibration(written(text))


def test_noise_reads_back() -> None:
    assert read_noise(written(imu_noise_text(NOISE, "x"))) == NOISE
    assert read_noise(written(imu_text(NOISE, "x"))) == NOISE


def test_kalibrs_results_of_imus_are_read_and_what_is_not_used_is_named(caplog: pytest.LogCaptureFixture) -> None:
    block = imu_noise_text(NOISE, "").replace("\n", "\n  ").rstrip(" ")
    still = (
        "  T_i_b: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n  time_offset: 0.0\n  model: calibrated\n"
    )
    assert read_noise(written(f"imu0:\n  {block}{still}")) == NOISE
    assert not caplog.records
    assert read_noise(path := written(f"imu0:\n  {block}  gamma: 2.0\n")) == NOISE
    assert [record.getMessage() for record in caplog.records] == [f"{path}: not used: gamma"]
    shifted = "[[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    for key in (f"T_i_b: {shifted}", "Tw: [[1, 0, 0], [0, 1.1, 0], [0, 0, 1]]", "time_offset: 0.01",
                "accelerometers: {M: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}"):  # fmt: skip
        with pytest.raises(DataError, match=f"not read: {key.split(':')[0]}; .*--calibration.imu"):
            read_noise(written(f"imu0:\n  {block}  {key}\n"))
    with pytest.raises(DataError, match="holds 2 IMUs: imu0, imu1; give"):
        read_noise(written(f"imu0:\n  {block}imu1:\n  {block}"))
    two = written(f"imu0:\n  {block}imu1:\n  {block}".replace("/imu0", "/left/imu", 1))
    assert read_noise(two, "/left/imu") == read_noise(two, "/imu0") == NOISE
    with pytest.raises(DataError, match="holds 2 IMUs: imu0, imu1, not one with rostopic /imu; give"):
        read_noise(two, "/imu")


def raw_recording(folder: Path, sensor_extra: str = "") -> Path:
    """Three frames, and an IMU and a magnetometer at rest whose samples are raw."""
    t_s = np.arange(11) * 0.02
    write_table(folder, "imu0", t_s, np.tile([0.1, 0.2, 0.3, 1.0, 2.0, 5.0], (11, 1)))
    write_table(folder, "mag0", t_s, np.tile([10.0, 20.0, 30.0], (11, 1)))
    (folder / "mav0/imu0/sensor.yaml").write_text(imu_text(NOISE, "raw") + sensor_extra)
    data = folder / "mav0/cam0/data"
    data.mkdir(parents=True)
    image = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    names = [f"{T0_NS + k * 100_000_000}" for k in range(3)]
    for name in names:
        cv2.imwrite(str(data / f"{name}.png"), image)
    (data.parent / "data.csv").write_text("".join(f"{name},{name}.png\n" for name in names))
    (data.parent / "sensor.yaml").write_text(camera_text(CAMERA, np.eye(4), "test"))
    return folder


CALIBRATION = ImuCalibration(np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 1.0]), 2.0 * np.eye(3), 2.0 * np.eye(3))


def calibration_files(folder: Path) -> CalibrationConfig:
    folder.mkdir()
    T = se3_exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
    new = replace(CAMERA, fx=77.0)
    texts = {
        "camera": camchain_text([CameraCalibration(new, T, 0.012, 0.0005)], ""),
        "imu": calibration_text(CALIBRATION, ""),
        "imu_noise": imu_noise_text(replace(NOISE, accelerometer_noise_density=0.5), ""),
        "mag": calibration_text(MagCalibration(np.array([10.0, 20.0, 20.0]), 3.0 * np.eye(3)), ""),
    }
    for name, text in texts.items():
        (folder / f"{name}.yaml").write_text(text)
    return CalibrationConfig(**{name: str(folder / f"{name}.yaml") for name in texts})


def test_a_recording_is_seen_with_the_files_that_are_named(tmp_path: Path) -> None:
    recording = open_dataset(str(raw_recording(tmp_path / "r")), calibration_files(tmp_path / "c"))
    assert recording.rig.cameras[0].fx == 77.0
    assert recording.rig.T_body_cams[0] == pytest.approx(se3_exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])))
    assert recording.imu_noise == replace(NOISE, accelerometer_noise_density=0.5)
    events = list(recording.events())
    imu = next(value for value in events if isinstance(value, ImuSample))
    mag = next(value for value in events if isinstance(value, MagSample))
    assert imu.gyro_rad_s == pytest.approx(np.zeros(3)) and imu.accel_m_s2 == pytest.approx([2.0, 4.0, 8.0])
    assert mag.field_ut == pytest.approx([0.0, 0.0, 30.0])


def test_a_recordings_own_sensor_file_may_say_that_samples_are_raw(tmp_path: Path) -> None:
    text = "\n".join(calibration_text(CALIBRATION, "").splitlines()[2:]) + "\n"
    recording = open_dataset(str(raw_recording(tmp_path / "r", text)))
    imu = next(value for value in recording.events() if isinstance(value, ImuSample))
    assert imu.accel_m_s2 == pytest.approx([2.0, 4.0, 8.0])


def test_the_clock_of_a_calibrated_camera_reaches_the_settings(tmp_path: Path) -> None:
    config = Config(calibration=calibration_files(tmp_path / "c"))
    assert with_clock(config).init.time_offset_s == 0.012
    assert with_clock(config).init.time_offset_sigma_s == pytest.approx(0.0015)
    own = load(overrides={"init.time_offset_s": 0.5, "calibration.camera": config.calibration.camera})
    assert with_clock(own).init.time_offset_s == 0.5
    assert with_clock(Config()) == Config()


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    files = calibration_files(tmp_path / "c")
    recording = raw_recording(tmp_path / "r")
    (tmp_path / "wide.yaml").write_text(camera_info_text(replace(CAMERA, width=128), "w"))
    with pytest.raises(DataError, match="128x48"):
        open_dataset(str(recording), CalibrationConfig(camera=str(tmp_path / "wide.yaml")))
    with pytest.raises(DataError, match=r"none\.yaml"):
        open_dataset(str(recording), CalibrationConfig(imu=str(tmp_path / "none.yaml")))
    with pytest.raises(UsageError, match="exactly"):
        open_source("points:laps", calibration=files)
    assert isinstance(open_source("points:still", calibration=CalibrationConfig()).rig, Rig)


def test_a_run_takes_the_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = calibration_files(tmp_path / "c")
    command = ["run", str(raw_recording(tmp_path / "r")), "--out", str(tmp_path / "run")]
    command += ["--calibration.camera", str(files.camera), "--calibration.imu", str(files.imu), "--view.no-enabled"]
    assert run_verb(command) == 4, "three equal images are no trajectory, but the run begins"
    config = load(overrides={})
    text = (tmp_path / "run/config.json").read_text()
    assert "0.012" in text and str(files.imu) in text and config.init.time_offset_s == 0.0
    assert run_verb([*command, "--overwrite", "--calibration.imu", str(tmp_path / "none.yaml")]) == 3
    assert "none.yaml" in capsys.readouterr().err


def stereo_chain(offsets_s: tuple[float | None, float | None]) -> str:
    camera = Camera(mini.WIDTH, mini.HEIGHT, 50.0, 51.0, 31.5, 23.5)
    poses = [se3_exp(np.array([x_m, 0.0, 0.0, 0.0, 0.0, 0.0])) for x_m in (0.0, 0.1)]
    return camchain_text([CameraCalibration(camera, T, t) for T, t in zip(poses, offsets_s, strict=True)], "stereo")


def frame_stamps(root: Path, files: CalibrationConfig | None = None) -> list[int]:
    return [event.t_ns - mini.BEGIN_NS for event in open_dataset(str(root), files).events() if isinstance(event, Frame)]


@pytest.fixture
def stereo(tmp_path: Path) -> Path:
    """The images of cam1 bear stamps that are 4 ms late."""
    root = tmp_path / "r" / "mav0"
    for index in range(2):
        mini.write_camera(root, f"cam{index}", 4, 0.1 * index, seed=9 * index)
    rows = root / "cam1" / "data.csv"
    rows.write_text(re.sub(r"(?m)^(\d+)", lambda row: str(int(row[1]) + 4_000_000), rows.read_text()))
    return root


def test_the_second_cameras_own_clock_is_used_and_stated(stereo: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(DataError, match="share no image within"):
        frame_stamps(stereo)
    path = written(stereo_chain((0.010, 0.006)))
    assert frame_stamps(stereo, CalibrationConfig(camera=str(path))) == [k * mini.FRAME_NS for k in range(4)]
    assert caplog.messages == [f"stamps are moved by timeshift_cam_imu of {path}: cam1 -4.000 ms"]
    with pytest.raises(DataError, match="timeshift_cam_imu stands for cam1 alone; write cam0's, too"):
        frame_stamps(stereo, CalibrationConfig(camera=str(written(stereo_chain((None, 0.006))))))
    with pytest.raises(DataError, match=r"timeshift_cam_imu of 1e\+300 s; it is what two clocks differ by"):
        frame_stamps(stereo, CalibrationConfig(camera=str(written(stereo_chain((1e300, 1e300))))))


def test_the_clocks_of_a_recordings_own_chain_are_used_and_stated(
    stereo: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (stereo / "camchain.yaml").write_text(stereo_chain((0.010, 0.006)))
    for index in range(2):
        (stereo / f"cam{index}" / "sensor.yaml").unlink()
    assert frame_stamps(stereo) == [10_000_000 + k * mini.FRAME_NS for k in range(4)]
    moves = "cam0 +10.000 ms, cam1 +6.000 ms"
    assert caplog.messages == [f"stamps are moved by timeshift_cam_imu of {stereo}: {moves}"]
    named = written(stereo_chain((0.002, -0.002)))  # goes before it; the first camera's goes to the settings
    assert frame_stamps(stereo, CalibrationConfig(camera=str(named))) == [k * mini.FRAME_NS for k in range(4)]
    lacking = written(stereo_chain((None, None)))  # what a file lacks stays as the recording has it
    assert frame_stamps(stereo, CalibrationConfig(camera=str(lacking)))[0] == 10_000_000
