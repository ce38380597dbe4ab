"""RealSense through pyrealsense2: the infrared stereo pair, or colour with aligned depth, on the device's own clock."""

import threading
import time
from bisect import bisect_left
from collections import deque
from contextlib import suppress
from queue import Empty, Full, Queue
from typing import Any

import numpy as np

from vislam.config import BridgeClockConfig, RealsenseConfig
from vislam.core.camera import Rig
from vislam.core.errors import HardwareError, install_line
from vislam.core.messages import Array, Frame
from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.cameras.factory import factory_camera, grey, looking_ahead, mounted, mounted_on_imu, rigid
from vislam.hw.cameras.library_camera import Setting, named
from vislam.hw.health import Health
from vislam.hw.own_imu import OwnImu

_NEXT_MS = 1000  # without frames for this long, the device is opened again
_WRAP_US = 2**32
_SETTLE_NS = 3_000_000_000  # in which an IMU that is there has laid the line of the clock
_WAITING = 2  # sets of images; the library has 16 to fill
_MODELS = {"none": "none", "brown_conrady": "radtan", "kannala_brandt4": "equidistant"}
_OWN_CLOCK = "the device's clock, on a line under the arrivals of the gyro"
_KEPT = 512  # ticks: more than a second of a gyro
_BEYOND_US = 500_000  # after the newest tick or before the oldest, that is still of this clock


