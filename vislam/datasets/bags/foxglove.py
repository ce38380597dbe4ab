"""Messages in Foxglove's own schemas, as protobuf or JSON, as the ROS messages that say the same.

As with ROS, messages are read by the published definitions (github.com/foxglove/foxglove-sdk, schemas). The one that a
file brings is compared with them and never followed, so that it cannot lead anywhere: one in which a field that is read
has another number or type is refused, and its size is bounded.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from vislam.datasets.bags.stored import DamagedError

PROTOBUF, JSON = "protobuf", "json"
ROS_TYPES = {
    "foxglove.RawImage": "sensor_msgs/msg/Image", "foxglove.CompressedImage": "sensor_msgs/msg/CompressedImage",
    "foxglove.CameraCalibration": "sensor_msgs/msg/CameraInfo", "foxglove.LocationFix": "sensor_msgs/msg/NavSatFix",
    "foxglove.FrameTransform": "tf2_msgs/msg/TFMessage", "foxglove.FrameTransforms": "tf2_msgs/msg/TFMessage",
    "foxglove.PoseInFrame": "geometry_msgs/msg/PoseStamped",
    "foxglove.CompressedVideo": "foxglove_msgs/msg/CompressedVideo",
}  # fmt: skip


class _Field(NamedTuple):
    number: int
    kind: int | str  # protobuf's number of a type, or the name of a message
    many: bool = False


_DOUBLE, _INT64, _INT32, _FIXED32, _TEXT, _MESSAGE, _BYTES, _ENUM = 1, 3, 5, 7, 9, 11, 12, 14
_TIME = "google.protobuf.Timestamp"
_MESSAGES: dict[str, dict[str, _Field]] = {
    _TIME: {"seconds": _Field(1, _INT64), "nanos": _Field(2, _INT32)},
    "foxglove.Vector3": {name: _Field(k, _DOUBLE) for k, name in enumerate("xyz", 1)},
    "foxglove.Quaternion": {name: _Field(k, _DOUBLE) for k, name in enumerate("xyzw", 1)},
    "foxglove.Pose": {"position": _Field(1, "foxglove.Vector3"), "orientation": _Field(2, "foxglove.Quaternion")},
    "foxglove.RawImage": {
        "timestamp": _Field(1, _TIME), "frame_id": _Field(7, _TEXT), "width": _Field(2, _FIXED32),
        "height": _Field(3, _FIXED32), "encoding": _Field(4, _TEXT), "step": _Field(5, _FIXED32),
        "data": _Field(6, _BYTES),
    },
    "foxglove.CompressedImage": {
        "timestamp": _Field(1, _TIME), "frame_id": _Field(4, _TEXT), "data": _Field(2, _BYTES),
        "format": _Field(3, _TEXT),
    },
    "foxglove.CameraCalibration": {
        "timestamp": _Field(1, _TIME), "frame_id": _Field(9, _TEXT), "width": _Field(2, _FIXED32),
        "height": _Field(3, _FIXED32), "distortion_model": _Field(4, _TEXT), "D": _Field(5, _DOUBLE, True),
        "K": _Field(6, _DOUBLE, True), "R": _Field(7, _DOUBLE, True), "P": _Field(8, _DOUBLE, True),
    },
    "foxglove.FrameTransform": {
        "timestamp": _Field(1, _TIME), "parent_frame_id": _Field(2, _TEXT), "child_frame_id": _Field(3, _TEXT),
        "translation": _Field(4, "foxglove.Vector3"), "rotation": _Field(5, "foxglove.Quaternion"),
    },
    "foxglove.FrameTransforms": {"transforms": _Field(1, "foxglove.FrameTransform", True)},
    "foxglove.LocationFix": {
        "timestamp": _Field(6, _TIME), "frame_id": _Field(7, _TEXT), "latitude": _Field(1, _DOUBLE),
        "longitude": _Field(2, _DOUBLE), "altitude": _Field(3, _DOUBLE),
        "position_covariance": _Field(4, _DOUBLE, True), "position_covariance_type": _Field(5, _ENUM),
    },
    "foxglove.PoseInFrame": {
        "timestamp": _Field(1, _TIME), "frame_id": _Field(2, _TEXT), "pose": _Field(3, "foxglove.Pose"),
    },
    "foxglove.CompressedVideo": {
        "timestamp": _Field(1, _TIME), "frame_id": _Field(2, _TEXT), "data": _Field(3, _BYTES),
        "format": _Field(4, _TEXT),
    },
}  # fmt: skip
_VARINT, _EIGHT, _LENGTH, _FOUR = 0, 1, 2, 5  # how a value lies
_LIES: dict[int | str, int] = {
    _DOUBLE: _EIGHT,
    _INT64: _VARINT,
    _INT32: _VARINT,
    _FIXED32: _FOUR,
    _ENUM: _VARINT,
}  # others: by length
_MOST_FIELDS = 10_000  # in a message or a definition; images and transforms have a handful
_MOST_NUMBERS = 1000  # in a list of numbers
_MOST_TEXT_BYTES = 2**16
_MOST_DEFINITION_BYTES = 2**18
_MOST_JSON_BYTES = 2**24  # what is parsed takes several times as much memory
_MATRICES = {"K": 9, "R": 9, "P": 12}
_F64, _U32 = struct.Struct("<d"), struct.Struct("<I")


def why_refused(schema: str, encoding: str, definition: bytes) -> str:
    """Return why messages of a schema with this definition (a FileDescriptorSet) cannot be read, or nothing."""
    if schema not in ROS_TYPES or encoding != PROTOBUF:
        return ""
    if len(definition) > _MOST_DEFINITION_BYTES:
        return f"its definition of {schema} has {len(definition)} bytes, more than any of Foxglove's"
    try:
        defined = _definitions(definition)
    except DamagedError as error:
        return f"its definition of {schema} cannot be read: {error}"
    for name in _needed(schema):
        if (wrong := _difference(name, defined.get(name))) is not None:
            return f"its definition of {schema} is not Foxglove's: {wrong}"
    return ""


def decoded(schema: str, encoding: str, data: bytes) -> Any:
    """Return a message with the fields of the ROS message that it stands for; raises DamagedError."""
    values = _of_protobuf(schema, data) if encoding == PROTOBUF else _of_json(schema, _loaded(data))
    if schema == "foxglove.CameraCalibration":
        values |= {name: [0.0] * size for name, size in _MATRICES.items() if len(values[name]) != size}
    message = _named(values)
    if schema == "foxglove.RawImage":
        message.is_bigendian = 0
    if schema == "foxglove.LocationFix":
        message.status = SimpleNamespace(status=0)
        message.position_covariance_type *= len(message.position_covariance) == 9
    if ROS_TYPES[schema] != "tf2_msgs/msg/TFMessage":
        return message
    transforms = getattr(message, "transforms", [message])
    for one in transforms:
        one.transform = SimpleNamespace(translation=one.translation, rotation=one.rotation)
    return SimpleNamespace(transforms=transforms)


def stamp(schema: str, encoding: str, head: bytes) -> tuple[int, int] | None:
    """Return seconds and nanoseconds of a message's stamp by its first bytes, None where they do not hold it.

    Of several transforms it is that of none.
    """
    field = _MESSAGES[schema].get("timestamp")
    if field is None:
        return None
    try:
        if encoding == JSON:
            time = _of_json(_TIME, _time(_loaded(head).get("timestamp")))
            return int(time["seconds"]), int(time["nanos"])
        for number, lies, value in _fields(head):
            if number == field.number and lies == _LENGTH:
                time = _of_protobuf(_TIME, value)
                return int(time["seconds"]), int(time["nanos"])
    except DamagedError:
        pass
    return None


def _needed(schema: str) -> list[str]:
    """Return a message and those in it, of our own definitions, which hold no circle."""
    inner = [field.kind for field in _MESSAGES[schema].values() if isinstance(field.kind, str)]
    return [schema, *(name for kind in inner for name in _needed(kind))]


def _difference(name: str, defined: dict[str, _Field] | None) -> str | None:
    if defined is None:
        return f"no {name} in it"
    by_number = {field.number: known for known, field in defined.items()}
    for known, field in _MESSAGES[name].items():
        if known in defined and defined[known] != field:
            return f"{name}.{known} has another number or type"
        if by_number.get(field.number, known) != known:
            return f"number {field.number} of {name} is {by_number[field.number][:40]}"
    return None


def _definitions(data: bytes) -> dict[str, dict[str, _Field]]:
    """Return the fields of the messages that we know, as a FileDescriptorSet has them."""
    found: dict[str, dict[str, _Field]] = {}
    for file in _parts(data, 1):
        package = _text(next(_parts(file, 2), b""))
        for message in _parts(file, 4):
            name = f"{package}.{_text(next(_parts(message, 1), b''))}"
            if name in _MESSAGES:
                found[name] = dict(_definition(field) for field in _parts(message, 2))
    return found


def _definition(data: bytes) -> tuple[str, _Field]:
    name, number, label, kind, type_name = "", 0, 0, 0, ""
    for field, lies, value in _fields(data):
        if (field, lies) == (1, _LENGTH):
            name = _text(value)
        elif (field, lies) == (6, _LENGTH):
            type_name = _text(value)
        elif lies == _VARINT:
            number = value if field == 3 else number
            label = value if field == 4 else label
            kind = value if field == 5 else kind
    return name, _Field(number, type_name.removeprefix(".") if kind == _MESSAGE else kind, label == 3)


def _parts(data: bytes, number: int) -> Iterator[bytes]:
    return (value for field, lies, value in _fields(data) if field == number and lies == _LENGTH)


def _fields(data: bytes) -> Iterator[tuple[int, int, Any]]:
    """Yield number, how it lies, and the value of each field of a message; raises DamagedError."""
    at, count = 0, 0
    while at < len(data):
        count += 1
        if count > _MOST_FIELDS:
            raise DamagedError(f"message of more than {_MOST_FIELDS} fields")
        key, at = _varint(data, at)
        number, lies = key >> 3, key & 7
        if lies == _VARINT:
            value, at = _varint(data, at)
            yield number, lies, value
            continue
        if lies == _LENGTH:
            length, at = _varint(data, at)
        elif lies in (_EIGHT, _FOUR):
            length = 8 if lies == _EIGHT else 4
        else:
            raise DamagedError("message with a field of an unknown kind")
        if length > len(data) - at:
            raise DamagedError("message cut short")
        yield number, lies, data[at : at + length]
        at += length


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise DamagedError("message cut short")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (2**64 - 1), at
    raise DamagedError("message with a number that does not end")


def _of_protobuf(name: str, data: bytes) -> dict[str, Any]:
    """Return the fields of a message that we know; those that are absent are zero or empty."""
    known = {field.number: (key, field) for key, field in _MESSAGES[name].items()}
    values = _empty(name)
    for number, lies, value in _fields(data):
        if number not in known:
            continue
        key, field = known[number]
        is_packed = field.many and field.kind == _DOUBLE and lies == _LENGTH
        if lies != _LIES.get(field.kind, _LENGTH) and not is_packed:
            raise DamagedError(f"message whose {key} is of another type")
        if not field.many:
            values[key] = _value(field.kind, value)
        elif field.kind == _DOUBLE:
            values[key] += _doubles(key, value)
        else:
            values[key].append(_value(field.kind, value))
        if field.many and len(values[key]) > _MOST_NUMBERS:
            raise DamagedError(f"message of more than {_MOST_NUMBERS} {key}")
    return values


def _doubles(key: str, data: bytes) -> list[float]:
    """Return numbers, one or packed."""
    if len(data) % 8 != 0 or len(data) > 8 * _MOST_NUMBERS:
        raise DamagedError(f"message whose {key} are {len(data)} bytes")
    return np.frombuffer(data, dtype="<f8").tolist()


def _value(kind: int | str, value: Any) -> Any:
    if isinstance(kind, str):
        return _of_protobuf(kind, value)
    if kind == _DOUBLE:
        return _F64.unpack(value)[0]
    if kind == _FIXED32:
        return _U32.unpack(value)[0]
    if kind == _TEXT:
        return _text(value)
    if kind == _BYTES:
        return value
    return value - 2**64 if value >= 2**63 else value


def _text(data: bytes) -> str:
    if len(data) > _MOST_TEXT_BYTES:
        raise DamagedError(f"message with a name of {len(data)} bytes")
    return data.decode("utf-8", "replace")


def _empty(name: str) -> dict[str, Any]:
    zeros: dict[int | str, Any] = {_TEXT: "", _BYTES: b"", _DOUBLE: 0.0}
    return {
        key: [] if field.many else _empty(field.kind) if isinstance(field.kind, str) else zeros.get(field.kind, 0)
        for key, field in _MESSAGES[name].items()
    }


def _loaded(data: bytes) -> dict[str, Any]:
    if len(data) > _MOST_JSON_BYTES:
        raise DamagedError(f"JSON message of {len(data)} bytes, more than {_MOST_JSON_BYTES}")
    try:
        loaded = json.loads(data)
    except (ValueError, RecursionError, MemoryError) as error:
        raise DamagedError("message that is no JSON") from error
    if not isinstance(loaded, dict):
        raise DamagedError("message that is no JSON object")
    return loaded


def _of_json(name: str, message: Any) -> dict[str, Any]:
    """Return the fields of a message that we know, as `_of_protobuf` does."""
    if not isinstance(message, dict):
        raise DamagedError(f"message without {name}")
    values = _empty(name)
    for key, field in _MESSAGES[name].items():
        if message.get(key) is None:
            continue
        given = message[key]
        if not field.many:
            values[key] = _json_value(key, field.kind, given)
        elif isinstance(given, list) and len(given) <= _MOST_NUMBERS:
            values[key] = [_json_value(key, field.kind, one) for one in given]
        else:
            raise DamagedError(f"message whose {key} are no list of at most {_MOST_NUMBERS}")
    return values


def _json_value(key: str, kind: int | str, given: Any) -> Any:
    try:
        if isinstance(kind, str):
            return _of_json(kind, _time(given) if kind == _TIME else given)
        if kind == _TEXT and isinstance(given, str):
            return given[:_MOST_TEXT_BYTES]
        if kind == _BYTES and isinstance(given, str):
            return base64.b64decode(given, validate=True)
        if kind == _DOUBLE and isinstance(given, (int, float)):
            return float(given)
        if kind in (_INT64, _INT32, _FIXED32, _ENUM) and isinstance(given, int) and abs(given) < 2**63:
            return given
    except (ValueError, OverflowError) as error:
        raise DamagedError(f"message whose {key} cannot be read") from error
    raise DamagedError(f"message whose {key} is of another type")


def _time(given: Any) -> dict[str, Any]:
    """Return a stamp as Foxglove's JSON has it, under protobuf's names."""
    if not isinstance(given, dict):
        raise DamagedError("message whose timestamp is no pair of sec and nsec")
    return {"seconds": given.get("sec"), "nanos": given.get("nsec")}


def _named(values: Any) -> Any:
    """Return the fields of a message as attributes, stamp and frame as ROS's header, bytes as an array."""
    if isinstance(values, bytes):
        return np.frombuffer(values, dtype=np.uint8)
    if isinstance(values, list):
        return [_named(value) for value in values]
    if not isinstance(values, dict):
        return values
    named = SimpleNamespace(**{key: _named(value) for key, value in values.items()})
    if "timestamp" in values:
        stamp = SimpleNamespace(sec=named.timestamp.seconds, nanosec=named.timestamp.nanos % 2**32)
        frame = values["parent_frame_id" if "parent_frame_id" in values else "frame_id"]
        named.header = SimpleNamespace(stamp=stamp, frame_id=frame)
    return named
