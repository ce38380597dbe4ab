"""What vislam uses of pyrealsense2 2.5x, written after its stubs: names, arguments, values and errors are its own.

Its IMU's names, overloads and errors were compared with those of the package 2.59.1. As the library does, a pipeline
that was started with a callback gives images in sets and each motion frame by itself, from a thread per sensor, and
waits for nobody.
"""

import threading
import time
from collections.abc import Callable
from enum import Enum
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

BASELINE_M = 0.05
READOUT_S = 0.02  # from the middle of the exposure to arrival
ANGLE = 0.01  # of the second camera, about its y axis
IMU_ANGLE = 0.02  # of the cameras in the IMU's axes, about z
P_IMU_CAM = (-0.0055, 0.0051, 0.0117)  # of the first camera in the IMU's axes
IMU_LATENCY_S = 0.002
RATES = {"gyro": (200, 400), "accel": (63, 250)}
Motion = Callable[[int], tuple[tuple[float, float, float], tuple[float, float, float]]]


def ramp(t_ns: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Rate and force in axes of the camera, of a time of the host's clock, which both tell on their first axis."""
    t_s = t_ns % 10**12 * 1e-9
    return (t_s, 0.0, 0.0), (t_s, -9.81, 0.0)


def turned(vector: tuple[float, float, float]) -> np.ndarray:
    """From the camera's axes into the IMU's."""
    return R_IMU_CAM @ np.array(vector)


R_IMU_CAM = np.array(
    [[np.cos(IMU_ANGLE), -np.sin(IMU_ANGLE), 0.0], [np.sin(IMU_ANGLE), np.cos(IMU_ANGLE), 0.0], [0.0, 0.0, 1.0]]
)


def members(name: str, *values: str) -> Any:
    """An enum that prints as pybind11's do: `distortion.none`."""
    return Enum(name, dict.fromkeys(values) | {value: i for i, value in enumerate(values)})


class World:
    """A D435-like device, and what is wrong with it."""

    def __init__(self) -> None:
        self.unplugged = False
        self.model, self.coeffs = "brown_conrady", [0.0] * 5
        self.metadata = True
        self.domain = "hardware_clock"
        self.rate = 1.00002  # of the device's clock
        self.serial: str | None = None
        self.options: dict[str, dict[str, float]] = {
            name: {"emitter_enabled": 1.0, "global_time_enabled": 1.0, "enable_auto_exposure": 1.0, "exposure": 8500.0}
            for name in ("depth", "color")
        }
        del self.options["color"]["emitter_enabled"]
        self.options["imu"] = {"enable_motion_correction": 0.0, "global_time_enabled": 1.0}
        self.has_imu = True
        self.imu_domain = "hardware_clock"
        self.motion: Motion = ramp
        self.picture: Callable[[str, int, int], np.ndarray] | None = None  # of stream, index, time of capture
        self.captured_ns: dict[int, int] = {}  # of images, by number
        self.imu_late_us = 0  # by which its IMU's clock is off that of the images
        self.lost: set[int] = set()  # numbers of sets whose second image is lost
        self.running = 0
        self.period_s = 0.005
        self.number = 0

    def module(self) -> ModuleType:
        rs = ModuleType("pyrealsense2")
        facts: dict[str, Any] = {
            "stream": members("stream", "depth", "color", "infrared", "gyro", "accel"),
            "format": members("format", "z16", "y8", "bgr8", "motion_xyz32f"),
            "option": members(
                "option",
                "emitter_enabled",
                "global_time_enabled",
                "enable_auto_exposure",
                "exposure",
                "gain",
                "enable_motion_correction",
            ),
            "distortion": members(
                "distortion", "none", "modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady"
            ),
            "timestamp_domain": members("timestamp_domain", "hardware_clock", "system_time", "global_time"),
            "frame_metadata_value": members("frame_metadata_value", "frame_timestamp", "sensor_timestamp"),
            "pipeline_wrapper": lambda pipeline: pipeline,
        }
        for name, value in facts.items():
            setattr(rs, name, value)
        rs.config = lambda: Config(self, rs)  # type: ignore[attr-defined]
        rs.pipeline = lambda: Pipeline(self, rs)  # type: ignore[attr-defined]
        rs.align = lambda to: SimpleNamespace(process=lambda frames: frames.aligned())  # type: ignore[attr-defined]
        return rs


class Config:
    def __init__(self, world: World, rs: Any) -> None:
        self.world, self.rs, self.streams = world, rs, {}
        self.motion_rates: dict[str, int] = {}

    def enable_device(self, serial: str) -> None:
        self.world.serial = serial

    def enable_stream(self, stream: Any, *rest: Any) -> None:
        """Two of the library's six overloads: of images with index and size, of motion with format and rate."""
        if len(rest) == 2:
            form, rate = rest
            assert form.name == "motion_xyz32f"
            self.motion_rates[stream.name] = rate
            return
        index, width, height, form, rate = rest
        assert isinstance(rate, int)
        self.streams[stream.name, index] = (width, height, form.name)

    def resolve(self, _pipeline: Any) -> "Profile":
        if self.world.unplugged:
            raise RuntimeError("No device connected")
        if any(size[0] > 1280 for size in self.streams.values()):
            raise RuntimeError("Couldn't resolve requests")
        if any(rate not in RATES[name] or not self.world.has_imu for name, rate in self.motion_rates.items()):
            raise RuntimeError("Couldn't resolve requests")
        return Profile(self)


class Profile:
    def __init__(self, config: Config) -> None:
        self.config = config

    def get_stream(self, stream: Any, index: int = -1) -> Any:
        if stream.name in RATES:
            return MotionProfile(self.config.rs, stream.name, self.config.motion_rates[stream.name])
        return VideoProfile(self.config, stream.name, index)

    def get_device(self) -> Any:
        rs, world = self.config.rs, self.config.world
        names = ("depth", "color", "imu") if world.has_imu else ("depth", "color")
        sensors = {name: Sensor(world, name, rs) for name in names}
        return SimpleNamespace(
            first_depth_sensor=lambda: sensors["depth"],
            first_color_sensor=lambda: sensors["color"],
            first_motion_sensor=lambda: sensors["imu"],
            query_sensors=lambda: list(sensors.values()),
        )


class MotionProfile:
    def __init__(self, rs: Any, name: str, rate: int) -> None:
        self.rs, self.name, self.rate = rs, name, rate

    def stream_type(self) -> Any:
        return self.rs.stream[self.name]

    def fps(self) -> int:
        return self.rate


class Sensor:
    def __init__(self, world: World, name: str, rs: Any) -> None:
        self.values, self.name, self.rs = world.options[name], name, rs

    def get_stream_profiles(self) -> list[MotionProfile]:
        if self.name != "imu":
            return [MotionProfile(self.rs, "infrared" if self.name == "depth" else "color", 30)]
        return [MotionProfile(self.rs, name, rate) for name, rates in RATES.items() for rate in rates]

    def supports(self, option: Any) -> bool:
        return option.name in self.values

    def set_option(self, option: Any, value: float) -> None:
        if option.name == "exposure" and value > 165_000:
            raise RuntimeError("out of range value for argument")
        self.values[option.name] = value

    def get_option(self, option: Any) -> float:
        return self.values[option.name]

    def get_depth_scale(self) -> float:
        return 0.001


class VideoProfile:
    def __init__(self, config: Config, stream: str, index: int) -> None:
        self.config, self.stream, self.index = config, stream, index

    def as_video_stream_profile(self) -> "VideoProfile":
        return self

    def get_intrinsics(self) -> Any:
        world = self.config.world
        width, height, _ = self.config.streams[self.stream, self.index]
        model = self.config.rs.distortion[world.model]
        return SimpleNamespace(
            width=width, height=height, fx=380.0, fy=381.0, ppx=319.5, ppy=239.5, model=model, coeffs=world.coeffs
        )

    def get_extrinsics_to(self, to: Any) -> Any:
        if isinstance(to, MotionProfile):  # takes points of the camera into the IMU; the rotation column by column
            return SimpleNamespace(rotation=R_IMU_CAM.T.ravel().tolist(), translation=list(P_IMU_CAM))
        assert (self.index, to.index) == (1, 2)
        c, s = np.cos(ANGLE), np.sin(ANGLE)
        R_to_from = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        return SimpleNamespace(rotation=R_to_from.T.ravel().tolist(), translation=[-BASELINE_M, 0.0, 0.0])


class Pipeline:
    def __init__(self, world: World, rs: Any) -> None:
        self.world, self.rs = world, rs

    def start(self, config: Config, callback: Callable[[Any], None] | None = None) -> Profile:
        profile = config.resolve(self)
        assert callback is not None or not config.motion_rates, "the pipeline's own queue loses samples"
        self.config = config
        self.world.running += 1
        self.callback, self.stopping = callback, threading.Event()
        self.threads = []
        if callback is not None:
            self.threads = [threading.Thread(target=self.give_images, daemon=True)]
            self.threads += [threading.Thread(target=self.give_motion, args=(name,), daemon=True) for name in RATES]
        for thread in self.threads:
            thread.start()
        return profile

    def stop(self) -> None:
        self.world.running -= 1
        self.stopping.set()
        for thread in self.threads:
            thread.join()
        if self.world.unplugged:
            raise RuntimeError("stop() cannot be called before start()")

    def give_images(self) -> None:
        due_ns = time.monotonic_ns()
        while not self.stopping.is_set():
            due_ns += round(self.world.period_s * 1e9)
            time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
            if not self.world.unplugged:
                self.world.number += 1
                self.callback(Frames(self, due_ns - round(READOUT_S * 1e9)))

    def give_motion(self, name: str) -> None:
        period_ns, latency_ns = 10**9 // self.config.motion_rates[name], round(IMU_LATENCY_S * 1e9)
        t_ns = time.monotonic_ns()
        while not self.stopping.is_set():
            t_ns += period_ns
            time.sleep(max(t_ns + latency_ns - time.monotonic_ns(), 0) * 1e-9)
            if not self.world.unplugged:
                self.callback(MotionFrame(self, name, t_ns))

    def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, "Frames"]:
        if self.callback is not None:
            raise RuntimeError("try_wait_for_frames cannot be called if a callback was provided")
        time.sleep(self.world.period_s)
        self.world.number += 1
        return not self.world.unplugged, Frames(self)


