"""What a waiting run will begin with: its settings and sensors, and what was calibrated meanwhile in their place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from vislam.config import Config, SensorsConfig
from vislam.core.errors import DataError
from vislam.core.files import write_text
from vislam.core.messages import Array
from vislam.datasets.camera_files import camchain_text, read_cameras
from vislam.datasets.imu_files import read_imu_calibration, read_mag_calibration
from vislam.hw.library_cameras import gives_frames
from vislam.hw.sensors import calibration_of, with_calibration
from vislam.runs.sources import open_source

_FILES = {"camera": "camchain.yaml", "imu": "imu.yaml", "mag": "mag.yaml", "noise": "noise.yaml"}
_NAMES = {"camera": "camera", "imu": "imu", "mag": "mag", "noise": "imu_noise"}  # of files in the settings
_COMPLETE = "camera.yaml"  # the new lens at the old place


@dataclass(frozen=True, slots=True, eq=False)
class RunSetup:
    """The source, the settings and the sensors of a run."""

    source: str
    config: Config
    sensors: SensorsConfig

    def calibrated(self, kind: str, folder: Path) -> tuple[RunSetup, str]:
        """Return the setup with what a kind of calibration has written into a folder, and what becomes of that.

        Raises DataError when a file cannot be used.
        """
        path = folder / _FILES[kind]
        if self.source.startswith("replay:"):
            return self._of_recording(*self._with_file(kind, path))
        if kind == "noise":
            return self._with_file(kind, path)
        inertial, plus, camera = self.source.partition("+")
        if kind == "camera":
            return self._with_camera(camera if plus else inertial, path)
        inertial = inertial.partition(",")[0]  # of a camera with the IMU inside it
        stated = calibration_of(inertial, self.sensors)
        if kind == "imu":
            found = read_imu_calibration(path)
            stated = replace(
                stated,
                gyro_bias_rad_s=_vector(found.gyro_bias_rad_s), gyro_matrix=_matrix(found.gyro_matrix),
                accel_bias_m_s2=_vector(found.accel_bias_m_s2), accel_matrix=_matrix(found.accel_matrix),
            )  # fmt: skip
        else:
            iron = read_mag_calibration(path)
            stated = replace(stated, mag_bias_ut=_vector(iron.bias_ut), mag_matrix=_matrix(iron.matrix))
        sensors = with_calibration(inertial, self.sensors, stated)
        return replace(self, sensors=sensors), "the run begins with it, in place of that in the sensors file"

    def _with_file(self, kind: str, path: Path) -> tuple[RunSetup, str]:
        files = replace(self.config.calibration, **{_NAMES[kind]: str(path)})
        return replace(self, config=replace(self.config, calibration=files)), f"the run begins with {path.name}"

    def _of_recording(self, other: RunSetup, use: str) -> tuple[RunSetup, str]:
        """Return the other setup if the recording can be read with it, as one of two cameras cannot with one lens."""
        uri = self.source.removeprefix("replay:")
        try:
            open_source(uri, other.config.seed, other.config.calibration)
        except DataError as error:
            return self, f"the run begins without it: {error}"
        return other, use

    def _with_camera(self, camera: str, path: Path) -> tuple[RunSetup, str]:
        """Put the new lens at the pose in the camera's file, which a board does not give."""
        if gives_frames(camera):
            return self, f"the run begins with its maker's calibration: {camera} has several cameras"
        before = self.config.calibration.camera
        stated = None if before is None else read_cameras(Path(before))[0]
        if stated is None or stated.T_body_cam is None:
            return self, "the run needs where the camera sits, too: vislam calibrate camera-imu adds that to the file"
        lens = read_cameras(path)[0].camera
        whole = path.with_name(_COMPLETE)
        text = camchain_text([replace(stated, camera=lens)], f"lens by {path.name}, place and clock by {before}")
        write_text(whole, text)
        return self._with_file("camera", whole)


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)


def _matrix(values: Array) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    first, second, third = (_vector(row) for row in values)
    return (first, second, third)
