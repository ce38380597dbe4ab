"""OAK cameras (OAK-D and its like) through depthai 3: the stereo pair or colour with depth, and their IMU."""

import threading
import time
from contextlib import suppress
from datetime import timedelta
from typing import Any

import numpy as np

from vislam.config import OakConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError, HardwareError, install_line
from vislam.core.messages import Array, Frame
from vislam.hw.cameras.factory import factory_camera, grey, looking_ahead, mounted, mounted_on_imu, rigid
from vislam.hw.cameras.library_camera import Setting, named
from vislam.hw.cameras.video import MAX_AGE_S
from vislam.hw.own_imu import OwnImu

_NEXT = timedelta(seconds=1)  # without an image for this long, the device is opened again
_MODELS = {"Perspective": "radtan", "Fisheye": "equidistant"}
_MM = 0.001  # in which depthai states depth
_STEREO_SIZE = (640, 400)  # of the grey images that depth is found in; as depthai's own examples have it
_CM = 0.01  # in which depthai states extrinsics
_EARLY_NS = 5_000_000  # depthai's match of clocks was seen to be early by a couple of milliseconds
_BRACKETS = 20  # readings of both clocks, of which the closest counts
_WAIT = timedelta(seconds=0.5)  # for samples; then it is looked whether to end
_JOIN_S = 2.0
_BATCH, _QUEUED = 1, 50  # reports in a message: each at once; messages that may wait
_STAMPED_BY = "the device, by depthai's match of its clock to the host's, which its images have too"


