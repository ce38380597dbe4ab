"""What vislam uses of picamera2 0.3, written after its source: a camera at 100 Hz with faults set from the test."""

import threading
import time
from types import ModuleType
from typing import Any

import numpy as np


class World:
    """What is plugged in, and what the sensor says of its images."""

    def __init__(self) -> None:
        self.models = ["imx708"]
        self.unplugged = False
        self.late = 0  # images that do not come in time
        self.age_ns = 20_000_000
        self.offset_ns = 0  # of the sensor's clock from CLOCK_MONOTONIC
        self.metadata: dict[str, Any] = {"ExposureTime": 10_000}
        self.has_autofocus = True
        self.largest = (4608, 2592)
        self.opened: list[Any] = []
        self.unreleased = 0

    def module(self) -> ModuleType:
        world = self

        class Picamera2(FakeCamera):
            def __init__(self, camera_num: int = 0) -> None:
                super().__init__(world, camera_num)

            @staticmethod
            def global_camera_info() -> list[dict[str, Any]]:
                return [{"Model": name, "Num": i, "Id": name} for i, name in enumerate(world.models)]

        module = ModuleType("picamera2")
        module.Picamera2 = Picamera2  # type: ignore[attr-defined]
        return module


class FakeCamera:
    def __init__(self, world: World, number: int) -> None:
        if world.unplugged or number >= len(world.models):
            raise RuntimeError("Camera(s) not found (Do not forget to disable legacy camera with raspi-config).")
        self.world, self.number = world, number
        self.started = self.closed = self.flushed = False
        world.opened.append(self)

    @property
    def camera_controls(self) -> dict[str, tuple[Any, Any, Any]]:
        names = ["FrameDurationLimits", "AeEnable", "ExposureTime", "AnalogueGain"]
        return dict.fromkeys(names + ["AfMode", "LensPosition"] * self.world.has_autofocus, (0, 1, 0))

    def create_video_configuration(
        self, main: dict[str, Any], buffer_count: int, controls: dict[str, Any], queue: bool
    ) -> dict[str, Any]:
        unknown = set(controls) - set(self.camera_controls)
        assert not unknown, f"picamera2 refuses {unknown}"
        return {"main": main, "buffer_count": buffer_count, "controls": controls, "queue": queue}

    def configure(self, config: dict[str, Any]) -> None:
        self.config = config
        width, height = config["main"]["size"]
        self.config["main"]["size"] = min(width, self.world.largest[0]), min(height, self.world.largest[1])

    def camera_configuration(self) -> dict[str, Any]:
        return self.config

    def start(self) -> None:
        self.started = True

    def stop(self) -> None:
        self.started = False

    def close(self) -> None:
        self.closed = True

    def cancel_all_and_flush(self) -> None:
        self.flushed = True

    def capture_request(self, wait: bool) -> "Job":
        assert not wait
        return Job(self)


class Job:
    def __init__(self, camera: FakeCamera) -> None:
        self.camera = camera

    def get_result(self, timeout: float) -> "Request":
        if self.camera.world.unplugged or self.camera.world.late > 0:
            self.camera.world.late -= 1
            threading.Event().wait(0.02)  # in place of the whole timeout
            raise TimeoutError
        time.sleep(0.01)
        self.camera.world.unreleased += 1
        return Request(self.camera)


class Request:
    def __init__(self, camera: FakeCamera) -> None:
        self.camera = camera
        world = camera.world
        stamp_ns = time.monotonic_ns() - world.age_ns + world.offset_ns
        self.metadata = {"SensorTimestamp": stamp_ns, **world.metadata}

    def make_array(self, name: str) -> np.ndarray:
        width, height = self.camera.config[name]["size"]
        image = np.zeros((height, width, 3), np.uint8)
        image[..., 0] = 200  # blue comes first
        return image

    def get_metadata(self) -> dict[str, Any]:
        return self.metadata

    def release(self) -> None:
        self.camera.world.unreleased -= 1
