"""What vislam uses of pyrealsense2 2.5x, written after its stubs: names, arguments, values and errors are its own."""

import time
from enum import Enum
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

BASELINE_M = 0.05
READOUT_S = 0.02  # from the middle of the exposure to arrival
ANGLE = 0.01  # of the second camera, about its y axis


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
        self.running = 0
        self.period_s = 0.005
        self.number = 0

    def module(self) -> ModuleType:
        rs = ModuleType("pyrealsense2")
        facts: dict[str, Any] = {
            "stream": members("stream", "depth", "color", "infrared"),
            "format": members("format", "z16", "y8", "bgr8"),
            "option": members(
                "option", "emitter_enabled", "global_time_enabled", "enable_auto_exposure", "exposure", "gain"
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

    def enable_device(self, serial: str) -> None:
        self.world.serial = serial

    def enable_stream(self, stream: Any, index: int, width: int, height: int, form: Any, rate: int) -> None:
        assert isinstance(rate, int)
        self.streams[stream.name, index] = (width, height, form.name)

    def resolve(self, _pipeline: Any) -> "Profile":
        if self.world.unplugged:
            raise RuntimeError("No device connected")
        if any(size[0] > 1280 for size in self.streams.values()):
            raise RuntimeError("Couldn't resolve requests")
        return Profile(self)


class Profile:
    def __init__(self, config: Config) -> None:
        self.config = config

    def get_stream(self, stream: Any, index: int = -1) -> "VideoProfile":
        return VideoProfile(self.config, stream.name, index)

    def get_device(self) -> Any:
        sensors = {name: Sensor(self.config.world, name) for name in ("depth", "color")}
        return SimpleNamespace(first_depth_sensor=lambda: sensors["depth"], first_color_sensor=lambda: sensors["color"])


class Sensor:
    def __init__(self, world: World, name: str) -> None:
        self.values = world.options[name]

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

    def get_extrinsics_to(self, to: "VideoProfile") -> Any:
        assert (self.index, to.index) == (1, 2)
        c, s = np.cos(ANGLE), np.sin(ANGLE)
        R_to_from = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        return SimpleNamespace(rotation=R_to_from.T.ravel().tolist(), translation=[-BASELINE_M, 0.0, 0.0])


class Pipeline:
    def __init__(self, world: World, rs: Any) -> None:
        self.world, self.rs = world, rs

    def start(self, config: Config) -> Profile:
        profile = config.resolve(self)
        self.config = config
        self.world.running += 1
        return profile

    def stop(self) -> None:
        self.world.running -= 1
        if self.world.unplugged:
            raise RuntimeError("stop() cannot be called before start()")

    def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, "Frames"]:
        time.sleep(self.world.period_s)
        self.world.number += 1
        return not self.world.unplugged, Frames(self)


class Frames:
    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline, self.is_aligned = pipeline, False
        self.captured_ns = time.monotonic_ns() - round(READOUT_S * 1e9)
        self.number = pipeline.world.number

    def aligned(self) -> "Frames":
        self.is_aligned = True
        return self

    def get_infrared_frame(self, index: int = 0) -> "VideoFrame":
        return VideoFrame(self, ("infrared", index), 10 * index)

    def get_color_frame(self) -> "VideoFrame":
        return VideoFrame(self, ("color", -1), 100)

    def get_depth_frame(self) -> "VideoFrame":
        assert self.is_aligned
        return VideoFrame(self, ("depth", -1), 1500)


class VideoFrame:
    def __init__(self, frames: Frames, name: tuple[str, int], value: int) -> None:
        self.frames, self.name, self.value = frames, name, value
        self.world, self.rs = frames.pipeline.world, frames.pipeline.rs

    def get_data(self) -> np.ndarray:
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
