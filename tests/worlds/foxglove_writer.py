"""MCAP files with messages in Foxglove's schemas, in plain code that shares nothing with the package."""

import base64
import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from worlds.bag_writer import ROS1, ROS2, Message

DOUBLE, INT64, INT32, FIXED32, STRING, MESSAGE, BYTES, ENUM = 1, 3, 5, 7, 9, 11, 12, 14
TIME = ".google.protobuf.Timestamp"
# of each message: field, number, type (a message by its name), repeated
SCHEMAS: dict[str, list[tuple[str, int, int | str, bool]]] = {
    "google.protobuf.Timestamp": [("seconds", 1, INT64, False), ("nanos", 2, INT32, False)],
    "foxglove.Vector3": [("x", 1, DOUBLE, False), ("y", 2, DOUBLE, False), ("z", 3, DOUBLE, False)],
    "foxglove.Quaternion": [(n, k, DOUBLE, False) for k, n in ((1, "x"), (2, "y"), (3, "z"), (4, "w"))],
    "foxglove.Pose": [
        ("position", 1, ".foxglove.Vector3", False), ("orientation", 2, ".foxglove.Quaternion", False),
    ],
    "foxglove.RawImage": [
        ("timestamp", 1, TIME, False), ("frame_id", 7, STRING, False), ("width", 2, FIXED32, False),
        ("height", 3, FIXED32, False), ("encoding", 4, STRING, False), ("step", 5, FIXED32, False),
        ("data", 6, BYTES, False),
    ],
    "foxglove.CompressedImage": [
        ("timestamp", 1, TIME, False), ("frame_id", 4, STRING, False), ("data", 2, BYTES, False),
        ("format", 3, STRING, False),
    ],
    "foxglove.CameraCalibration": [
        ("timestamp", 1, TIME, False), ("frame_id", 9, STRING, False), ("width", 2, FIXED32, False),
        ("height", 3, FIXED32, False), ("distortion_model", 4, STRING, False), ("D", 5, DOUBLE, True),
        ("K", 6, DOUBLE, True), ("R", 7, DOUBLE, True), ("P", 8, DOUBLE, True),
    ],
    "foxglove.FrameTransform": [
        ("timestamp", 1, TIME, False), ("parent_frame_id", 2, STRING, False), ("child_frame_id", 3, STRING, False),
        ("translation", 4, ".foxglove.Vector3", False), ("rotation", 5, ".foxglove.Quaternion", False),
    ],
    "foxglove.FrameTransforms": [("transforms", 1, ".foxglove.FrameTransform", True)],
    "foxglove.LocationFix": [
        ("timestamp", 6, TIME, False), ("frame_id", 7, STRING, False), ("latitude", 1, DOUBLE, False),
        ("longitude", 2, DOUBLE, False), ("altitude", 3, DOUBLE, False), ("position_covariance", 4, DOUBLE, True),
        ("position_covariance_type", 5, ENUM, False),
    ],
    "foxglove.PoseInFrame": [
        ("timestamp", 1, TIME, False), ("frame_id", 2, STRING, False), ("pose", 3, ".foxglove.Pose", False),
    ],
    "foxglove.CompressedVideo": [
        ("timestamp", 1, TIME, False), ("frame_id", 2, STRING, False), ("data", 3, BYTES, False),
        ("format", 4, STRING, False),
    ],
}  # fmt: skip