class MotionFrame:
    def __init__(self, pipeline: Pipeline, name: str, t_ns: int) -> None:
        self.world, self.rs, self.name, self.t_ns = pipeline.world, pipeline.rs, name, t_ns

    def is_frameset(self) -> bool:
        return False

    def is_motion_frame(self) -> bool:
        return True

    def as_motion_frame(self) -> "MotionFrame":
        return self

    def get_profile(self) -> MotionProfile:
        return MotionProfile(self.rs, self.name, 0)

    def get_motion_data(self) -> Any:
        x, y, z = turned(self.world.motion(self.t_ns)[0 if self.name == "gyro" else 1])
        return SimpleNamespace(x=x, y=y, z=z)

    def get_frame_timestamp_domain(self) -> Any:
        is_global = self.world.options["imu"]["global_time_enabled"] != 0.0
        return self.rs.timestamp_domain["global_time" if is_global else self.world.imu_domain]

    def get_timestamp(self) -> float:
        return (self.t_ns * self.world.rate * 1e-3 + self.world.imu_late_us) * 1e-3


class Frames:
    def __init__(self, pipeline: Pipeline, captured_ns: int | None = None) -> None:
        self.pipeline, self.is_aligned = pipeline, False
        now_ns = time.monotonic_ns() - round(READOUT_S * 1e9)
        self.captured_ns = now_ns if captured_ns is None else captured_ns
        self.number = pipeline.world.number
        pipeline.world.captured_ns[self.number] = self.captured_ns

    def is_frameset(self) -> bool:
        return True

    def as_frameset(self) -> "Frames":
        return self

    def aligned(self) -> "Frames":
        self.is_aligned = True
        return self

    def get_infrared_frame(self, index: int = 0) -> "VideoFrame":
        return VideoFrame(self, ("infrared", index), 10 * index)

    def get_color_frame(self) -> "VideoFrame":
        return VideoFrame(self, ("color", -1), 100)

    def get_depth_frame(self) -> "VideoFrame":
        return VideoFrame(self, ("depth", -1), 1500)


