"""OAK cameras (OAK-D and its like) through depthai 3: the stereo pair, stamped in the middle of the exposure."""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Any

import numpy as np

from vislam.config import OakConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError, HardwareError
from vislam.core.messages import Array, Frame
from vislam.hw.cameras.factory import factory_camera, mounted, rigid
from vislam.hw.cameras.library_camera import LibraryCamera, named
from vislam.hw.cameras.webcam import Setting

_NEXT = timedelta(seconds=1)  # without an image for so long, the device is opened anew
_EARLY_NS = 5_000_000  # depthai's match of clocks was seen to be early by a couple of milliseconds
_MODELS = {"Perspective": "radtan", "Fisheye": "equidistant"}
_CM = 0.01  # in which depthai states extrinsics


class OakStream:
    """Satisfies `Stream`: a pipeline that runs on the device."""

    settings: tuple[Setting, ...] = ()  # depthai 3 does not read back what the sensors do

    def __init__(self, config: OakConfig) -> None:
        """Load the device's firmware and start; without a device depthai raises RuntimeError."""
        self._dai = depthai()
        self._period_ns = round(1e9 / config.rate_hz)
        self._max_age_ns = round(config.max_age_s * 1e9)
        self._age_ns = 0
        self.stamped_by, self.bad_stamps = "not known yet", 0
        self._device = _device(self._dai, config)
        try:
            calibration = self._device.readCalibration()
            self._pipeline = self._dai.Pipeline(self._device)
            sockets = calibration.getStereoLeftCameraId(), calibration.getStereoRightCameraId()
            self._queues = [self._queue(socket, config) for socket in sockets]
            self._pipeline.start()
        except BaseException:
            self._device.close()
            raise

    def next(self) -> Frame | None:
        """Return the next pair; None for an image whose partner was lost. Raises HardwareError after a second."""
        pair = [self._image(queue) for queue in self._queues]
        for _ in range(2):  # what is older by more than half a period has no partner
            lag_ns = _middle_ns(self._dai, pair[0]) - _middle_ns(self._dai, pair[1])
            if abs(lag_ns) <= self._period_ns // 2:
                break
            older = int(lag_ns > 0)
            pair[older] = self._image(self._queues[older])
        else:
            return None
        t_ns = self._stamp(_middle_ns(self._dai, pair[0]))
        return Frame(t_ns, 0, tuple(np.array(image.getCvFrame(), dtype=np.uint8) for image in pair))

    def close(self) -> None:
        """Give the device back."""
        try:
            self._pipeline.stop()
        finally:  # where it was pulled out, too
            self._device.close()

    def _queue(self, socket: Any, config: OakConfig) -> Any:
        """Return the queue of one camera's grey images."""
        camera = self._pipeline.create(self._dai.node.Camera).build(socket)
        if config.exposure_s is not None:
            iso = 400 if config.gain is None else round(config.gain)
            camera.initialControl.setManualExposure(round(config.exposure_s * 1e6), iso)
        size, grey = (config.width_px, config.height_px), self._dai.ImgFrame.Type.GRAY8
        return camera.requestOutput(size, type=grey, fps=config.rate_hz).createOutputQueue(maxSize=4, blocking=False)

    def _image(self, queue: Any) -> Any:
        image = queue.get(_NEXT)
        if image is None:
            raise HardwareError("the OAK stopped giving images; replug it, into a USB 3 port")
        return image

    def _stamp(self, middle_ns: int) -> int:
        """Return depthai's time of the middle of the exposure on CLOCK_MONOTONIC."""
        now_ns = time.monotonic_ns()
        age_ns = _ns(self._dai.Clock.now()) - middle_ns
        if -_EARLY_NS <= age_ns <= self._max_age_ns:
            self.stamped_by = "the device, in the middle of the exposure, by depthai's match of its clock to the host's"
            self._age_ns = age_ns
        else:
            self.stamped_by = "arrival"
            self.bad_stamps += 1
        return now_ns - self._age_ns


def open_oak(config: OakConfig, must_be_there: bool = True) -> LibraryCamera[Frame]:
    """Open an OAK camera.

    Raises HardwareError when depthai is not installed or, where it must be there, the device is missing.
    """
    depthai()
    return LibraryCamera("oak", lambda: OakStream(config), config, must_be_there)


def oak_rig(config: OakConfig) -> Rig:
    """Return the rig by the calibration in the device, which is opened for it, mounted as the settings say.

    Raises:
        HardwareError: depthai or the device is missing.
        DataError: its calibration cannot be used.
    """
    dai = depthai()
    try:
        device = _device(dai, config)
    except RuntimeError as error:
        raise HardwareError(f"no OAK{named(config)} can be opened ({error}); plug it into a USB 3 port") from error
    try:
        calibration = device.readCalibration()
        sockets = calibration.getStereoLeftCameraId(), calibration.getStereoRightCameraId()
        size, cameras = (config.width_px, config.height_px), []
        for socket in sockets:
            _check_shape(calibration.getDefaultIntrinsics(socket)[1:], size)
            K = np.array(calibration.getCameraIntrinsics(socket, *size))
            model = calibration.getDistortionModel(socket).name
            coefficients = calibration.getDistortionCoefficients(socket)
            pinhole = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            cameras.append(factory_camera(size, pinhole, _MODELS.get(model, model), coefficients))
        T: Array = np.array(calibration.getCameraExtrinsics(*sockets))  # takes points of the left into the right
    except RuntimeError as error:
        raise HardwareError(
            f"the OAK does not tell its calibration ({error}); give --calibration.camera FILE"
        ) from error
    finally:
        device.close()
    return mounted(cameras, [np.eye(4), rigid(T[:3, :3], T[:3, 3] * _CM)], False, config)


def check_oak(config: OakConfig) -> None:
    """Raise HardwareError when depthai is not installed or no device is plugged in; none is opened."""
    if not depthai().Device.getAllConnectedDevices():
        raise HardwareError(
            f"there is no OAK{named(config)}; plug it into a USB 3 port, with a cable that carries data"
        )


def depthai() -> Any:
    """Return depthai, version 3; raises HardwareError without it."""
    try:
        import depthai as module
    except (ImportError, OSError) as error:
        raise HardwareError(f"oak needs depthai ({error}); pip install 'vislam[oak]'") from error
    if not hasattr(module.node, "Camera"):
        raise HardwareError("oak needs depthai 3, an older one is installed; pip install 'vislam[oak]'")
    return module


def _check_shape(sensor: tuple[int, int], size: tuple[int, int]) -> None:
    """Raise DataError for images of another shape than the sensor's: what is cut off then, depthai does not tell."""
    if sensor[0] * size[1] != sensor[1] * size[0]:
        raise DataError(
            f"the OAK's calibration is for {sensor[0]}x{sensor[1]}, which is not the shape of {size[0]}x{size[1]}; "
            f"ask for {sensor[0] // 2}x{sensor[1] // 2} (width_px, height_px), or give --calibration.camera FILE"
        )


def _device(dai: Any, config: OakConfig) -> Any:
    return dai.Device(dai.DeviceInfo(config.device)) if config.device else dai.Device()


def _middle_ns(dai: Any, image: Any) -> int:
    return _ns(image.getTimestamp(dai.CameraExposureOffset.MIDDLE))


def _ns(since: timedelta) -> int:
    return (since // timedelta(microseconds=1)) * 1000
