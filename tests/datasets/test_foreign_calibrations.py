"""Calibrations of other programs, in the forms that those write: right values, or a refusal by program and model."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from vislam.config import CalibrationConfig
from vislam.core import Camera, DataError, se3_exp
from vislam.datasets import open_dataset
from vislam.datasets.camera_files import CameraCalibration, read_cameras
from vislam.datasets.imu_files import read_noise
from vislam.imu import ImuNoise
from worlds.bag_writer import quaternion_xyzw
from worlds.mini_recording import HEIGHT, WIDTH, camera_yaml, write_asl

SIZE, PINHOLE = (64, 48), (50.0, 51.0, 31.5, 23.5)
RADTAN = Camera(*SIZE, *PINHOLE, 0.0, "radtan", (-0.1, 0.01, 1e-4, 2e-4))
FISHEYE = Camera(*SIZE, *PINHOLE, 0.0, "equidistant", (0.01, -0.02, 0.003, 1e-4))
RATIONAL = Camera(*SIZE, *PINHOLE, 0.0, "rational", (-0.1, 0.01, 1e-4, 2e-4, 0.5, 0.1, 0.2, 0.3))
T0, T01 = se3_exp(np.array([0.1, -0.4, 0.3, 0.2, 0.1, -0.3])), se3_exp(np.array([0.02, 0.01, -0.03, 0.12, 0.01, 0.0]))
K_TEXT = "50.0, 0., 31.5, 0., 51.0, 23.5, 0., 0., 1."


def matrix(name: str, values: np.ndarray, tag: str = "!!opencv-matrix") -> str:
    """As OpenCV writes it; its parser wants no space behind `data:`."""
    rows, columns = values.shape
    return f"{name}: {tag}\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data:{values.ravel().tolist()}\n"


def parts(prefix: str, values: tuple[float, ...], names: str) -> str:
    return "".join(f"{prefix}{name}: {value!r}\n" for name, value in zip(names.split(), values, strict=True))


def orb(kind: str, names: str, values: tuple[float, ...], more: str, cameras: tuple[str, ...] = ("Camera1",)) -> str:
    text = f'%YAML:1.0\n\nFile.version: "1.0"\nCamera.type: "{kind}"\nCamera.width: 64\nCamera.height: 48\n'
    for camera in cameras:
        text += parts(f"{camera}.", PINHOLE, "fx fy cx cy") + parts(f"{camera}.", values, names)
    noise = (
        "IMU.NoiseGyro: 1.7e-4\nIMU.NoiseAcc: 2.0e-3\nIMU.GyroWalk: 1.9e-5\nIMU.AccWalk: 3.e-03\nIMU.Frequency: 200\n"
    )
    return f"{text}{more}{noise}ORBextractor.scaleFactor: 1.2\nViewer.PointSize:2\n"


def vins_lens(kind: str = "PINHOLE") -> str:
    head = f"%YAML:1.0\n---\nmodel_type: {kind}\ncamera_name: camera\nimage_width: 64\nimage_height: 48\n"
    if kind == "KANNALA_BRANDT":
        return (
            head
            + "projection_parameters:\n"
            + parts("   ", (*FISHEYE.coefficients, *PINHOLE), "k2 k3 k4 k5 mu mv u0 v0")
        )
    if kind == "MEI":
        head += "mirror_parameters:\n   xi: 1.5\ndistortion_parameters:\n"
        head += parts("   ", RADTAN.coefficients, "k1 k2 p1 p2") + "projection_parameters:\n"
        return head + parts("   ", (125.0, 127.5, 31.5, 23.5), "gamma1 gamma2 u0 v0")
    lens = "distortion_parameters:\n" + parts("   ", RADTAN.coefficients, "k1 k2 p1 p2")
    return f"{head}{lens}projection_parameters:\n" + parts("   ", PINHOLE, "fx fy cx cy")


def basalt(kind: str = "kb4", **more: object) -> str:
    names, values = {
        "kb4": ("k1 k2 k3 k4", FISHEYE.coefficients), "ucm": ("alpha", (0.6,)), "eucm": ("alpha beta", (0.6, 1.1)),
        "pinhole-radtan8": ("k1 k2 p1 p2 k3 k4 k5 k6", RATIONAL.coefficients),
    }.get(kind, ("xi alpha", (0.25, 0.5)))  # fmt: skip
    pinhole = (62.5, 63.75, *PINHOLE[2:]) if kind == "ds" else PINHOLE
    lens = dict(zip(["fx", "fy", "cx", "cy", *names.split()], [*pinhole, *values], strict=True))
    poses = [dict(zip(["px", "py", "pz", "qx", "qy", "qz", "qw"],
                      [*T[:3, 3], *quaternion_xyzw(T[:3, :3])], strict=True)) for T in (T0, T0 @ T01)]  # fmt: skip
    noise = {"accel_noise_std": [2e-3] * 3, "gyro_noise_std": [1.7e-4] * 3, "accel_bias_std": [3e-3] * 3}
    stated = {
        "T_imu_cam": poses, "intrinsics": [{"camera_type": kind, "intrinsics": lens}] * 2, "resolution": [SIZE, SIZE],
        "calib_accel_bias": [0.0] * 9, "calib_gyro_bias": [0.0] * 12, "imu_update_rate": 200.0, **noise,
        "gyro_bias_std": [1.9e-5] * 3, "cam_time_offset_ns": 2_000_000, "vignette": [],
    }  # fmt: skip
    return json.dumps({"value0": stated | more}, indent=4)


def opencv(distortion: str, size: str = "image_width: 64\nimage_height: 48\n", more: str = "") -> str:
    data = f"\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {K_TEXT} ]\n"
    return f"%YAML:1.0\n---\n{size}{more}camera_matrix: !!opencv-matrix{data}{distortion}"


XML = (
    '<?xml version="1.0"?>\n<opencv_storage>\n<calibration_Time>"Mon"</calibration_Time>\n'
    "<image_Width>64</image_Width><image_Height>48</image_Height>\n"
    '<Camera_Matrix type_id="opencv-matrix">\n<rows>3</rows><dt>d</dt>\n'
    f"<data>\n {K_TEXT.replace(',', ' ')}</data></Camera_Matrix>\n<Distortion_Coefficients type_id='opencv-matrix'>"
    "<rows>5</rows><dt>d</dt><data>-0.1 0.01 1e-4 2e-4 0.</data></Distortion_Coefficients></opencv_storage>"
)
D5 = "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   data: [ -0.1, 0.01, 1e-4, 2e-4, 0. ]\n"
D8 = matrix("distortion_coefficients", np.array([RATIONAL.coefficients]))
D4 = matrix("distortion_coefficients", np.array([FISHEYE.coefficients]))
ECHO = (
    "header:\n  stamp: {sec: 1, nanosec: 2}\n  frame_id: cam0\nheight: 48\nwidth: 64\ndistortion_model: plumb_bob\n"
    f"D: [-0.1, 0.01, 0.0001, 0.0002, 0.0]\nK: [{K_TEXT}]\nR: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nP: [1, 0]\nbinning_x: 0\n"
)
OKVIS = "imu_params:\n  imu_rate: 200\n" + parts(
    "  ", (1.7e-4, 2e-3, 1.9e-5, 3e-3), "sigma_g_c sigma_a_c sigma_gw_c sigma_aw_c"
)
MAPLAB = "label: rig\ncameras:\n"
for T, one in ((T0, FISHEYE), (T0 @ T01, RADTAN)):
    k, kind = list(one.coefficients), one.distortion.replace("radtan", "radialtangential")
    OKVIS += ("" if "cameras:" in OKVIS else "cameras:\n") + (
        f"  - {{T_SC: {T.ravel().tolist()}, image_dimension: [64, 48], distortion_coefficients: {k},\n"
        f"     distortion_type: {kind}, focal_length: [50.0, 51.0], principal_point: [31.5, 23.5]}}\n"
    )
    MAPLAB += (
        f"- camera:\n    label: c\n    image_height: 48\n    image_width: 64\n    type: pinhole\n    intrinsics:\n"
        f"      rows: 4\n      cols: 1\n      data: {list(PINHOLE)}\n    distortion:\n"
        f"      type: {kind.replace('altan', 'al-tan')}\n      parameters: {{rows: 4, cols: 1, data: {k}}}\n"
        f"  T_B_C: {{rows: 4, cols: 4, data: {T.ravel().tolist()}}}\n"
    )
MEI = Camera(*SIZE, 25.0, 25.5, *PINHOLE[2:], 0.0, "omni", (1.0, *FISHEYE.coefficients))
T10, D_ROW = np.linalg.inv(T01), np.array([RADTAN.coefficients])
PAIR = "%YAML:1.0\nimage_width: 64\nimage_height: 48\n"
PAIR += "".join(matrix(f"M{k}", RADTAN.K) + matrix(f"D{k}", D_ROW) for k in (1, 2))
PAIR += matrix("R", T10[:3, :3]) + matrix("T", T10[:3, 3:]) + matrix("Q", T0)
BODY = matrix("IMU.T_b_c1", T0)
STEREO = BODY + matrix("Stereo.T_c1_c2", T01)
VINS = matrix("extrinsicRotation", T0[:3, :3])
VINS += matrix("extrinsicTranslation", T0[:3, 3:]) + "estimate_extrinsic: 1\ntd: 0.002\nacc_n: 0.1\n"
SHIFT = np.array([[1.0, 0, 0, 0.05], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
BOTH = ("Camera1", "Camera2")
R4, K4 = "k1 k2 p1 p2", "k1 k2 k3 k4"


@pytest.mark.parametrize(
    ("text", "camera", "poses", "offset_s"),
    [
        (orb("PinHole", R4, RADTAN.coefficients, BODY), RADTAN, [T0], None),
        (orb("PinHole", R4, RADTAN.coefficients, matrix("Tbc", T0), ("Camera",)), RADTAN, [T0], None),
        (orb("KannalaBrandt8", K4, FISHEYE.coefficients, STEREO, BOTH), FISHEYE, [T0, T0 @ T01], None),
        (orb("KannalaBrandt8", K4, FISHEYE.coefficients, BODY + "Stereo.b: 0.05\n" + matrix("Tlr", T01[:3]), BOTH),
         FISHEYE, [T0, T0 @ T01], None),
        (orb("Rectified", "", (), BODY + "Stereo.b: 0.05\n"), Camera(*SIZE, *PINHOLE), [T0, T0 @ SHIFT], None),
        (orb("PinHole", "k1 k2", (0.0, 0.0), matrix("Tbc", T0) + "Camera.bf: 2.5\n"), Camera(*SIZE, *PINHOLE),
         [T0, T0 @ SHIFT], None),
        (orb("PinHole", R4, RADTAN.coefficients, "Camera.bf: 2.5\nDepthMapFactor: 5000.0\n"), RADTAN, [None], None),
        (vins_lens(), RADTAN, [None], None),
        (vins_lens("KANNALA_BRANDT"), FISHEYE, [None], None),
        (vins_lens() + VINS, RADTAN, [T0], 0.002),
        (vins_lens() + VINS.replace("extrinsic: 1", "extrinsic: 2"), RADTAN, [None], 0.002),
        (basalt(), FISHEYE, [T0, T0 @ T01], 0.002),
        (basalt("pinhole-radtan8"), RATIONAL, [T0, T0 @ T01], 0.002),
        (basalt("ds"), Camera(*SIZE, *PINHOLE, 0.0, "ds", (0.25, 0.5)), [T0, T0 @ T01], 0.002),
        (basalt("ucm"), Camera(*SIZE, *PINHOLE, 0.0, "ucm", (0.6,)), [T0, T0 @ T01], 0.002),
        (basalt("eucm"), Camera(*SIZE, *PINHOLE, 0.0, "eucm", (0.6, 1.1)), [T0, T0 @ T01], 0.002),
        (vins_lens("MEI"), Camera(*SIZE, *PINHOLE, 0.0, "omni", (1.5, *RADTAN.coefficients)), [None], None),
        (PAIR, RADTAN, [None, None], None),
        (opencv(D5), RADTAN, [None], None),
        (opencv(D8), RATIONAL, [None], None),
        (opencv(D4, more="fisheye_model: 1\n"), FISHEYE, [None], None),
        (XML, RADTAN, [None], None),
        (ECHO, RADTAN, [None], None),
        (ECHO.replace("D:", "d:").replace("K:", "k:") + "---\n", RADTAN, [None], None),
        (f"mtx: [{K_TEXT}]\ndist: [[-0.1, 0.01, 1e-4, 2e-4, 0]]\nimageSize: [64, 48]\n", RADTAN, [None], None),
        (opencv(D4, more="xi: 1.0\n"), MEI, [None], None),
        (re.sub(r"  T_B_C.*\n", "", MAPLAB[: MAPLAB.index("- camera", 30)]), FISHEYE, [None], None),
    ],
)  # fmt: skip
def test_files_of_other_programs_are_read(
    text: str, camera: Camera, poses: list[np.ndarray | None], offset_s: float | None, tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    path = tmp_path / "theirs"
    path.write_text(text)
    found = read_cameras(path)
    assert [one.camera for one in found] == [camera] * len(poses)
    for one, T in zip(found, poses, strict=True):
        assert one.T_body_cam is None if T is None else one.T_body_cam == pytest.approx(T, abs=1e-12)
        assert one.time_offset_s == (None if offset_s is None else pytest.approx(offset_s))
    assert not caplog.records


@pytest.mark.parametrize(
    ("text", "offset_s"),
    [
        (OKVIS, None),
        (OKVIS + "camera_parameters: {image_delay: 0.1}\n", -0.1),
        (OKVIS + "imageDelay: 0.1\n", -0.1),
        (MAPLAB, None),
    ],
)
def test_cameras_of_okvis_and_maplab_are_read_with_their_places(
    text: str, offset_s: float | None, tmp_path: Path
) -> None:
    (tmp_path / "theirs.yaml").write_text(text)
    found = read_cameras(tmp_path / "theirs.yaml")
    assert [one.camera for one in found] == [FISHEYE, RADTAN] and found[0].time_offset_s == offset_s
    assert found[0].T_body_cam == pytest.approx(T0) and found[1].T_body_cam == pytest.approx(T0 @ T01)


@pytest.mark.parametrize(
    ("text", "readout_s"),
    [
        (MAPLAB.replace("    label: c", "    line-delay-nanoseconds: 25000"), "0.0012"),
        (vins_lens() + "rolling_shutter: 1\nrolling_shutter_tr: 0.033\n", "0.033"),
    ],
)
def test_a_rolling_shutter_that_is_stated_is_named(
    text: str, readout_s: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "theirs").write_text(text)
    read_cameras(tmp_path / "theirs")
    assert f"give --frontend.readout-s {readout_s}" in caplog.text


def test_a_pair_of_opencv_has_its_place_there_or_in_the_file_beside(tmp_path: Path) -> None:
    lenses, there, place = PAIR.partition("R: ")
    (tmp_path / "intrinsics.yml").write_text(lenses)
    with pytest.raises(DataError, match=r"extrinsics\.yml cannot be read"):
        read_cameras(tmp_path / "intrinsics.yml")
    (tmp_path / "extrinsics.yml").write_text("%YAML:1.0\n" + there + place)
    assert read_cameras(tmp_path / "intrinsics.yml")[1].T_before_cam == pytest.approx(T01)


def test_vins_fusion_names_the_files_of_its_cameras(tmp_path: Path) -> None:
    (tmp_path / "848").mkdir()
    for name in ("848/cam0_pinhole.yaml", "cam1_pinhole.yaml"):
        (tmp_path / name).write_text(vins_lens())
    text = '%YAML:1.0\nimu: 1\nnum_of_cam: 2\ncam0_calib: "848/cam0_pinhole.yaml"\ncam1_calib: "/x/cam1_pinhole.yaml"\n'
    poses = matrix("body_T_cam0", T0) + matrix("body_T_cam1", T0 @ T01)
    (tmp_path / "main.yaml").write_text(f"{text}{poses}td: -0.01\n")
    found = read_cameras(tmp_path / "main.yaml")
    assert [one.camera for one in found] == [RADTAN, RADTAN] and found[0].time_offset_s == -0.01
    assert found[0].T_body_cam == pytest.approx(T0) and found[1].T_body_cam == pytest.approx(T0 @ T01)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (basalt("fov"), "Basalt's camera model fov is not supported"),
        (basalt(T_cam_mocap=1.0), "not read: T_cam_mocap"),
        (PAIR.replace("D1", "D3"), "D1 must be a list of finite numbers, got None"),
        (PAIR + "scale: 2\n", "not read: scale; .*write R and T"),
        (OKVIS.replace("T_SC", "T_SC_old: [1], T_SC"), "not read: T_SC_old"),
        (basalt().replace('"px"', '"x"'), "looks like a file of Basalt.*no 'px'"),
        (OKVIS.replace("equidistant", "fov"), "OKVIS's distortion fov is not supported"),
        (MAPLAB.replace("equidistant", "fisheye"), "maplab's pinhole with fisheye is not supported"),
        (MAPLAB.replace("type: pinhole", "type: omni"), "maplab's omni with equidistant is not supported"),
        (PAIR.replace("image_width: 64\n", ""), "a pair of OpenCV; it has no image size: add image_width"),
        (PAIR.replace(str(T10[0, 3]), "-120.0"), "a pair of OpenCV; T of 120 m is no pair's: write metres"),
        (vins_lens("SCARAMUZZA").replace("projection", "poly"), "VINS's camera model SCARAMUZZA is not supported"),
        (vins_lens("MEI").replace("xi", "x"), "looks like a file of VINS.*no 'xi'"),
        (vins_lens().replace("fx", "f"), "looks like a file of VINS.*no 'fx'"),
        (vins_lens() + matrix("body_T_lidar", T0), "not read: body_T_lidar"),
        (vins_lens() + VINS[VINS.index("extrinsicT") :], "not read: extrinsicTranslation"),
        (orb("Omni", R4, RADTAN.coefficients, ""), "ORB-SLAM's camera model Omni is not supported"),
        (orb("PinHole", R4, RADTAN.coefficients, matrix("LEFT.K", T0)), "older settings with LEFT.K"),
        (orb("PinHole", R4, RADTAN.coefficients, "").replace("Camera.width: 64\n", ""), "ORB-SLAM.*no 'Camera.width'"),
        (orb("PinHole", R4, RADTAN.coefficients, matrix("IMU.T_b_c1", 2.0 * T0)), "not a rigid transform"),
        (orb("PinHole", R4, RADTAN.coefficients, matrix("Tbc", T0.T)), "Tbc is not a rigid transform"),
        (vins_lens() + VINS.replace(str(T0[0, 0]), "2.0"), "extrinsicRotation is not a rigid transform"),
        (ECHO.replace("binning_x: 0", "binning_x: 2"), "binning and parts of an image are not read"),
        (ECHO + "roi: {x_offset: 9, y_offset: 0}\n", "binning and parts of an image are not read"),
        (opencv(D5, size=""), "without image size; add image_width"),
        (MAPLAB.replace("    label: c", "    time_offset: 0.1"), "not read: time_offset"),
        (MAPLAB.replace("label: rig", "T_G_B: 1"), "not read: T_G_B"),
        ('{"camera_model": "OPENCV", "fl_x": 10.0, "k1": 0.0, "k2": 0.0}', "holds camera_model, fl_x"),
        ("# oST version 5.0 parameters\n", "is ROS's ost.txt; give its ost.yaml"),
        ("sensors:\n  - {sensor_type: NCAMERA}\n", "is maplab's file of all sensors; give the block of its NCAMERA"),
        (XML.replace("<opencv_storage>", "<!DOCTYPE x><opencv_storage>"), "no document type"),
        (XML[:-20], "cannot be read as JSON or XML"),
        ("<svg></svg>", "holds <svg>"),
        ('{"value0": {', "cannot be read as JSON or XML"),
        ("relative_config_imucam: chain.yaml\nverbosity: INFO\n", "holds relative_config_imucam, verbosity"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_by_program_and_model(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "theirs").write_text(text)
    with pytest.raises(DataError, match=words):
        read_cameras(tmp_path / "theirs")


def test_densities_of_other_programs_are_read_and_vins_has_none(tmp_path: Path) -> None:
    noise = ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3, 200.0)
    for text in (orb("PinHole", R4, RADTAN.coefficients, ""), basalt(), OKVIS.replace("params", "parameters")):
        (tmp_path / "theirs").write_text(text)
        assert read_noise(tmp_path / "theirs") == noise
    for text, words in (
        (vins_lens() + VINS, "acc_n and gyr_n are tuned"),
        (basalt(calib_accel_bias=[0.1] * 3 + [0.01] * 6), "not read: scale in calib_accel_bias;"),
        (OKVIS.replace("params:\n", "params:\n  s_a: [1, 1, 1.1]\n"), "not read: scale in s_a;"),
    ):
        (tmp_path / "theirs").write_text(text)
        with pytest.raises(DataError, match=words):
            read_noise(tmp_path / "theirs")


def test_a_pair_whose_place_is_stated_to_each_other_alone_keeps_its_baseline(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mav0 = write_asl(tmp_path)
    rows = "".join(f"  - {row}\n" for row in np.linalg.inv(T01).tolist())
    lens = (
        f"  camera_model: pinhole\n  intrinsics: {list(PINHOLE)}\n  distortion_model: none\n  distortion_coeffs: []\n"
    )
    lens += f"  resolution: [{WIDTH}, {HEIGHT}]\n"
    chain = tmp_path / "chain.yaml"
    chain.write_text(f"cam0:\n{lens}cam1:\n  T_cn_cnm1:\n{rows}{lens}")
    assert isinstance(read_cameras(chain)[1], CameraCalibration) and read_cameras(chain)[1].T_body_cam is None
    placed = chain.with_name("placed.yaml")
    placed.write_text(
        re.sub(r"cam\d:\n", lambda found: f"{found[0]}  T_imu_cam: {np.eye(4).tolist()}\n", chain.read_text())
    )
    assert read_cameras(placed)[1].T_body_cam == pytest.approx(np.eye(4))
    assert "not used: T_cn_cnm1 of cam1, which contradicts" in caplog.text
    rig = open_dataset(str(mav0), CalibrationConfig(camera=str(chain))).rig
    assert rig.T_cam0_cam1 == pytest.approx(T01) and rig.T_body_cams[0][0, 3] == 0.0


def test_a_sensor_yaml_with_another_programs_pose_is_refused(tmp_path: Path) -> None:
    mav0 = write_asl(tmp_path, stereo=False)
    (mav0 / "cam0" / "sensor.yaml").write_text(camera_yaml().replace("T_BS", "T_imu_cam"))
    with pytest.raises(DataError, match=r"not read: T_imu_cam.*write T_BS"):
        open_dataset(str(mav0))
