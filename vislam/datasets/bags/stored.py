"""Messages of a bag before they are decoded: whose topic they are on, when they were logged, and where they lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

HEAD_BYTES = 512  # of a message: all of an inertial one, and the header of every other
MOST_MESSAGE_BYTES = 2**28  # as of an image file
MOST_TOPICS = 10_000


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag."""

    name: str
    type: str  # "sensor_msgs/msg/Image", for ROS 1 too
    encoding: str  # "ros1" or "cdr", "protobuf" or "json" of a schema that we know; others are never decoded
    digest: str = ""  # ROS 1: the sum over the definition
    schema: str = ""  # of Foxglove, where the type is what it stands for
    refused: str = ""  # why its definition is not the one of that name


class Place(NamedTuple):
    """Where the bytes of a message lie."""

    file: int  # number of the bag's file
    chunk: int  # where the packed chunk begins that holds it; -1: it lies open
    at: int  # in the file or in the unpacked chunk; in a database, its row
    length: int


class Found(NamedTuple):
    """One message, met while a bag is read front to back."""

    topic: Topic
    log_ns: int
    place: Place
    head: bytes  # its first bytes, `HEAD_BYTES` at most


class DamagedError(Exception):
    """Bytes that are not what their container states; met and counted in this package, never seen by its users."""


def message_type(name: str) -> str:
    """Return the ROS 2 name of a message's type, "sensor_msgs/msg/Image" for "sensor_msgs/Image"."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name
