"""RealSense through pyrealsense2: the infrared stereo pair, or colour with aligned depth, on the device's own clock."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np

from vislam.config import BridgeClockConfig, RealsenseConfig
from vislam.core.camera import Rig
from vislam.core.errors import HardwareError
from vislam.core.messages import Frame
from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.cameras.factory import factory_camera, mounted, rigid
from vislam.hw.cameras.library_camera import LibraryCamera, named
from vislam.hw.cameras.webcam import Setting

_NEXT_MS = 1000  # without frames for so long, the device is opened anew
_WRAP_US = 2**32
_MODELS = {"none": "none", "brown_conrady": "radtan", "kannala_brandt4": "equidistant"}


class RealsenseStream:
    """Satisfies `Stream`: a pipeline that runs."""

    def __init__(self, config: RealsenseConfig, with_depth: bool) -> None:
        """Start the pipeline; without a device the library raises RuntimeError."""
        self._rs = pyrealsense2()
        self._config, self._with_depth = config, with_depth
        self._pipeline = self._rs.pipeline()
        profile = self._pipeline.start(_asked(self._rs, config, with_depth))
        self.stamped_by, self.bad_stamps = "not known yet", 0
        self._align = self._rs.align(self._rs.stream.color) if with_depth else None
        self._clock = DeviceClock(BridgeClockConfig())
        self._delay_ns = round(config.delay_s * 1e9)
        self._number = -1
        try:
            self._m_per_unit = profile.get_device().first_depth_sensor().get_depth_scale()
            self.settings = self._set(profile.get_device())
        except BaseException:
            self.close()
            raise

    def next(self) -> Frame | None:
        """Return the next frame; None while its stamp is not to be trusted. Raises HardwareError after a second."""
        has_come, frames = self._pipeline.try_wait_for_frames(_NEXT_MS)
        if not has_come:
            raise HardwareError("the RealSense stopped giving images; replug it, into a USB 3 port")
        arrival_ns = time.monotonic_ns()
        first = frames.get_color_frame() if self._with_depth else frames.get_infrared_frame(1)
        t_ns = self._stamp(first, arrival_ns)
        if t_ns is None:
            return None
        if self._align is None:
            pair = tuple(np.array(frames.get_infrared_frame(k).get_data(), dtype=np.uint8) for k in (1, 2))
            return Frame(t_ns, 0, pair)
        aligned = self._align.process(frames)
        color = np.array(aligned.get_color_frame().get_data(), dtype=np.uint8)
        raw = np.asarray(aligned.get_depth_frame().get_data(), dtype=np.float32)
        return Frame(t_ns, 0, (grey(color),), color, raw * np.float32(self._m_per_unit))

    def close(self) -> None:
        """Give the device back."""
        with suppress(RuntimeError):  # it was pulled out
            self._pipeline.stop()

    def _stamp(self, frame: Any, arrival_ns: int) -> int | None:
        """Return the middle of the exposure on CLOCK_MONOTONIC; None where it is not known, or the frame is not new."""
        rs, number = self._rs, int(frame.get_frame_number())
        if number == self._number:
            return None
        self._number = number
        if frame.supports_frame_metadata(rs.frame_metadata_value.sensor_timestamp):
            device_us = int(frame.get_frame_metadata(rs.frame_metadata_value.sensor_timestamp))
            self.stamped_by = "the device's clock, in the middle of the exposure"
        elif frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
            device_us = round(frame.get_timestamp() * 1000.0)
            self.stamped_by = "the device's clock, when readout began"
        else:
            self.bad_stamps += 1
            self.stamped_by = "arrival"
            return arrival_ns - self._delay_ns
        stamp_ns = self._clock.stamp(device_us % _WRAP_US, arrival_ns)
        return None if stamp_ns is None else stamp_ns - self._delay_ns

    def _set(self, device: Any) -> tuple[Setting, ...]:
        """Fix what the device would change by itself; return all as read back."""
        option, config = self._rs.option, self._config
        sensors = {"depth": device.first_depth_sensor()}
        if self._with_depth:
            sensors["color"] = device.first_color_sensor()
        wanted = [("depth", "emitter_enabled", float(self._with_depth))]  # its dots move along with a stereo pair
        for name in sensors:
            wanted.append((name, "global_time_enabled", 0.0))
        lens = "color" if self._with_depth else "depth"
        wanted.append((lens, "enable_auto_exposure", float(config.exposure_s is None)))
        if config.exposure_s is not None:
            unit_s = 1e-4 if lens == "color" else 1e-6  # as the device counts
            wanted.append((lens, "exposure", config.exposure_s / unit_s))
        if config.gain is not None:
            wanted.append((lens, "gain", config.gain))
        settings: list[Setting] = []
        for name, what, value in wanted:
            sensor, which = sensors[name], getattr(option, what)
            if not sensor.supports(which):
                settings.append(Setting(f"{name} {what}", value, None))
                continue
            with suppress(RuntimeError):  # beyond its range: what it does then is read back
                sensor.set_option(which, value)
            settings.append(Setting(f"{name} {what}", value, float(sensor.get_option(which))))
        return tuple(settings)


def grey(color: Any) -> Any:
    """Return the grey image [H, W] of a BGR image [H, W, 3]."""
    import cv2

    return cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)


def open_realsense(config: RealsenseConfig, with_depth: bool, must_be_there: bool = True) -> LibraryCamera[Frame]:
    """Open a RealSense.

    Raises HardwareError when pyrealsense2 is not installed or, where it must be there, the device is missing.
    """
    pyrealsense2()
    name = "realsense,depth" if with_depth else "realsense"
    return LibraryCamera(name, lambda: RealsenseStream(config, with_depth), config, must_be_there)


def realsense_rig(config: RealsenseConfig, with_depth: bool) -> Rig:
    """Return the rig by the calibration in the device, mounted as the settings say; nothing streams.

    Raises:
        HardwareError: pyrealsense2 or the device is missing, or it has not these streams.
        DataError: its calibration cannot be used.
    """
    rs = pyrealsense2()
    try:
        profile = _asked(rs, config, with_depth).resolve(rs.pipeline_wrapper(rs.pipeline()))
    except RuntimeError as error:
        raise HardwareError(
            f"no RealSense{named(config)} gives {config.width_px}x{config.height_px} at {config.rate_hz:g} Hz "
            f"({error}); plug it into a USB 3 port, or ask for another size or rate"
        ) from error
    names = ((rs.stream.color, -1),) if with_depth else ((rs.stream.infrared, 1), (rs.stream.infrared, 2))
    streams = [profile.get_stream(*name).as_video_stream_profile() for name in names]
    cameras, poses = [], [np.eye(4)]
    for stream in streams:
        k = stream.get_intrinsics()
        model = str(k.model).rpartition(".")[2]
        pinhole = (k.fx, k.fy, k.ppx, k.ppy)
        cameras.append(factory_camera((k.width, k.height), pinhole, _MODELS.get(model, model), k.coeffs))
    for stream in streams[1:]:
        e = streams[0].get_extrinsics_to(stream)  # takes points of the first into it; columns of the rotation in a row
        poses.append(rigid(np.reshape(e.rotation, (3, 3)).T, np.array(e.translation)))
    return mounted(cameras, poses, with_depth, config)


def pyrealsense2() -> Any:
    """Return pyrealsense2; raises HardwareError without it."""
    try:
        import pyrealsense2 as module
    except (ImportError, OSError) as error:
        raise HardwareError(f"realsense needs pyrealsense2 ({error}); pip install 'vislam[realsense]'") from error
    return module


def _asked(rs: Any, config: RealsenseConfig, with_depth: bool) -> Any:
    """Return the library's request for the streams."""
    asked = rs.config()
    if config.device:
        asked.enable_device(config.device)
    size, rate = (config.width_px, config.height_px), round(config.rate_hz)
    if with_depth:
        asked.enable_stream(rs.stream.color, -1, *size, rs.format.bgr8, rate)
        asked.enable_stream(rs.stream.depth, -1, *size, rs.format.z16, rate)
    else:
        for index in (1, 2):
            asked.enable_stream(rs.stream.infrared, index, *size, rs.format.y8, rate)
    return asked
