"""Bags written by `rosbags` for tests, of any storage, from values or from the folders of other formats."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from worlds.mini_recording import BEGIN_NS, FRAME_NS, picture

TF = "tf2_msgs/msg/TFMessage"
K = np.array([[50.0, 0.0, 31.5], [0.0, 51.0, 23.5], [0.0, 0.0, 1.0]])
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
KINDS = ("bag", "bag-bz2", "bag-lz4", "mcap", "mcap-zstd", "mcap-message", "db3", "db3-message")


@dataclass
class Message:
    """One message to be written."""

    t_ns: int
    topic: str
    value: Any
    type: str = field(init=False)

    def __post_init__(self) -> None:
        self.type = self.value.__msgtype__


class Types:
    """Makes messages of ROS 1 or 2."""

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = ROS1 if ros1 else ROS2

    def make(self, type_: str, /, **values: Any) -> Any:
        return self.store.types[type_](**values)

    def header(self, t_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        first = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", **first, stamp=stamp, frame_id=frame)

    def vector(self, values: Iterable[float]) -> Any:
        x, y, z = map(float, values)
        return self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def point(self, values: Iterable[float]) -> Any:
        x, y, z = map(float, values)
        return self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def quaternion(self, xyzw: Iterable[float] = (0, 0, 0, 1)) -> Any:
        x, y, z, w = map(float, xyzw)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def imu(self, t_ns: int, values: Iterable[float], frame: str = "imu") -> Any:
        six = list(values)
        covariances = {
            f"{what}_covariance": np.zeros(9) for what in ("orientation", "angular_velocity", "linear_acceleration")
        }
        return self.make(
            "sensor_msgs/msg/Imu", header=self.header(t_ns, frame), orientation=self.quaternion(),
            angular_velocity=self.vector(six[:3]), linear_acceleration=self.vector(six[3:]), **covariances,
        )  # fmt: skip

    def field(self, t_ns: int, tesla: Iterable[float], frame: str = "imu") -> Any:
        return self.make(
            "sensor_msgs/msg/MagneticField", header=self.header(t_ns, frame), magnetic_field=self.vector(tesla),
            magnetic_field_covariance=np.zeros(9),
        )  # fmt: skip

    def image(
        self, t_ns: int, pixels: np.ndarray, encoding: str, frame: str = "cam0", pad: int = 0, big: bool = False
    ) -> Any:
        height, width = pixels.shape[:2]
        rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(height, -1).view(np.uint8)
        rows = np.hstack([rows, np.full((height, pad), 77, np.uint8)])
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(t_ns, frame), height=height, width=width, encoding=encoding,
            is_bigendian=int(big), step=rows.shape[1], data=np.ascontiguousarray(rows).ravel(),
        )  # fmt: skip

    def compressed(self, t_ns: int, data: bytes, format_: str, frame: str = "cam0") -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(t_ns, frame), format=format_,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def info(
        self, t_ns: int, size: tuple[int, int], K: np.ndarray, model: str, d: Iterable[float], frame: str = "cam0",
        R: np.ndarray | None = None, P: np.ndarray | None = None,
    ) -> Any:  # fmt: skip
        values = {
            "d": np.array(list(d), dtype=np.float64), "k": np.asarray(K, dtype=np.float64).ravel(),
            "r": (np.eye(3) if R is None else R).ravel(),
            "p": (np.column_stack([K, np.zeros(3)]) if P is None else P).ravel(),
        }  # fmt: skip
        if self.ros1:
            values = {name.upper(): value for name, value in values.items()}
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(t_ns, frame), height=size[1], width=size[0],
            distortion_model=model, **values, binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    def pose(self, position: Iterable[float], xyzw: Iterable[float] = (0, 0, 0, 1)) -> Any:
        return self.make("geometry_msgs/msg/Pose", position=self.point(position), orientation=self.quaternion(xyzw))

    def pose_stamped(self, t_ns: int, position: Iterable[float], xyzw: Iterable[float] = (0, 0, 0, 1)) -> Any:
        header = self.header(t_ns, "world")
        return self.make("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose(position, xyzw))

    def transforms(self, t_ns: int, edges: Iterable[tuple[str, str, np.ndarray]]) -> Any:
        """Of parent, child and T_parent_child [4, 4]."""
        out = []
        for parent, child, T in edges:
            transform = self.make(
                "geometry_msgs/msg/Transform",
                translation=self.vector(T[:3, 3]),
                rotation=self.quaternion(quaternion_xyzw(T[:3, :3])),
            )
            header = self.header(t_ns, parent)
            out.append(
                self.make(
                    "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
                )
            )
        return self.make(TF, transforms=out)


def quaternion_xyzw(R: np.ndarray) -> np.ndarray:
    """By eigenvectors, to the last bits; shares nothing with the package."""
    K = np.array([
        [R[0, 0] - R[1, 1] - R[2, 2], 0, 0, 0],
        [R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], 0, 0],
        [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1], 0],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
    ])  # fmt: skip
    _, vectors = np.linalg.eigh(K / 3.0)
    return vectors[:, -1] * np.sign(vectors[3, -1] or 1.0)


def types_of(kind: str) -> Types:
    return Types(ros1=kind.startswith("bag"))


def images_of(types: Types, images: Iterable[np.ndarray] | int = 3, **more: Any) -> list[Message]:
    """One camera alone, calibrated by K for the size of its first image: pictures, or these images."""
    images = [picture(i) for i in range(images)] if isinstance(images, int) else list(images)
    size = images[0].shape[1::-1]
    out = [Message(BEGIN_NS, "/cam0/camera_info", types.info(BEGIN_NS, size, K, "plumb_bob", [0.0] * 5))]
    for i, image in enumerate(images):
        t_ns = BEGIN_NS + i * FRAME_NS
        out.append(Message(t_ns, "/cam0/image_raw", types.image(t_ns, image, "mono8", **more)))
    return out


def write_bag(folder: Path, kind: str, messages: Iterable[Message], name: str = "drive") -> Path:
    """Write messages in their order and return the bag's path."""
    base, _, packing = kind.partition("-")
    store = types_of(kind).store
    connections: dict[str, Any] = {}
    if base == "bag":
        path = folder / f"{name}.bag"
        writer: Any = Writer1(path)
        if packing:
            writer.set_compression(Writer1.CompressionFormat[packing.upper()])
        serialize = store.serialize_ros1
    else:
        path = folder / name
        writer = Writer2(
            path, version=9, storage_plugin=StoragePlugin.MCAP if base == "mcap" else StoragePlugin.SQLITE3
        )
        if packing == "zstd":
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        elif packing:
            writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
        serialize = store.serialize_cdr
    with writer:
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(message.topic, message.type, typestore=store)
            writer.write(connections[message.topic], message.t_ns, serialize(message.value, message.type))
    return path