class OakClock:
    """Puts depthai's time on CLOCK_MONOTONIC, by one offset for all that a device stamps. For any thread."""

    def __init__(self, dai: Any, max_age_s: float) -> None:
        """Read both clocks some times; the closest bracket gives the offset."""
        self._max_age_ns = round(max_age_s * 1e9)
        self._age_ns = 0
        brackets = []
        for _ in range(_BRACKETS):
            before_ns = time.monotonic_ns()
            theirs_ns = _in_ns(dai.Clock.now())
            after_ns = time.monotonic_ns()
            brackets.append((after_ns - before_ns, (before_ns + after_ns) // 2 - theirs_ns))
        self._offset_ns = min(brackets)[1]

    def host_ns(self, theirs_ns: int) -> int | None:
        """Return the host's time of what has just arrived; None for one that is of no clock of ours."""
        t_ns = theirs_ns + self._offset_ns
        age_ns = time.monotonic_ns() - t_ns
        if not -_EARLY_NS <= age_ns <= self._max_age_ns:
            return None
        self._age_ns = age_ns
        return t_ns

    def arrival_ns(self) -> int:
        """Return the time now less the last good age: for what carries no time."""
        return time.monotonic_ns() - self._age_ns


class OakMotion:
    """A thread that takes the reports of the device's IMU."""

    def __init__(
        self, dai: Any, pipeline: Any, device: Any, config: OakConfig, imu: OwnImu, clock: OakClock,
        T_cam_imu: Array | None,
    ) -> None:  # fmt: skip
        """Add the node to a pipeline that is not started yet. Raises HardwareError where the device has no IMU."""
        if device.getConnectedIMU() in ("", "NONE"):
            raise HardwareError("this OAK has no IMU; take another IMU (--imu)")
        node = pipeline.create(dai.node.IMU)
        node.enableIMUSensor(list(_kinds(dai)), round(config.imu_rate_hz))
        node.setBatchReportThreshold(_BATCH)
        node.setMaxBatchReports(_QUEUED)
        self._queue = node.out.createOutputQueue(maxSize=_QUEUED, blocking=False)
        self._imu, self._clock = imu, clock
        self._R_body_imu = None if T_cam_imu is None else looking_ahead(config) @ T_cam_imu[:3, :3]
        self._rate_hz = config.imu_rate_hz
        self.failure: Exception | None = None
        self._is_stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="oak imu", daemon=True)

    def start(self) -> None:
        """Begin; the pipeline runs."""
        self._imu.begin(self._R_body_imu, self._rate_hz)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; may be called before it was started."""
        self._is_stopping.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            while not self._is_stopping.is_set():
                message = self._queue.get(_WAIT)
                for packet in () if message is None else message.packets:
                    self._take(packet.gyroscope, self._imu.add_gyro)
                    self._take(packet.acceleroMeter, self._imu.add_accel)
        except Exception as error:  # depthai raises what it likes; the images' thread reports it and opens again
            if not self._is_stopping.is_set():
                self.failure = error

    def _take(self, report: Any, add: Any) -> None:
        t_ns = self._clock.host_ns(_in_ns(report.getTimestamp()))
        if t_ns is None:
            self._imu.count("bad_stamps")
            return
        self._imu.stamped_by = _STAMPED_BY
        add(t_ns, np.array([report.x, report.y, report.z], dtype=np.float64))


def imu_pose(calibration: Any, socket: Any) -> Array | None:
    """Return the pose [4, 4] of the IMU in a camera by the factory; None where the device does not have it, as most."""
    T: Array | None = None
    with suppress(RuntimeError):  # there is none in its memory
        found = np.array(calibration.getCameraToImuExtrinsics(socket), dtype=np.float64)
        if np.any(found[:3, :3]):  # or it is left empty
            T = rigid(found[:3, :3], found[:3, 3] * _CM)
    return T


def _in_ns(since: timedelta) -> int:
    """Return a time of depthai in ns."""
    return (since // timedelta(microseconds=1)) * 1000


def _kinds(dai: Any) -> tuple[Any, Any]:
    """Return the streams of accelerometer and gyro: with the calibration in the device where depthai has that."""
    kinds = dai.IMUSensor
    if hasattr(kinds, "ACCELEROMETER_CALIBRATED"):  # depthai 3.12 and later
        return kinds.ACCELEROMETER_CALIBRATED, kinds.GYROSCOPE_CALIBRATED
    return kinds.ACCELEROMETER_RAW, kinds.GYROSCOPE_RAW


class OakStream:
    """Satisfies `Stream`: a pipeline that runs on the device, and with it the device's IMU where that is asked for."""

    settings: tuple[Setting, ...] = ()  # depthai 3 does not read back what the sensors do

    def __init__(self, config: OakConfig, with_depth: bool = False, imu: OwnImu | None = None) -> None:
        """Load the device's firmware and start; without a device depthai raises RuntimeError.

        What the device's IMU measures goes to `imu`. Raises HardwareError where it has none.
        """
        self._dai = depthai()
        self._with_depth = with_depth
        self._period_ns = round(1e9 / config.rate_hz)
        self.stamped_by, self.bad_stamps = "not known yet", 0
        self._clock = OakClock(self._dai, MAX_AGE_S)
        self._motion: OakMotion | None = None
        self._pipeline: Any = None
        self._device = _device(self._dai, config)
        try:
            calibration = self._device.readCalibration()
            self._pipeline = self._dai.Pipeline(self._device)
            if imu is not None:
                first = _sockets(calibration, self._dai, with_depth)[0]
                T_cam_imu = imu_pose(calibration, first)
                self._motion = OakMotion(self._dai, self._pipeline, self._device, config, imu, self._clock, T_cam_imu)
            if with_depth:
                is_newer = self._device.getPlatform() == self._dai.Platform.RVC4
                self._queues = [_colour_and_depth(self._dai, self._pipeline, calibration, config, is_newer)]
            else:
                self._queues = [self._queue(socket, config) for socket in _sockets(calibration, self._dai, with_depth)]
            self._pipeline.start()
            if self._motion is not None:
                self._motion.start()
        except BaseException:
            self.close()
            raise

    def next(self) -> Frame | None:
        """Return the next frame; None for an image whose partner was lost. Raises HardwareError after a second."""
        if self._motion is not None and self._motion.failure is not None:
            raise self._motion.failure
        if self._with_depth:
            group = self._image(self._queues[0])
            color = np.array(group["color"].getCvFrame(), dtype=np.uint8)
            depth_m = np.asarray(group["depth"].getFrame(), dtype=np.float32) * np.float32(_MM)
            return Frame(self._stamp(_middle_ns(self._dai, group["color"])), 0, (grey(color),), color, depth_m)
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
            if self._motion is not None:
                self._motion.stop()
            if self._pipeline is not None:
                self._pipeline.stop()
        finally:  # where it was pulled out, too
            self._device.close()

    def _queue(self, socket: Any, config: OakConfig) -> Any:
        """Return the queue of one camera's grey images."""
        camera = self._pipeline.create(self._dai.node.Camera).build(socket)
        _set_exposure(camera, config)
        size, grey = (config.width_px, config.height_px), self._dai.ImgFrame.Type.GRAY8
        return camera.requestOutput(size, type=grey, fps=config.rate_hz).createOutputQueue(maxSize=4, blocking=False)

    def _image(self, queue: Any) -> Any:
        image = queue.get(_NEXT)
        if image is None:
            raise HardwareError("the OAK stopped giving images; replug it, into a USB 3 port")
        return image

    def _stamp(self, middle_ns: int) -> int:
        """Return depthai's time of the middle of the exposure on CLOCK_MONOTONIC."""
        t_ns = self._clock.host_ns(middle_ns)
        if t_ns is not None:
            self.stamped_by = "the device, in the middle of the exposure, by depthai's match of its clock to the host's"
            return t_ns
        self.stamped_by = "arrival"
        self.bad_stamps += 1
        return self._clock.arrival_ns()


def oak_rig(config: OakConfig, with_depth: bool = False, with_imu: bool = False) -> tuple[Rig, bool]:
    """Return the rig by the calibration in the device, which is opened for it, and whether its IMU's place is known.

    It is mounted as the settings say, or with its own IMU as that lies beside its cameras, where the device has it.

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
        sockets = _sockets(calibration, dai, with_depth)
        cameras = (
            [_colour_camera(calibration, sockets[0], config)] if with_depth else _pair(calibration, sockets, config)
        )
        T_cam_imu = imu_pose(calibration, sockets[0]) if with_imu else None
        # takes points of the left into the right
        T: Array = np.eye(4) if with_depth else np.array(calibration.getCameraExtrinsics(*sockets))
    except RuntimeError as error:
        raise HardwareError(
            f"the OAK does not give its calibration ({error}); give --calibration.camera FILE"
        ) from error
    finally:
        device.close()
    poses = [np.eye(4)] if with_depth else [np.eye(4), rigid(T[:3, :3], T[:3, 3] * _CM)]
    if T_cam_imu is not None:
        return mounted_on_imu(cameras, poses, with_depth, config, T_cam_imu), True
    return mounted(cameras, poses, with_depth, config), False


def _pair(calibration: Any, sockets: tuple[Any, ...], config: OakConfig) -> list[Camera]:
    """Return the two grey cameras by their calibration."""
    size, cameras = (config.width_px, config.height_px), []
    for socket in sockets:
        _check_shape(calibration.getDefaultIntrinsics(socket)[1:], size)
        K = np.array(calibration.getCameraIntrinsics(socket, *size))
        model = calibration.getDistortionModel(socket).name
        coefficients = calibration.getDistortionCoefficients(socket)
        pinhole = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        cameras.append(factory_camera(size, pinhole, _MODELS.get(model, model), coefficients))
    return cameras


def _colour_and_depth(dai: Any, pipeline: Any, calibration: Any, config: OakConfig, is_newer: bool) -> Any:
    """Return the queue of groups of `color` and `depth` of one time.

    Depth is found in the grey pair and warped into the colour image, which is freed of its distortion for that: by the
    node of stereo depth itself, or (`is_newer`: RVC4) by one of its own.
    """
    node, rate = dai.node, config.rate_hz
    sockets = calibration.getStereoLeftCameraId(), calibration.getStereoRightCameraId()
    colour = pipeline.create(node.Camera).build(dai.CameraBoardSocket.CAM_A)
    _set_exposure(colour, config)
    stereo, sync = pipeline.create(node.StereoDepth), pipeline.create(node.Sync)
    for socket, entrance in zip(sockets, (stereo.left, stereo.right), strict=True):
        pipeline.create(node.Camera).build(socket).requestOutput(_STEREO_SIZE, fps=rate).link(entrance)
    size, bgr = (config.width_px, config.height_px), dai.ImgFrame.Type.BGR888i
    images = colour.requestOutput(size, type=bgr, fps=rate, enableUndistortion=True)
    sync.setSyncThreshold(timedelta(seconds=0.5 / rate))
    images.link(sync.inputs["color"])
    if is_newer:
        align = pipeline.create(node.ImageAlign)
        stereo.depth.link(align.input)
        images.link(align.inputAlignTo)
        align.outputAligned.link(sync.inputs["depth"])
    else:
        images.link(stereo.inputAlignTo)
        stereo.depth.link(sync.inputs["depth"])
    return sync.out.createOutputQueue(maxSize=2, blocking=False)


def _colour_camera(calibration: Any, socket: Any, config: OakConfig) -> Camera:
    """Return the colour camera as its undistorted images have it: a pinhole, cut to the shape that is asked for."""
    size = (config.width_px, config.height_px)
    K = np.array(calibration.getCameraIntrinsics(socket, *size))
    return factory_camera(size, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), "none", ())


def _set_exposure(camera: Any, config: OakConfig) -> None:
    """Fix exposure and gain, where that is asked for."""
    if config.exposure_s is not None:
        iso = 400 if config.gain is None else round(config.gain)
        camera.initialControl.setManualExposure(round(config.exposure_s * 1e6), iso)


def _sockets(calibration: Any, dai: Any, with_depth: bool) -> tuple[Any, ...]:
    """Return the sockets of the cameras of the rig, the first one first."""
    if with_depth:
        return (dai.CameraBoardSocket.CAM_A,)
    return calibration.getStereoLeftCameraId(), calibration.getStereoRightCameraId()


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
        raise HardwareError(f"oak needs depthai ({error}); {install_line('oak')}") from error
    if not hasattr(module.node, "Camera"):
        raise HardwareError(f"oak needs depthai 3, an older one is installed; {install_line('oak')}")
    return module


def _check_shape(sensor: tuple[int, int], size: tuple[int, int]) -> None:
    """Raise DataError for images of another shape than the sensor's: what is cut off then, depthai does not report."""
    if sensor[0] * size[1] != sensor[1] * size[0]:
        raise DataError(
            f"the OAK's calibration is for {sensor[0]}x{sensor[1]}, which is not the shape of {size[0]}x{size[1]}; "
            f"ask for {sensor[0] // 2}x{sensor[1] // 2} (width_px, height_px), or give --calibration.camera FILE"
        )


def _device(dai: Any, config: OakConfig) -> Any:
    return dai.Device(dai.DeviceInfo(config.device)) if config.device else dai.Device()


def _middle_ns(dai: Any, image: Any) -> int:
    return _in_ns(image.getTimestamp(dai.CameraExposureOffset.MIDDLE))
