"""The recorder: writes values as an ASL folder that `asl.py` reads, so that a crash costs at most the last row.

An image is written before the row that names it, rows go straight to the operating system, and a row that did not fit
on the disk is taken back. docs/formats.md describes the folder.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Rig
from vislam.core.errors import DataError, StorageError, UsageError
from vislam.core.geometry import quaternion_wxyz
from vislam.core.messages import Array, Frame, ImageF32, ImageU8, ImuSample, MagSample
from vislam.core.recording import Problems, Recording
from vislam.datasets.calibration import DEPTH_UNITS_PER_M
from vislam.datasets.calibration_text import camera_text, depth_text, imu_text, pose_text
from vislam.datasets.imu_files import calibration_keys
from vislam.imu import ImuCalibration, ImuNoise, MagCalibration

ImageFormat = Literal["png", "jpg"]

_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_MAG_HEADER = "#timestamp [ns],field_x [uT],field_y [uT],field_z [uT]"
_TRUTH_HEADER = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
_IMAGE_HEADER = "#timestamp [ns],filename"
_ENCODING: dict[ImageFormat, list[int]] = {
    # lossless; measured on 640x480 colour: 15 ms, 368 kB; the default strategy 18 ms, 416 kB; level 3 27 ms, 398 kB
    "png": [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE],
    "jpg": [cv2.IMWRITE_JPEG_QUALITY, 95],
}


class Recorder:
    """Writes samples, frames and true poses into a new ASL folder; use it as a context manager.

    `problems` counts what could not be written as it came: frames whose stamp does not rise, depth beyond 16 bits.
    `bytes_written` is how much was written, without what the file system adds.
    """

    def __init__(
        self,
        folder: Path,
        rig: Rig | None,
        imu_noise: ImuNoise | None,
        *,
        image_format: ImageFormat = "png",
        depth_units_per_m: float = DEPTH_UNITS_PER_M,
        comment: str = "recorded by vislam",
        imu_calibration: ImuCalibration | None = None,
        mag_calibration: MagCalibration | None = None,
        keeps_parts: bool = True,
    ) -> None:
        """Make the folder and its sensor files. Without a rig there will be no frames, without noise no IMU samples.

        Where a calibration is given, samples are written raw and readers apply it. Without `keeps_parts` the recording
        appears when the context is left without an error, and what there is of it is removed else.

        Raises:
            UsageError: the folder already holds something; a recording is never overwritten.
            StorageError: the folder cannot be written.
        """
        self.problems = Problems()
        self.counts = {"frames": 0, "imu samples": 0, "mag samples": 0, "true poses": 0}
        self._whole = folder / "mav0"
        self._root = self._whole if keeps_parts else folder / ".mav0.partial"
        self.bytes_written = 0
        self._rig = rig
        self._has_imu = imu_noise is not None
        self._mag_keys = "" if mag_calibration is None else calibration_keys(mag_calibration)
        self._image_format: ImageFormat = image_format
        self._depth_units_per_m = depth_units_per_m
        self._logs: dict[str, _RowLog] = {}
        self._readings: dict[str, _RowLog] = {}  # of further sensors
        self._newest_ns: int | None = None
        self._last_frame_ns: int | None = None
        try:
            left = [] if folder.is_dir() or not folder.exists() else [folder]
            left += [path for path in folder.glob("*") if path.name != ".mav0.partial"]
            if left:
                raise UsageError(f"{folder} already holds something; choose a new folder for the recording")
            shutil.rmtree(folder / ".mav0.partial", ignore_errors=True)  # of a process that was killed
        except OSError as error:
            raise self._storage_error(error, folder) from error
        try:
            imu_keys = "" if imu_calibration is None else calibration_keys(imu_calibration)
            self._make_folders(rig, imu_noise, comment, imu_keys)
        except OSError as error:
            shutil.rmtree(self._root, ignore_errors=True)  # a recording of nothing would be in the way of the next try
            raise self._storage_error(error, folder) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
        if self._root == self._whole:
            return
        try:
            if kind is None:
                self._root = self._root.replace(self._whole)
        except OSError as failed:
            raise self._storage_error(failed, self._whole) from failed
        finally:
            shutil.rmtree(self._whole.with_name(".mav0.partial"), ignore_errors=True)

    def write(self, value: ImuSample | MagSample | Frame) -> None:
        """Append one value.

        Raises:
            StorageError: the disk is full or failed; what was written before is a valid recording.
            DataError: the value does not belong to the rig that this recording was begun with.
        """
        try:
            if isinstance(value, ImuSample):
                self._write_imu(value)
            elif isinstance(value, MagSample):
                self.bytes_written += self._log("mag0", _MAG_HEADER).append(value.t_ns, value.field_ut)
                self.counts["mag samples"] += 1
            else:
                self._write_frame(value)
        except OSError as error:
            self.close()
            raise self._storage_error(error, self._root) from error
        self._newest_ns = value.t_ns if self._newest_ns is None else max(self._newest_ns, value.t_ns)

    def write_truth(self, t_ns: int, T_world_body: Array) -> None:
        """Append one true pose [4, 4] of the body; raises StorageError as `write` does."""
        quaternion = quaternion_wxyz(np.ascontiguousarray(T_world_body[:3, :3]))
        try:
            log = self._log("mocap0", _TRUTH_HEADER)
            self.bytes_written += log.append(t_ns, np.concatenate([T_world_body[:3, 3], quaternion]))
        except OSError as error:
            self.close()
            raise self._storage_error(error, self._root) from error
        self.counts["true poses"] += 1

    def begin_readings(self, name: str, header: str) -> None:
        """Make NAME.csv of a further sensor, beside the folders of IMU and camera; `header` names stamp and values.

        Raises StorageError as `write` does.
        """
        try:
            self._readings[name] = _RowLog(self._root.parent / f"{name}.csv", header)
        except OSError as error:
            self.close()
            raise self._storage_error(error, self._root) from error
        self.counts[f"{name} readings"] = 0

    def write_reading(self, name: str, t_ns: int, values: Array) -> None:
        """Append a reading to a table that was begun; raises StorageError as `write` does."""
        try:
            self.bytes_written += self._readings[name].append(t_ns, values)
        except OSError as error:
            self.close()
            raise self._storage_error(error, self._root) from error
        self.counts[f"{name} readings"] += 1

    def close(self) -> None:
        """Flush to the disk and close; the recorder cannot be written to afterwards. Closing twice does nothing."""
        logs, self._logs, self._readings = (*self._logs.values(), *self._readings.values()), {}, {}
        for log in logs:
            log.close()

    def _make_folders(self, rig: Rig | None, noise: ImuNoise | None, comment: str, imu_keys: str) -> None:
        self._root.mkdir(parents=True)
        if rig is not None:
            for i, (camera, T_body_cam) in enumerate(zip(rig.cameras, rig.T_body_cams, strict=True)):
                self._make_images(f"cam{i}", camera_text(camera, T_body_cam, comment))
            if rig.has_depth:
                self._make_images("depth0", depth_text(rig.cameras[0], self._depth_units_per_m))
        if noise is not None:
            self._make_sensor("imu0", imu_text(noise, comment) + imu_keys)
            self._log("imu0", _IMU_HEADER)

    def _make_images(self, name: str, sensor_text: str) -> None:
        self._make_sensor(name, sensor_text)
        (self._root / name / "data").mkdir()
        self._log(name, _IMAGE_HEADER)

    def _make_sensor(self, name: str, text: str) -> None:
        (self._root / name).mkdir()
        (self._root / name / "sensor.yaml").write_text(text, encoding="utf-8")

    def _log(self, name: str, header: str) -> _RowLog:
        """Return the table of a sensor; those that may never speak (magnetometer, truth) are made when they do."""
        if name not in self._logs:
            if not self._logs and self._newest_ns is not None:
                raise UsageError(f"the recording {self._root.parent} is closed; begin a new one")
            folder = self._root / name
            if not folder.is_dir():
                keys = self._mag_keys if name == "mag0" else ""
                self._make_sensor(name, f"sensor_type: {name.rstrip('0')}\n{pose_text(np.eye(4))}{keys}")
            self._logs[name] = _RowLog(folder / "data.csv", header)
        return self._logs[name]

    def _write_imu(self, sample: ImuSample) -> None:
        if not self._has_imu:
            raise DataError("an IMU sample came, but the recording was begun without the noise model of an IMU")
        values = np.concatenate([sample.gyro_rad_s, sample.accel_m_s2])
        self.bytes_written += self._log("imu0", _IMU_HEADER).append(sample.t_ns, values)
        self.counts["imu samples"] += 1

    def _write_frame(self, frame: Frame) -> None:
        rig = self._rig
        if rig is None:
            raise DataError("a frame came, but the recording was begun without a camera")
        if self._last_frame_ns is not None and frame.t_ns <= self._last_frame_ns:
            self.problems.count("frame whose stamp does not rise", f"{frame.t_ns} ns")
            return
        if len(frame.images) != len(rig.cameras):
            raise DataError(f"a frame of {len(frame.images)} images came for a rig of {len(rig.cameras)} cameras")
        if frame.depth_m is not None and not rig.has_depth:
            raise DataError("a frame with depth came, but the recording was begun with a rig without depth")
        for camera, image in zip(rig.cameras, frame.images, strict=True):
            camera.check_image(image)
        for extra in (frame.color, frame.depth_m):
            if extra is not None:
                rig.cameras[0].check_image(extra)
        images: list[ImageU8] = list(frame.images)
        if frame.color is not None:
            images[0] = frame.color  # the grey image is made from it on reading
        for i, image in enumerate(images):
            self._write_image(f"cam{i}", frame.t_ns, image, self._image_format)
        if frame.depth_m is not None:
            depth_ns = frame.t_ns + round(frame.depth_lag_s * 1e9)
            self._write_image("depth0", depth_ns, self._raw_depth(frame.depth_m), "png")
        self._last_frame_ns = frame.t_ns
        self.counts["frames"] += 1

    def _raw_depth(self, depth_m: ImageF32) -> NDArray[np.uint16]:
        raw = np.rint(np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0) * self._depth_units_per_m)
        beyond = raw > np.iinfo(np.uint16).max
        self.problems.count("depth pixel beyond 16 bits", times=int(np.count_nonzero(beyond)))
        return np.where(beyond | (raw < 0), 0, raw).astype(np.uint16)

    def _write_image(self, name: str, t_ns: int, image: NDArray[np.generic], image_format: ImageFormat) -> None:
        log = self._log(name, _IMAGE_HEADER)
        path = self._root / name / "data" / f"{t_ns}.{image_format}"
        ok, encoded = cv2.imencode(f".{image_format}", image, _ENCODING[image_format])
        if not ok:
            raise DataError(f"image of {name} at {t_ns} ns cannot be encoded as {image_format}")
        try:
            path.write_bytes(encoded.tobytes())
        except OSError as error:
            with suppress(OSError):
                path.unlink()
            raise OSError(error.errno, error.strerror, str(path)) from error
        self.bytes_written += len(encoded)
        self.bytes_written += log.append_text(f"{t_ns},{path.name}")

    def _storage_error(self, error: OSError, where: Path) -> StorageError:
        reason = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror or str(error)
        said = f"{error.filename or where} cannot be written: {reason}"
        if self._root != self._whole:
            return StorageError(f"{said}; free some space, then do it again: nothing is kept of it")
        kept = ", ".join(f"{count} {what}" for what, count in self.counts.items() if count) or "nothing"
        until = "" if self._newest_ns is None else f" up to t={self._newest_ns * 1e-9:.3f} s"
        return StorageError(
            f"{said}; kept {kept}{until} in {self._root.parent}; free some space and record into a new folder"
        )


class _RowLog:
    """A table that is appended to row by row, unbuffered; a row is in it whole or not at all."""

    def __init__(self, path: Path, header: str) -> None:
        self._path = path
        self._file = path.open("wb", buffering=0)
        self._size = 0
        self.append_text(header)

    def append(self, t_ns: int, values: Array) -> int:
        """Append a stamp and numbers, written so that reading gives the same bits; return how many bytes that took."""
        return self.append_text(f"{t_ns}," + ",".join(repr(float(value)) for value in values))

    def append_text(self, row: str) -> int:
        """Append one row and return its bytes; raises OSError naming the file, with the row taken back."""
        data = row.encode("utf-8") + b"\n"
        try:
            written = self._file.write(data)
            if written != len(data):  # the disk took a part: the next attempt shows why
                self._file.write(data[written or 0 :])
                written = self._file.seek(0, os.SEEK_CUR) - self._size
                if written != len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self._size)
            raise OSError(error.errno, error.strerror, str(self._path)) from error
        self._size += len(data)
        return len(data)

    def close(self) -> None:
        """Force what was written onto the disk and close the file."""
        with suppress(OSError):
            os.fsync(self._file.fileno())
        self._file.close()


def record(
    recording: Recording,
    folder: Path,
    image_format: ImageFormat = "png",
    on_frame: Callable[[int], None] | None = None,
) -> Recorder:
    """Write a whole recording with its truth into a new ASL folder and return the closed recorder.

    `on_frame` gets the number of frames written, after each. The recording is there whole or not at all. Raises
    UsageError, DataError and StorageError as `Recorder` does.
    """
    comment = f"vislam, {recording.name}"
    with Recorder(
        folder, recording.rig, recording.imu_noise, image_format=image_format, comment=comment, keeps_parts=False
    ) as recorder:
        truth = recording.truth()
        if truth is not None:
            for t_ns, T_world_body in zip(truth.t_ns.tolist(), truth.T_world_body, strict=True):
                recorder.write_truth(t_ns, T_world_body)
        for value in recording.events():
            recorder.write(value)
            if on_frame is not None and isinstance(value, Frame):
                on_frame(recorder.counts["frames"])
    return recorder