class VideoFrame:
    def __init__(self, frames: Frames, name: tuple[str, int], value: int) -> None:
        self.frames, self.name, self.value = frames, name, value
        self.world, self.rs = frames.pipeline.world, frames.pipeline.rs

    def __bool__(self) -> bool:
        return self.name != ("infrared", 2) or self.frames.number not in self.world.lost

    def get_data(self) -> np.ndarray:
        assert self.name[0] != "depth" or self.frames.is_aligned
        if self.world.picture is not None:
            return self.world.picture(self.name[0], self.name[1], self.frames.captured_ns)
        width, height, form = self.frames.pipeline.config.streams[self.name]
        if form == "bgr8":
            return np.full((height, width, 3), self.value, np.uint8)
        return np.full((height, width), self.value, np.uint16 if form == "z16" else np.uint8)

    def get_frame_number(self) -> int:
        return self.frames.number

    def supports_frame_metadata(self, which: Any) -> bool:
        return self.world.metadata

    def get_frame_metadata(self, which: Any) -> int:
        assert which.name == "sensor_timestamp"
        return round(self.get_timestamp() * 1000.0)

    def get_frame_timestamp_domain(self) -> Any:
        return self.rs.timestamp_domain[self.world.domain]

    def get_timestamp(self) -> float:
        return self.frames.captured_ns * self.world.rate * 1e-6
