"""What vislam uses of depthai 3, written after its stubs: a stereo pair whose images can be lost, and a clock."""

import time
from collections import deque
from datetime import timedelta
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

BASELINE_CM = 7.5
CAMERAS = ("CAM_B", "CAM_C")


class World:
    """An OAK-D, and what is wrong with it."""

    def __init__(self) -> None:
        self.unplugged = False
        self.model = "Perspective"
        self.coeffs = [-0.1, 0.05, 0.001, 0.002, -0.02] + [0.0] * 9
        self.epoch_ns = 5_000_000_000  # of depthai's clock, before CLOCK_MONOTONIC's
        self.age_ns = 20_000_000
        self.lost: deque[tuple[str, int]] = deque()  # camera and number of an image that never comes
        self.opened: list[Any] = []
        self.asked: dict[str, Any] = {}
        self.began_ns = time.monotonic_ns()
        self.period_ns = 10_000_000

    def now(self) -> timedelta:
        return timedelta(microseconds=(time.monotonic_ns() - self.epoch_ns) // 1000)

    def module(self) -> ModuleType:
        dai = ModuleType("depthai")
        world = self

        class Device:
            def __init__(self, info: Any = None) -> None:
                if world.unplugged:
                    raise RuntimeError("No available devices")
                self.info, self.closed = info, False
                world.opened.append(self)

            @staticmethod
            def getAllConnectedDevices() -> list[str]:
                return [] if world.unplugged else ["1844301041B0D0A2"]

            def readCalibration(self) -> "Calibration":
                return Calibration(world)

            def close(self) -> None:
                self.closed = True

        facts: dict[str, Any] = {
            "Device": Device,
            "DeviceInfo": lambda name: name,
            "Pipeline": lambda device: Pipeline(world),
            "node": SimpleNamespace(Camera="camera"),
            "ImgFrame": SimpleNamespace(Type=SimpleNamespace(GRAY8="GRAY8")),
            "CameraExposureOffset": SimpleNamespace(START=0, MIDDLE=1, END=2),
            "Clock": SimpleNamespace(now=world.now),
        }
        for name, value in facts.items():
            setattr(dai, name, value)
        return dai


class Calibration:
    def __init__(self, world: World) -> None:
        self.world = world

    def getStereoLeftCameraId(self) -> str:
        return CAMERAS[0]

    def getStereoRightCameraId(self) -> str:
        return CAMERAS[1]

    def getDefaultIntrinsics(self, socket: str) -> tuple[list[list[float]], int, int]:
        return self.getCameraIntrinsics(socket, 1280, 800), 1280, 800

    def getCameraIntrinsics(self, socket: str, width: int, height: int) -> list[list[float]]:
        return [[400.0 + CAMERAS.index(socket), 0.0, width / 2], [0.0, 402.0, height / 2], [0.0, 0.0, 1.0]]

    def getDistortionModel(self, socket: str) -> Any:
        return SimpleNamespace(name=self.world.model)

    def getDistortionCoefficients(self, socket: str) -> list[float]:
        return self.world.coeffs

    def getCameraExtrinsics(self, source: str, to: str) -> list[list[float]]:
        assert (source, to) == CAMERAS
        return [[1.0, 0.0, 0.0, -BASELINE_CM], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


class Pipeline:
    def __init__(self, world: World) -> None:
        self.world = world

    def create(self, kind: str) -> "Camera":
        assert kind == "camera"
        return Camera(self.world)

    def start(self) -> None:
        pass

    def stop(self) -> None:
        if self.world.unplugged:
            raise RuntimeError("Couldn't read data from stream (X_LINK_ERROR)")


class Camera:
    def __init__(self, world: World) -> None:
        self.world = world
        self.initialControl = SimpleNamespace(setManualExposure=self.set_exposure)

    def build(self, socket: str) -> "Camera":
        self.socket = socket
        return self

    def set_exposure(self, time_us: int, iso: int) -> None:
        self.world.asked[self.socket] = (time_us, iso)

    def requestOutput(self, size: tuple[int, int], type: str, fps: float) -> Any:
        assert type == "GRAY8"
        return SimpleNamespace(createOutputQueue=lambda maxSize, blocking: Queue(self.world, self.socket, size))


class Queue:
    def __init__(self, world: World, socket: str, size: tuple[int, int]) -> None:
        self.world, self.socket, self.size = world, socket, size
        self.number = (time.monotonic_ns() - world.began_ns) // world.period_ns + 5

    def get(self, timeout: timedelta) -> "Image | None":
        world = self.world
        if world.unplugged:
            return None
        self.number += 1
        while (self.socket, self.number) in world.lost:
            self.number += 1
        due_ns = world.began_ns + self.number * world.period_ns
        time.sleep(max(due_ns - time.monotonic_ns(), 0) * 1e-9)
        return Image(self, due_ns)


class Image:
    def __init__(self, queue: Queue, due_ns: int) -> None:
        self.queue = queue
        self.taken_ns = due_ns - queue.world.age_ns - queue.world.epoch_ns

    def getTimestamp(self, offset: int) -> timedelta:
        assert offset == 1
        return timedelta(microseconds=self.taken_ns // 1000)

    def getCvFrame(self) -> np.ndarray:
        width, height = self.queue.size
        return np.full((height, width), 10 * (1 + CAMERAS.index(self.queue.socket)), np.uint8)
