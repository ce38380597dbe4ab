"""A node of ROS 2 without ROS: a participant of DDS on the loopback interface, its topics, and how it is announced.

Names and encoding are those of https://design.ros2.org/articles/topic_and_service_names.html and of rmw_cyclonedds; the
announcement that of https://design.ros2.org/articles/Node_to_Participant_mapping.html. Needs cyclonedds.
"""

import logging
import os
import socket
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from cyclonedds.core import Entity, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from vislam.live.bridges.ros2_types import GID_BYTES, Gid, NodeEntitiesInfo, ParticipantEntitiesInfo

_LOG = logging.getLogger(__name__)
# Linux carries multicast on loopback though the interface does not state so: most peers are found by it. Those that are
# set to do without are asked one by one.
LOOPBACK = """<CycloneDDS><Domain Id="any">
  <General><Interfaces><NetworkInterface address="127.0.0.1" multicast="true"/></Interfaces></General>
  <Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
QOS = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)),
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
# for who comes later, as tf2's static broadcaster and rmw_cyclonedds have it
KEPT = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(1),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)


class Node:
    """Owns the DDS entities of one node."""

    def __init__(self, domain: int, name: str, allow_remote: bool = False) -> None:
        """Join a domain.

        Args:
            domain: what ROS_DOMAIN_ID is for the others.
            name: of the node.
            allow_remote: use the interfaces that CYCLONEDDS_URI or the system names; else the loopback one alone.
        """
        others = set(_udp_sockets())
        self._name = name
        self._domain = None if allow_remote else Domain(domain, LOOPBACK)
        self.participant = DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))  # what makes it ROS's
        if not allow_remote:
            hear_loopback_alone(set(_udp_sockets()) - others)
        self._publisher, self._subscriber = Publisher(self.participant), Subscriber(self.participant)
        self._writers: list[DataWriter[Any]] = []
        self._readers: list[DataReader[Any]] = []

    def writer(self, topic: str, kind: Any, qos: Qos = QOS) -> DataWriter[Any]:
        """Return what writes a topic, named as ROS has it but for its first slash."""
        self._writers.append(
            DataWriter(self._publisher, Topic(self.participant, f"rt/{topic}", kind, qos=qos), qos=qos)
        )
        return self._writers[-1]

    def reader(self, topic: str, kind: Any, qos: Qos = QOS) -> DataReader[Any]:
        """Return what reads a topic."""
        read = Topic(self.participant, f"rt/{topic}", kind, qos=qos)
        self._readers.append(DataReader(self._subscriber, read, qos=qos))
        return self._readers[-1]

    def announce(self) -> None:
        """Let the others see the node with the topics that it has by now."""
        topic = Topic(self.participant, "ros_discovery_info", ParticipantEntitiesInfo, qos=KEPT)
        self._announced = DataWriter(self._publisher, topic, qos=KEPT)
        node = NodeEntitiesInfo("/", self._name, [*map(_gid, self._readers)], [*map(_gid, self._writers)])
        self._announced.write(ParticipantEntitiesInfo(_gid(self.participant), [node]))

    def close(self) -> None:
        """Leave the domain; may be called twice."""
        vars(self).clear()  # an entity leaves when it is let go


def _gid(entity: Entity) -> Any:
    return Gid(list(entity.guid.bytes.ljust(GID_BYTES, b"\0")))


def _udp_sockets() -> Iterator[int]:
    """Yield the descriptors of this process that are UDP sockets."""
    for entry in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
        with suppress(OSError), socket.socket(fileno=os.dup(int(entry.name))) as found:  # one that is closed by now
            if found.type == socket.SOCK_DGRAM and found.family in (socket.AF_INET, socket.AF_INET6):
                yield int(entry.name)


def hear_loopback_alone(descriptors: Iterable[int]) -> None:
    """Bind sockets to the loopback device, as Cyclone receives at every address (its issue 2090); warn if refused."""
    for descriptor in descriptors:
        with socket.socket(fileno=os.dup(descriptor)) as bound:
            try:
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
            except OSError as error:  # Linux before 5.7 lets root alone do so
                _LOG.warning("ROS 2's port %d hears other machines, too: %s", bound.getsockname()[1], error.strerror)