def time(t_ns: int) -> dict[str, int]:
    return {"seconds": t_ns // 10**9, "nanos": t_ns % 10**9}


def varint(value: int) -> bytes:
    value &= 2**64 - 1
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def lengthy(number: int, data: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(data)) + data


def encoded(name: str, values: dict[str, Any], backwards: bool = False) -> bytes:
    """A message in protobuf's wire format, its fields by their numbers or against them."""
    parts = []
    for key, number, kind, many in sorted(SCHEMAS[name], key=lambda field: field[1], reverse=backwards):
        if key not in values:
            continue
        value = values[key]
        if many and kind == DOUBLE:
            parts.append(lengthy(number, struct.pack(f"<{len(value)}d", *value)))
        elif many:
            parts += [lengthy(number, encoded(str(kind)[1:], one, backwards)) for one in value]
        elif isinstance(kind, str):
            parts.append(lengthy(number, encoded(kind[1:], value, backwards)))
        elif kind == DOUBLE:
            parts.append(varint(number << 3 | 1) + struct.pack("<d", value))
        elif kind == FIXED32:
            parts.append(varint(number << 3 | 5) + struct.pack("<I", value))
        elif kind in (STRING, BYTES):
            parts.append(lengthy(number, value.encode() if isinstance(value, str) else bytes(value)))
        else:
            parts.append(varint(number << 3) + varint(value))
    return b"".join(parts)


def as_json(name: str, values: dict[str, Any]) -> bytes:
    """The same message as Foxglove's JSON."""

    def plain(name: str, values: dict[str, Any]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, _, kind, many in SCHEMAS[name]:
            if key not in values:
                continue
            value = values[key]
            if kind == TIME:
                out[key] = {"sec": value["seconds"], "nsec": value["nanos"]}
            elif isinstance(kind, str):
                out[key] = [plain(kind[1:], one) for one in value] if many else plain(kind[1:], value)
            elif kind == BYTES:
                out[key] = base64.b64encode(bytes(value)).decode()
            else:
                out[key] = value
        return out

    return json.dumps(plain(name, values)).encode()


def needed(name: str) -> set[str]:
    inner = [str(kind)[1:] for _, _, kind, _ in SCHEMAS[name] if isinstance(kind, str)]
    return {name}.union(*(needed(one) for one in inner))


def descriptor(name: str, schemas: dict[str, Any] | None = None) -> bytes:
    """A FileDescriptorSet with a message and those in it, each in a file of its own."""
    told = SCHEMAS | (schemas or {})
    out = b""
    for one in sorted(needed(name)):
        package, _, short = one.rpartition(".")
        fields = b""
        for key, number, kind, many in told[one]:
            field = (
                lengthy(1, key.encode()) + varint(3 << 3) + varint(number) + varint(4 << 3) + varint(3 if many else 1)
            )
            if isinstance(kind, str):
                field += varint(5 << 3) + varint(MESSAGE) + lengthy(6, kind.encode())
            else:
                field += varint(5 << 3) + varint(kind)
            fields += lengthy(2, field)
        message = lengthy(1, short.encode()) + fields
        file = lengthy(1, f"{one}.proto".encode()) + lengthy(2, package.encode()) + lengthy(4, message)
        out += lengthy(1, file + lengthy(12, b"proto3"))
    return out


class McapWriter:
    """Schemas, channels and messages in the order in which they are told, open or in one chunk."""

    def __init__(self) -> None:
        self._records = bytearray()
        self._channels: dict[str, int] = {}

    def channel(self, topic: str, schema: str, schema_encoding: str, definition: bytes, encoding: str) -> int:
        number = len(self._channels) + 1
        self._channels[topic] = number
        self._record(3, struct.pack("<H", number) + _text(schema) + _text(schema_encoding) + _text(definition))
        self._record(4, struct.pack("<HH", number, number) + _text(topic) + _text(encoding) + struct.pack("<I", 0))
        return number

    def message(self, topic: str, t_ns: int, data: bytes) -> None:
        self._record(5, struct.pack("<HIQQ", self._channels[topic], 0, t_ns, t_ns) + data)

    def has(self, topic: str) -> bool:
        return topic in self._channels

    def write(self, path: Path) -> Path:
        magic = b"\x89MCAP0\r\n"
        header = _text("") + _text("test")
        whole = bytes([1]) + struct.pack("<Q", len(header)) + header + bytes(self._records)
        end = bytes([15]) + struct.pack("<QI", 4, 0) + bytes([2]) + struct.pack("<QQQI", 20, 0, 0, 0)
        path.write_bytes(magic + whole + end + magic)
        return path

    def _record(self, op: int, data: bytes) -> None:
        self._records += bytes([op]) + struct.pack("<Q", len(data)) + data


def _text(value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def write(path: Path, messages: Iterable[Message], encoding: str, backwards: bool = False) -> Path:
    """ROS messages as an MCAP file, those that Foxglove has a schema for in it; all else as CDR."""
    writer = McapWriter()
    for message in messages:
        schema, values = of_ros(message)
        if not writer.has(message.topic):
            if schema is None:
                kind = "ros2msg", b"", "cdr"
                writer.channel(message.topic, message.type, *kind)
            elif encoding == "json":
                writer.channel(message.topic, schema, "jsonschema", b"{}", "json")
            else:
                writer.channel(message.topic, schema, "protobuf", descriptor(schema), "protobuf")
        if schema is None:
            data = bytes(ROS2.serialize_cdr(message.value, message.type))
        else:
            data = as_json(schema, values) if encoding == "json" else encoded(schema, values, backwards)
        writer.message(message.topic, message.t_ns, data)
    return writer.write(path)


def write_ros1(path: Path, messages: Iterable[Message]) -> Path:
    """Messages of ROS 1 in an MCAP file, as `mcap convert` leaves them."""
    writer = McapWriter()
    for message in messages:
        name = message.type.replace("/msg/", "/")
        if not writer.has(message.topic):
            writer.channel(message.topic, name, "ros1msg", b"# left out", "ros1")
        writer.message(message.topic, message.t_ns, bytes(ROS1.serialize_ros1(message.value, message.type)))
    return writer.write(path)


def of_ros(message: Message) -> tuple[str | None, dict[str, Any]]:
    """What Foxglove would write in place of a ROS message; no schema where it has none."""
    value, kind = message.value, message.type.rsplit("/", 1)[-1]
    if kind == "TFMessage":
        return "foxglove.FrameTransforms", {"transforms": [_transform(one) for one in value.transforms]}
    if kind not in ("Image", "CompressedImage", "CameraInfo", "NavSatFix", "PoseStamped", "CompressedVideo"):
        return None, {}
    is_video = kind == "CompressedVideo"
    stamp = value.timestamp if is_video else value.header.stamp
    values: dict[str, Any] = {
        "timestamp": {"seconds": stamp.sec, "nanos": stamp.nanosec},
        "frame_id": value.frame_id if is_video else value.header.frame_id,
    }
    if kind in ("Image", "CompressedImage", "CompressedVideo"):
        names = ("width", "height", "encoding", "step") if kind == "Image" else ("format",)
        schema = "foxglove.RawImage" if kind == "Image" else f"foxglove.{kind}"
        return schema, values | {n: getattr(value, n) for n in names} | {"data": value.data.tobytes()}
    if kind == "CameraInfo":
        matrices = {n.upper(): np.asarray(getattr(value, n)).ravel().tolist() for n in "dkrp"}
        names = ("width", "height", "distortion_model")
        return "foxglove.CameraCalibration", values | {n: getattr(value, n) for n in names} | matrices
    if kind == "NavSatFix":
        names = ("latitude", "longitude", "altitude", "position_covariance_type")
        fix = {n: getattr(value, n) for n in names} | {"position_covariance": list(value.position_covariance)}
        return "foxglove.LocationFix", values | fix
    pose = {"position": _xyz(value.pose.position), "orientation": _xyzw(value.pose.orientation)}
    return "foxglove.PoseInFrame", values | {"pose": pose}


def _transform(one: Any) -> dict[str, Any]:
    stamp = one.header.stamp
    return {
        "timestamp": {"seconds": stamp.sec, "nanos": stamp.nanosec}, "parent_frame_id": one.header.frame_id,
        "child_frame_id": one.child_frame_id, "translation": _xyz(one.transform.translation),
        "rotation": _xyzw(one.transform.rotation),
    }  # fmt: skip


def _xyz(value: Any) -> dict[str, float]:
    return {"x": value.x, "y": value.y, "z": value.z}


def _xyzw(value: Any) -> dict[str, float]:
    return _xyz(value) | {"w": value.w}