def sensor(path: Path) -> SimpleNamespace:
    """What an ASL sensor file says."""
    data = yaml.safe_load(path.read_text())
    T = np.array(data["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
    return SimpleNamespace(T=T, **{key: value for key, value in data.items() if key != "T_BS"})


def rows_of(path: Path) -> list[list[str]]:
    return [line.split(",") for line in path.read_text().splitlines() if line and not line.startswith("#")]


def from_asl(mav0: Path, types: Types, frames: int | None = None) -> Iterator[Message]:
    """The messages of an ASL folder in time order: calibrations and places first, images as mono8, mono16 or bgr8."""
    cameras = sorted(folder.name for folder in mav0.glob("cam?"))
    images = [(int(t), name, mav0 / name / "data" / file.strip()) for name in cameras
              for t, file in rows_of(mav0 / name / "data.csv")[:frames]]  # fmt: skip
    last_ns = max(t for t, _, _ in images)
    first_ns = min(t for t, _, _ in images)
    edges = []
    for name in cameras:
        told = sensor(mav0 / name / "sensor.yaml")
        fx, fy, cx, cy = told.intrinsics
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        d = [*told.distortion_coefficients, 0.0]
        yield Message(first_ns, f"/{name}/camera_info", types.info(first_ns, told.resolution, K, "plumb_bob", d, name))
        edges.append(("imu", name, told.T))
    yield Message(first_ns, "/tf_static", types.transforms(first_ns, edges))
    values: list[tuple[int, int, Any]] = [(t, 1, (name, path)) for t, name, path in images]
    values += [(int(row[0]), 0, [float(x) for x in row[1:7]]) for row in rows_of(mav0 / "imu0" / "data.csv")
               if frames is None or int(row[0]) <= last_ns + 50_000_000]  # fmt: skip
    for t_ns, is_image, value in sorted(values, key=lambda row: row[:2]):
        if is_image:
            name, path = value
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            encoding = f"mono{8 * pixels.itemsize}" if pixels.ndim == 2 else "bgr8"
            yield Message(t_ns, f"/{name}/image_raw", types.image(t_ns, pixels, encoding, name))
        else:
            yield Message(t_ns, "/imu0", types.imu(t_ns, value))


def from_tum(folder: Path, types: Types, camera: Any, frames: int | None = None) -> Iterator[Message]:
    """The messages of a TUM folder: colour as rgb8, depth as 32FC1 in metres, both in the colour camera's frame."""
    from decimal import Decimal

    def listed(name: str) -> list[tuple[int, Path]]:
        lines = [line.split() for line in (folder / name).read_text().splitlines() if line and line[0] != "#"]
        return [(int(Decimal(t) * 10**9), folder / file) for t, file in lines]

    colors = listed("rgb.txt")[:frames]
    depths = [row for row in listed("depth.txt") if row[0] <= colors[-1][0] + 20_000_000]
    t_ns = colors[0][0]
    size = (camera.width, camera.height)
    info = types.info(t_ns, size, camera.K, "plumb_bob", camera.coefficients, "rgb_optical")
    yield Message(t_ns, "/camera/rgb/camera_info", info)
    every = sorted([(t, 0, path) for t, path in colors] + [(t, 1, path) for t, path in depths])
    for t_ns, is_depth, path in every:
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if is_depth:
            meters = pixels.astype(np.float32) / np.float32(5000.0)
            yield Message(t_ns, "/camera/depth/image", types.image(t_ns, meters, "32FC1", "rgb_optical"))
        else:
            rgb = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
            yield Message(t_ns, "/camera/rgb/image_color", types.image(t_ns, rgb, "rgb8", "rgb_optical"))
