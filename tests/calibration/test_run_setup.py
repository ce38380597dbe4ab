"""What is calibrated before a run is what the run begins with."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vislam.cli.verbs.live import LiveOptions, begun_by_page
from vislam.cli.wizard.run_setup import RunSetup
from vislam.config import CalibrationConfig, Config, SensorCalibration, SensorsConfig
from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import se3_exp
from vislam.datasets.camera_files import CameraCalibration, camchain_text, read_cameras
from vislam.datasets.imu_files import calibration_text
from vislam.hw.sensors import calibration_of
from vislam.imu import ImuCalibration, MagCalibration
from vislam.live.web.updates import Asked

LENS = Camera(640, 480, 512.0, 511.0, 320.5, 239.5, distortion="radtan", coefficients=(-0.2, 0.05, 0.0, 0.0))
OLD_LENS = replace(LENS, fx=600.0, fy=600.0, distortion="none", coefficients=())
PLACE = se3_exp(np.array([0.1, -0.2, 0.3, 0.05, 0.01, -0.02]))
IMU = ImuCalibration(
    np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.3]), 1.01 * np.eye(3), np.diag([1.02, 0.98, 1.01])
)


def setup(source: str = "gy85+webcam", sensors: SensorsConfig | None = None, camera: Path | None = None) -> RunSetup:
    files = CalibrationConfig(camera=None if camera is None else str(camera))
    return RunSetup(source, replace(Config(), calibration=files), sensors or SensorsConfig())


@pytest.mark.parametrize("source", ["gy85+webcam", "serial:/dev/ttyUSB0+0", "mpu6050+none", "realsense,depth", "oak"])
def test_the_chips_of_the_source_get_what_was_found_and_keep_their_axes(tmp_path: Path, source: str) -> None:
    turned = SensorCalibration(gyro_axes=("y", "-x", "z"), mag_bias_ut=(1.0, 2.0, 3.0))
    inertial = source.partition("+")[0].partition(",")[0]
    before = setup(source)
    section = {"gy85": "gy85", "serial": "serial", "mpu6050": "board", "realsense": "realsense", "oak": "oak"}[
        inertial.partition(":")[0]
    ]
    own = replace(getattr(before.sensors, section), calibration=turned)
    before = replace(before, sensors=replace(before.sensors, **{section: own}))
    (tmp_path / "imu.yaml").write_text(calibration_text(IMU, ""))
    after, use = before.calibrated("imu", tmp_path)
    told = calibration_of(inertial, after.sensors)
    assert told.gyro_axes == ("y", "-x", "z") and told.mag_bias_ut == (1.0, 2.0, 3.0)
    assert np.allclose(told.accel_matrix, IMU.accel_matrix) and np.allclose(told.gyro_bias_rad_s, IMU.gyro_bias_rad_s)
    others = [name for name in ("gy85", "serial", "board", "realsense", "oak") if name != section]
    assert all(getattr(after.sensors, name) == getattr(before.sensors, name) for name in others)
    assert "begins with it" in use
    (tmp_path / "mag.yaml").write_text(calibration_text(MagCalibration(np.array([5.0, 6.0, 7.0])), ""))
    after, _ = after.calibrated("mag", tmp_path)
    told = calibration_of(inertial, after.sensors)
    assert told.mag_bias_ut == (5.0, 6.0, 7.0) and np.allclose(told.accel_matrix, IMU.accel_matrix)


def test_a_new_lens_stays_where_the_cameras_file_has_it(tmp_path: Path) -> None:
    told = tmp_path / "told.yaml"
    told.write_text(camchain_text([CameraCalibration(OLD_LENS, PLACE, 0.012)], ""))
    (tmp_path / "camchain.yaml").write_text(camchain_text([CameraCalibration(LENS)], ""))
    after, use = setup(camera=told).calibrated("camera", tmp_path)
    assert after.config.calibration.camera is not None and "camera.yaml" in use
    found = read_cameras(Path(after.config.calibration.camera))[0]
    assert found.camera == LENS and found.T_body_cam is not None and np.allclose(found.T_body_cam, PLACE)
    assert found.time_offset_s == pytest.approx(0.012)
    assert read_cameras(told)[0].camera == OLD_LENS


def test_a_lens_without_a_place_is_not_begun_with_and_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(camchain_text([CameraCalibration(LENS)], ""))
    before = setup()
    after, use = before.calibrated("camera", tmp_path)
    assert after is before and "camera-imu" in use
    after, use = setup("oak,depth").calibrated("camera", tmp_path)
    assert after.config.calibration.camera is None and "maker" in use


def test_noise_is_a_file_of_the_settings(tmp_path: Path) -> None:
    after, _ = setup().calibrated("noise", tmp_path)
    assert after.config.calibration.imu_noise == str(tmp_path / "noise.yaml")


def test_a_replay_takes_files_and_refuses_what_its_recording_cannot_be_read_with(tmp_path: Path) -> None:
    before = setup(f"replay:{tmp_path / 'nowhere'}")
    after, use = before.calibrated("imu", tmp_path)
    assert after is before and use.startswith("the run begins without it: ")


def test_a_file_that_was_spoilt_is_told(tmp_path: Path) -> None:
    (tmp_path / "imu.yaml").write_text("accel_bias: [nan, 0, 0]\n")
    with pytest.raises(DataError):
        setup().calibrated("imu", tmp_path)


class Station:
    """Stands for the page: hears these commands, then nothing."""

    is_well = True

    def __init__(self, *asked: Asked) -> None:
        self._asked = list(asked)
        self.told: list[dict] = []

    def asked(self):
        return [self._asked.pop(0)] if self._asked else []

    def update(self, phase: str, **values) -> None:
        self.told.append(values)


def test_the_run_is_made_of_what_was_calibrated_before_start(tmp_path: Path, monkeypatch) -> None:
    from vislam.cli.wizard import calibration_steps

    def calibrates(self, do, values) -> None:
        self.setup = replace(self.setup, config=replace(self.setup.config, seed=77))

    monkeypatch.setattr(calibration_steps.CalibrationSteps, "obey", calibrates)
    monkeypatch.setattr(calibration_steps, "_READ_S", 0.001)
    options = LiveOptions(out=tmp_path, settings=Config(), sensors=SensorsConfig())
    made, found = begun_by_page(
        Station(Asked("next", {}), Asked("start", {})), options, ["vislam"], lambda given: given.settings.seed
    )
    assert made == found.settings.seed == 77 and options.settings.seed != 77