class SharedClock:
    """Places what a device stamps [us, 32 bits] on CLOCK_MONOTONIC.

    The gyro, which comes most often and soonest, lays the line under its arrivals. Whatever else the device stamps is
    placed between the gyro's samples around it, so that nothing the line does can part images from inertial samples.
    For any thread.
    """

    def __init__(self, config: BridgeClockConfig, delay_s: float) -> None:
        """Take the settings of the line, and how late the gyro's samples arrive at the fastest."""
        self._line = DeviceClock(config)
        self._delay_ns = round(delay_s * 1e9)
        self._lock = threading.Lock()
        self._device_us: deque[int] = deque(maxlen=_KEPT)  # unwrapped
        self._host_ns: deque[int] = deque(maxlen=_KEPT)
        self._steps = 0

    @property
    def steps(self) -> int:
        """How often a new line was begun."""
        return self._steps

    @property
    def is_settled(self) -> bool:
        """Whether the line is trusted: `at` then knows all that this clock stamped lately."""
        return len(self._device_us) >= 2

    def tick(self, device_us: int, arrival_ns: int) -> int | None:
        """Return the host's time of a sample of the gyro that has just arrived; None while the line is not trusted."""
        with self._lock:
            stamp_ns = self._line.stamp(device_us % _WRAP_US, arrival_ns)
            if self._line.steps != self._steps:
                self._steps = self._line.steps
                self._device_us.clear()
                self._host_ns.clear()
            if stamp_ns is None:
                return None
            known = self._device_us[-1] if self._device_us else 0
            self._device_us.append(known + (device_us - known) % _WRAP_US)
            self._host_ns.append(stamp_ns - self._delay_ns)
            return self._host_ns[-1]

    def at(self, device_us: int) -> int | None:
        """Return the host's time of another stamp; None where no tick is near: too early, or by another clock."""
        with self._lock:
            ticks = self._device_us
            if len(ticks) < 2:
                return None
            since_us = (device_us - ticks[-1] + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2
            t_us = ticks[-1] + since_us
            if since_us > _BEYOND_US or t_us < ticks[0] - _BEYOND_US:
                return None
            after = min(max(bisect_left(ticks, t_us), 1), len(ticks) - 1)
            u0, u1, h0, h1 = ticks[after - 1], ticks[after], self._host_ns[after - 1], self._host_ns[after]
            return h0 + round((t_us - u0) * (h1 - h0) / (u1 - u0))


class RealsenseMotion:
    """Turns motion frames into samples of an `OwnImu`. Its methods may be called by several threads of the library."""

    def __init__(self, rs: Any, config: RealsenseConfig, imu: OwnImu) -> None:
        """Begin a clock; the device is started by who owns the pipeline."""
        self._rs, self._config, self._imu = rs, config, imu
        self.clock = SharedClock(BridgeClockConfig(), config.imu_delay_s)
        self._delay_ns = round(config.imu_delay_s * 1e9)
        self._steps, self._is_begun = 0, False

    def begin(self, profile: Any, first: Any) -> None:
        """Take the extrinsics and the rate of a profile that runs; `first` is the stream of the first camera."""
        R_cam_imu = imu_pose(self._rs, profile, first)[:3, :3]
        gyro = profile.get_stream(self._rs.stream.gyro)
        self._is_begun = True
        self._imu.begin(looking_ahead(self._config) @ R_cam_imu, float(gyro.fps()))

    def take(self, frame: Any, arrival_ns: int) -> None:
        """Take a motion frame that has just arrived."""
        if not self._is_begun:
            return  # the library's settings are not made yet
        kind = frame.get_profile().stream_type()
        data = frame.as_motion_frame().get_motion_data()
        value = np.array([data.x, data.y, data.z], dtype=np.float64)
        is_gyro = kind == self._rs.stream.gyro
        domain, domains = frame.get_frame_timestamp_domain(), self._rs.timestamp_domain
        t_ns: int | None = None
        if domain == domains.system_time:
            self._imu.stamped_by = "arrival"
            self._imu.count("bad_stamps")
            t_ns = arrival_ns - self._delay_ns
        elif domain == domains.hardware_clock:  # global time, for a moment after it was switched off, is neither
            device_us = round(frame.get_timestamp() * 1000.0)
            t_ns = self.clock.tick(device_us, arrival_ns) if is_gyro else self.clock.at(device_us)
            self._imu.stamped_by = _OWN_CLOCK
        if self.clock.steps != self._steps:
            self._steps = self.clock.steps
            self._imu.count("clock_steps", Health.CLOCK_STEP)
        if t_ns is None:
            self._imu.count("unstamped")
        elif is_gyro:
            self._imu.add_gyro(t_ns, value)
        else:
            self._imu.add_accel(t_ns, value)


def ask_motion(rs: Any, asked: Any, device: Any, rate_hz: float) -> None:
    """Add gyro and accelerometer to what is asked: the nearest rate of the gyro, the accelerometer's highest.

    Raises HardwareError where the device has no IMU.
    """
    rates: dict[str, list[int]] = {"gyro": [], "accel": []}
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            name = profile.stream_type().name
            if name in rates:
                rates[name].append(int(profile.fps()))
    if not rates["gyro"] or not rates["accel"]:
        raise HardwareError(
            "this RealSense has no IMU, as the models without an i in their name, or its driver does not show it; "
            "take another IMU (--imu), or the one of a D435i, D455 or D457"
        )
    nearest = min(rates["gyro"], key=lambda rate: abs(rate - rate_hz))
    asked.enable_stream(rs.stream.gyro, rs.format.motion_xyz32f, nearest)
    asked.enable_stream(rs.stream.accel, rs.format.motion_xyz32f, max(rates["accel"]))


def imu_pose(rs: Any, profile: Any, first: Any) -> Array:
    """Return the pose [4, 4] of the IMU in a camera (`first`, a stream's profile) by the factory's extrinsics.

    Raises HardwareError where they are no rigid transform.
    """
    e = first.get_extrinsics_to(profile.get_stream(rs.stream.gyro))  # takes points of the camera into the IMU
    return rigid(np.reshape(e.rotation, (3, 3)).T, np.array(e.translation))


class RealsenseStream:
    """Satisfies `Stream`: a pipeline that runs, and with it the device's IMU where that is asked for."""

    def __init__(self, config: RealsenseConfig, with_depth: bool, imu: OwnImu | None = None) -> None:
        """Start the pipeline; without a device the library raises RuntimeError.

        What the device's IMU measures goes to `imu`. Raises HardwareError where it has none.
        """
        self._rs = pyrealsense2()
        self._config, self._with_depth = config, with_depth
        self.stamped_by, self.bad_stamps = "not known yet", 0
        self._align = self._rs.align(self._rs.stream.color) if with_depth else None
        self._clock = DeviceClock(BridgeClockConfig())
        self._delay_ns = round(config.delay_s * 1e9)
        self._number, self._began_ns = -1, time.monotonic_ns()
        self._motion = None if imu is None else RealsenseMotion(self._rs, config, imu)
        self._framesets: Queue[tuple[Any, int]] = Queue(_WAITING)
        self._failure: Exception | None = None  # of a callback
        asked = _asked(self._rs, config, with_depth, with_imu=imu is not None)
        self._pipeline = self._rs.pipeline()
        profile = self._pipeline.start(asked) if imu is None else self._pipeline.start(asked, self._called)
        try:
            self._m_per_unit = profile.get_device().first_depth_sensor().get_depth_scale()
            self.settings = self._set(profile.get_device())
            if self._motion is not None:
                self._motion.begin(profile, profile.get_stream(*_first(self._rs, with_depth)))
        except BaseException:
            self.close()
            raise

    def next(self) -> Frame | None:
        """Return the next frame; None while its stamp is not to be trusted. Raises HardwareError after a second."""
        frames, arrival_ns = self._next_frameset()
        if self._motion is not None and not self._is_whole(frames):
            return None  # one of the pair was lost
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

    def _next_frameset(self) -> tuple[Any, int]:
        """Return images and when they arrived. Raises HardwareError after a second without any."""
        if self._motion is None:
            has_come, frames = self._pipeline.try_wait_for_frames(_NEXT_MS)
            if has_come:
                return frames, time.monotonic_ns()
        else:
            with suppress(Empty):
                return self._framesets.get(timeout=_NEXT_MS * 1e-3)
            if self._failure is not None:
                raise self._failure
        raise HardwareError("the RealSense stopped giving images; replug it, into a USB 3 port")

    def _called(self, frame: Any) -> None:
        """Take what a thread of the library brings: images in sets, each sample of the IMU by itself.

        The pipeline's own queue keeps the newest sample of each set of images only; by callback none is lost.
        """
        arrival_ns = time.monotonic_ns()
        try:
            if not frame.is_frameset():
                if self._motion is not None and frame.is_motion_frame():
                    self._motion.take(frame, arrival_ns)
                return
            if self._framesets.full():
                with suppress(Empty):
                    self._framesets.get_nowait()  # the newest is wanted
            with suppress(Full):
                self._framesets.put_nowait((frame.as_frameset(), arrival_ns))
        except Exception as error:  # a callback that raises would end the process
            self._failure = error

    def _is_whole(self, frames: Any) -> bool:
        """Return whether a set has all images that were asked for."""
        if self._with_depth:
            return bool(frames.get_color_frame()) and bool(frames.get_depth_frame())
        return all(bool(frames.get_infrared_frame(k)) for k in (1, 2))

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
        if self._motion is not None and (t_ns := self._motion.clock.at(device_us)) is not None:
            self.stamped_by += ", on one line with its IMU's"
            return t_ns
        is_waiting = self._motion is not None and arrival_ns - self._began_ns < _SETTLE_NS
        if self._motion is not None and not is_waiting:
            self.bad_stamps += 1  # its IMU is silent, or counts by another clock: a line of its own
        stamp_ns = self._clock.stamp(device_us % _WRAP_US, arrival_ns)
        return None if stamp_ns is None or is_waiting else stamp_ns - self._delay_ns

    def _set(self, device: Any) -> tuple[Setting, ...]:
        """Fix what the device would change by itself; return all as read back."""
        option, config = self._rs.option, self._config
        sensors = {"depth": device.first_depth_sensor()}
        if self._with_depth:
            sensors["color"] = device.first_color_sensor()
        wanted = [("depth", "emitter_enabled", float(self._with_depth))]  # its dots move along with a stereo pair
        if self._motion is not None:
            sensors["imu"] = device.first_motion_sensor()
            wanted.append(("imu", "enable_motion_correction", 1.0))  # by the calibration in the device
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


def realsense_rig(config: RealsenseConfig, with_depth: bool, with_imu: bool = False) -> Rig:
    """Return the rig by the calibration in the device; nothing streams.

    Mounted as the settings say, or with its own IMU as that lies beside its cameras.

    Raises:
        HardwareError: pyrealsense2 or the device is missing, or it has not these streams.
        DataError: its calibration cannot be used.
    """
    rs = pyrealsense2()
    try:
        profile = _asked(rs, config, with_depth, with_imu).resolve(rs.pipeline_wrapper(rs.pipeline()))
    except RuntimeError as error:
        raise HardwareError(
            f"no RealSense{named(config)} gives {config.width_px}x{config.height_px} at {config.rate_hz:g} Hz "
            f"({error}); plug it into a USB 3 port, or ask for another size or rate"
        ) from error
    names = (_first(rs, with_depth),) if with_depth else (_first(rs, with_depth), (rs.stream.infrared, 2))
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
    if with_imu:
        return mounted_on_imu(cameras, poses, with_depth, config, imu_pose(rs, profile, streams[0]))
    return mounted(cameras, poses, with_depth, config)


def pyrealsense2() -> Any:
    """Return pyrealsense2; raises HardwareError without it."""
    try:
        import pyrealsense2 as module
    except (ImportError, OSError) as error:
        raise HardwareError(f"realsense needs pyrealsense2 ({error}); {install_line('realsense')}") from error
    return module


def _first(rs: Any, with_depth: bool) -> tuple[Any, int]:
    """Return type and index of the stream of the first camera."""
    return (rs.stream.color, -1) if with_depth else (rs.stream.infrared, 1)


def _asked(rs: Any, config: RealsenseConfig, with_depth: bool, with_imu: bool = False) -> Any:
    """Return the library's request for the streams.

    With an IMU the device is looked at; RuntimeError where there is none, HardwareError where it has no IMU.
    """
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
    if with_imu:
        device = asked.resolve(rs.pipeline_wrapper(rs.pipeline())).get_device()
        ask_motion(rs, asked, device, config.imu_rate_hz)
    return asked
