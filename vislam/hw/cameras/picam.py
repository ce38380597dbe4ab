"""The Raspberry Pi's own camera through picamera2: stamps of the sensor, moved to the middle of the exposure."""

import time
from contextlib import closing, suppress
from typing import Any

import numpy as np

from vislam.config import PicamConfig
from vislam.core.errors import HardwareError, install_line
from vislam.hw.cameras.library_camera import Setting
from vislam.hw.cameras.video import MAX_AGE_S
from vislam.hw.source import CapturedImage

_NS = 1_000_000_000
_NEXT_S = 1.0  # without an image for this long, the camera is opened again
_EARLY_NS = 2_000_000  # clocks are read one after the other
_FORMAT = "RGB888"  # libcamera's name for what lies in memory as blue, green, red
_MANUAL_FOCUS = 0  # libcamera.controls.AfModeEnum.Manual
_DELAY_NS = 20_000_000  # of an image without a stamp, before any had one: readout and processing at 30 Hz


class PicamStream:
    """Satisfies `Stream`: one configuration of the camera, started."""

    def __init__(self, config: PicamConfig) -> None:
        """Open the camera and start it.

        Raises HardwareError when picamera2 or the camera is missing; picamera2 raises RuntimeError of its own.
        """
        module = picamera2()
        number = camera_number(config)
        there = [str(info.get("Model", info.get("Id"))) for info in module.Picamera2.global_camera_info()]
        if number >= len(there):
            raise HardwareError(
                f"there is no camera picam:{number}; libcamera finds: {', '.join(there) or 'none'}. Check its ribbon "
                "cable (both ends, contacts the right way round), then ask rpicam-hello what it finds"
            )
        self._camera = module.Picamera2(number)
        self.stamped_by, self.bad_stamps = "not known yet", 0
        self._max_age_ns = round(MAX_AGE_S * _NS)
        self._age_ns = _DELAY_NS
        try:
            self.settings = self._started(config)
        except BaseException:
            self.close()
            raise

    def next(self) -> CapturedImage | None:
        """Return the next image; raises HardwareError when none comes for a second."""
        job = self._camera.capture_request(wait=False)
        try:
            request = job.get_result(timeout=_NEXT_S)
        except TimeoutError as error:
            self._camera.cancel_all_and_flush()  # as picamera2 asks for before such a camera is closed
            raise HardwareError("the Raspberry Pi's camera stopped giving images; check its ribbon cable") from error
        arrival_ns, boot_ns = time.monotonic_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        try:
            image, metadata = request.make_array("main"), request.get_metadata()
        finally:
            request.release()  # its buffer is needed for the images to come
        stamp_ns = self._stamp(metadata, arrival_ns, boot_ns)
        return CapturedImage(stamp_ns, 0, np.asarray(image[..., :3], dtype=np.uint8))

    def close(self) -> None:
        """Give the camera back."""
        with suppress(RuntimeError):
            self._camera.stop()
        self._camera.close()

    def _started(self, config: PicamConfig) -> tuple[Setting, ...]:
        """Start the stream with controls in force from its first image; return what was asked and what it is."""
        camera = self._camera
        controls = _controls(config)
        offered = {name for name in controls if name in camera.camera_controls}
        video = camera.create_video_configuration(
            main={"format": _FORMAT, "size": (config.width_px, config.height_px)},
            buffer_count=config.buffers,
            controls={name: controls[name] for name in offered},
            queue=False,  # an image that was taken before it was asked for is an old one
        )
        camera.configure(video)
        camera.start()
        width, height = camera.camera_configuration()["main"]["size"]
        settings = [
            Setting("width [px]", float(config.width_px), float(width)),
            Setting("height [px]", float(config.height_px), float(height)),
        ]
        settings += [Setting(name, str(controls[name]), None) for name in controls if name not in offered]
        return tuple(settings)

    def _stamp(self, metadata: dict[str, Any], arrival_ns: int, boot_ns: int) -> int:
        """Return the middle of the exposure of the first line, on CLOCK_MONOTONIC.

        `SensorTimestamp` is taken as the first line begins to be read, the end of its exposure. By libcamera its
        clock is CLOCK_BOOTTIME, kernels have stamped with CLOCK_MONOTONIC: they differ by the time that the machine
        slept, and only one of them can be right.
        """
        sensor_ns = int(metadata.get("SensorTimestamp") or 0)
        ages_ns = {"": arrival_ns - sensor_ns, ", since boot": boot_ns - sensor_ns}
        possible = {name: age for name, age in ages_ns.items() if -_EARLY_NS <= age <= self._max_age_ns}
        if not possible:
            self.bad_stamps += 1
            self.stamped_by = "arrival"
            return arrival_ns - self._age_ns
        clock, age_ns = next(iter(possible.items()))
        exposure_ns = 1000 * int(metadata.get("ExposureTime") or 0)
        middle = ", less half the exposure" if exposure_ns else "; the exposure is unknown"
        self.stamped_by = f"the sensor's first line{clock}{middle}"
        self._age_ns = max(age_ns, 0) + exposure_ns // 2
        return arrival_ns - self._age_ns


def picamera2() -> Any:
    """Return picamera2; raises HardwareError without it."""
    try:
        import picamera2 as module
    except (ImportError, OSError) as error:  # OSError: a system library of it is missing
        raise HardwareError(
            f"picam needs picamera2 ({error}); on Raspberry Pi OS: sudo apt install python3-picamera2, in an "
            f"environment that sees the system's packages; elsewhere: {install_line('pi')}"
        ) from error
    return module


def check_picam(config: PicamConfig) -> None:
    """Raise HardwareError when picamera2 or the camera is missing; nothing is started."""
    module = picamera2()
    if camera_number(config) >= len(module.Picamera2.global_camera_info()):
        with closing(PicamStream(config)):  # reports what there is
            pass


def camera_number(config: PicamConfig) -> int:
    """Return the number of the camera; raises HardwareError where it is none."""
    if not config.device.isdigit():
        raise HardwareError(f"picam:{config.device} is no camera; give its number, as picam:0")
    return int(config.device)


def _controls(config: PicamConfig) -> dict[str, Any]:
    """Return libcamera's controls for the settings."""
    period_us = round(1e6 / config.rate_hz)
    controls: dict[str, Any] = {"FrameDurationLimits": (period_us, period_us)}
    if config.exposure_s is not None:
        controls |= {"AeEnable": False, "ExposureTime": round(config.exposure_s * 1e6)}
        controls["AnalogueGain"] = 1.0 if config.gain is None else config.gain
    if config.focus is not None:
        controls |= {"AfMode": _MANUAL_FOCUS, "LensPosition": config.focus}
    return controls
