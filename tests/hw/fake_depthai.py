"""What vislam uses of depthai 3, written after its stubs: images that can be lost, an IMU, depth, and a clock.

Names of nodes, ports, sensors and calibration were compared with those of the package 3.12.0.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from datetime import timedelta
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

BASELINE_CM = 7.5
CAMERAS = ("CAM_B", "CAM_C")
COLOR = "CAM_A"
# takes points of a camera into the IMU: x of the IMU is down, y left, z ahead, as no camera has it
R_IMU_CAM = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
P_IMU_CAM_CM = (1.0, -2.0, 0.5)


def ramp(t_ns: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Rate and force in axes of the camera, of a time of the host's clock, which both tell on their first axis."""
    t_s = t_ns % 10**12 * 1e-9
    return (t_s, 0.0, 0.0), (t_s, -9.81, 0.0)


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
        self.imu = "BMI270"
        self.motion: Callable[[int], tuple[tuple[float, ...], tuple[float, ...]]] = ramp
        self.knows_imu = True  # most devices have no extrinsics of it
        self.imu_memory_is_empty = False  # as older versions of the package left it
        self.is_calibrated = True  # depthai 3.12 and later
        self.platform = "RVC2"
        self.links: list[tuple[str, str]] = []
        self.queues: dict[str, Queue] = {}  # of the cameras, the newest ones

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

            def getConnectedIMU(self) -> str:
                return world.imu

            def getPlatform(self) -> str:
                return world.platform

            def close(self) -> None:
                self.closed = True

        facts: dict[str, Any] = {
            "Device": Device,
            "DeviceInfo": lambda name: name,
            "Pipeline": lambda device: Pipeline(world),
            "node": SimpleNamespace(Camera=Camera, IMU=Imu, StereoDepth=StereoDepth, Sync=Sync, ImageAlign=ImageAlign),
            "ImgFrame": SimpleNamespace(Type=SimpleNamespace(GRAY8="GRAY8", BGR888i="BGR888i")),
            "CameraBoardSocket": SimpleNamespace(CAM_A=COLOR),
            "Platform": SimpleNamespace(RVC2="RVC2", RVC4="RVC4"),
            "IMUSensor": SimpleNamespace(
                ACCELEROMETER_RAW="accel raw",
                GYROSCOPE_RAW="gyro raw",
                **({"ACCELEROMETER_CALIBRATED": "accel", "GYROSCOPE_CALIBRATED": "gyro"} if self.is_calibrated else {}),
            ),
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
        return [
            [400.0 + (CAMERAS.index(socket) if socket in CAMERAS else 50.0), 0.0, width / 2],
            [0.0, 402.0, height / 2],
            [0.0, 0.0, 1.0],
        ]

    def getDistortionModel(self, socket: str) -> Any:
        return SimpleNamespace(name=self.world.model)

    def getDistortionCoefficients(self, socket: str) -> list[float]:
        return self.world.coeffs

    def getCameraToImuExtrinsics(self, socket: str) -> list[list[float]]:
        if not self.world.knows_imu:
            raise RuntimeError("IMU calibration data is not available on device yet.")
        if self.world.imu_memory_is_empty:
            return [[0.0] * 4, [0.0] * 4, [0.0] * 4, [0.0, 0.0, 0.0, 1.0]]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R_IMU_CAM, P_IMU_CAM_CM
        return T.tolist()

    def getCameraExtrinsics(self, source: str, to: str) -> list[list[float]]:
        assert (source, to) == CAMERAS
        return [[1.0, 0.0, 0.0, -BASELINE_CM], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


class Pipeline:
    def __init__(self, world: World) -> None:
        self.world = world

    def create(self, kind: Any) -> Any:
        return kind(self.world)

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

    def requestOutput(
        self, size: tuple[int, int], type: str | None = None, fps: float | None = None,
        enableUndistortion: bool | None = None,
    ) -> "Output":  # fmt: skip
        assert (type == "BGR888i") == bool(enableUndistortion)
        return Output(self.world, self.socket, lambda: Queue(self.world, self.socket, size))


class Output:
    def __init__(self, world: World, name: str, make: Callable[[], Any] | None = None) -> None:
        self.world, self.name, self.make = world, name, make

    def link(self, to: str) -> None:
        self.world.links.append((self.name, to))

    def createOutputQueue(self, maxSize: int, blocking: bool) -> Any:
        assert self.make is not None
        return self.make()


class StereoDepth:
    left, right, inputAlignTo = "stereo left", "stereo right", "stereo align"

    def __init__(self, world: World) -> None:
        self.depth = Output(world, "depth")


class ImageAlign:
    input, inputAlignTo = "align in", "align to"

    def __init__(self, world: World) -> None:
        self.outputAligned = Output(world, "aligned")


class Names:
    """An `InputMap`: an input is made when it is asked for."""

    def __getitem__(self, name: str) -> str:
        return f"sync {name}"


class Sync:
    """Gives groups of an image and a depth image of 640x400."""

    inputs = Names()

    def __init__(self, world: World) -> None:
        def groups() -> Any:
            color = Queue(world, COLOR, (640, 400))

            def get(timeout: timedelta) -> dict[str, Image] | None:
                image = color.get(timeout)
                return None if image is None else {"color": image, "depth": image}

            return SimpleNamespace(get=get)

        self.out = Output(world, "sync", groups)

    def setSyncThreshold(self, threshold: timedelta) -> None:
        assert threshold > timedelta(0)


class Imu:
    """The IMU node: reports of both sensors in one packet, at a rate, as the firmware sends them."""

    def __init__(self, world: World) -> None:
        self.world, self.rate = world, 0
        self.out = Output(world, "imu", lambda: self)
        self.closed = threading.Event()

    def enableIMUSensor(self, sensors: list[str], reportRate: int) -> None:
        assert isinstance(reportRate, int)
        self.world.asked["imu"], self.rate = sensors, reportRate
        self.next_ns = time.monotonic_ns()

    def setBatchReportThreshold(self, count: int) -> None:
        assert count >= 1

    def setMaxBatchReports(self, count: int) -> None:
        assert count >= 1

    def get(self, timeout: timedelta) -> Any:
        if self.world.unplugged:
            time.sleep(0.01)
            return None
        self.next_ns += 10**9 // self.rate
        time.sleep(max(self.next_ns + 2_000_000 - time.monotonic_ns(), 0) * 1e-9)
        rate, force = self.world.motion(self.next_ns)
        packet = SimpleNamespace(
            gyroscope=Report(self.world, self.next_ns, rate), acceleroMeter=Report(self.world, self.next_ns, force)
        )
        return SimpleNamespace(packets=[packet])


class Report:
    def __init__(self, world: World, t_ns: int, vector: tuple[float, ...]) -> None:
        self.t_ns = t_ns - world.epoch_ns
        self.x, self.y, self.z = R_IMU_CAM @ np.array(vector)

    def getTimestamp(self) -> timedelta:
        return timedelta(microseconds=self.t_ns // 1000)


class Queue:
    def __init__(self, world: World, socket: str, size: tuple[int, int]) -> None:
        self.world, self.socket, self.size = world, socket, size
        self.number = (time.monotonic_ns() - world.began_ns) // world.period_ns + 5
        world.queues[socket] = self

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

    def getFrame(self) -> np.ndarray:
        width, height = self.queue.size
        return np.full((height, width), 1500, np.uint16)

    def getCvFrame(self) -> np.ndarray:
        width, height = self.queue.size
        if self.queue.socket == COLOR:
            return np.full((height, width, 3), 90, np.uint8)
        return np.full((height, width), 10 * (1 + CAMERAS.index(self.queue.socket)), np.uint8)
