"""The pose on the wires of others: ROS 2 over DDS, MAVLink; checked against numbers worked out by hand."""

import importlib.util
import math
import os
import socket
import subprocess
import sys
import time
import uuid
from itertools import count
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.live.test_published_pose import random_pose
from tests.needs import missing
from vislam.config import LiveConfig
from vislam.core.errors import UsageError
from vislam.core.geometry import rotation_from_quaternion_xyzw, transform
from vislam.hw.health import Health
from vislam.live.bridges import translator
from vislam.live.processes.child import Child, Flag, Signals
from vislam.live.wire.publisher import PosePublisher

_DOMAIN = 100 + os.getpid() % 100  # not the domain of whatever else runs here
_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # 90 degrees to the left
_HALF = math.sqrt(0.5)
_NO_STATE = {"pose_covariance": np.full((6, 6), np.inf), "twist_covariance": np.full((6, 6), np.inf)}

needs_dds = pytest.mark.usefixtures("dds")
needs_mavlink = pytest.mark.usefixtures("mavlink")


@pytest.fixture
def dds() -> None:
    if importlib.util.find_spec("cyclonedds") is None:
        missing("cyclonedds is not installed: pip install '.[ros2]'")


@pytest.fixture
def mavlink() -> None:
    if importlib.util.find_spec("pymavlink") is None:
        missing("pymavlink is not installed: pip install '.[mavlink]'")


def known_pose(**changes: object):
    """A base 3 m ahead, 2 m to the left and 1 m up, turned left by 90 degrees, in a map that is turned as well."""
    covariance = np.diag([1.0, 4.0, 9.0, 0.01, 0.04, 0.09])
    covariance[0, 1] = covariance[1, 0] = 0.5  # x with y
    covariance[1, 5] = covariance[5, 1] = 0.25  # y with the heading
    covariance[1, 2] = covariance[2, 1] = 0.125  # y with z
    twist = np.diag([0.1, 0.2, 0.3, 0.001, 0.002, 0.003])
    twist[0, 2] = twist[2, 0] = 0.05
    values = {
        "t_ns": 12_345_678_901, "T_odom_base": transform(_TURN, np.array([3.0, 2.0, 1.0])),
        "velocity_m_s": np.array([0.5, 0.1, -0.2]), "rate_rad_s": np.array([0.01, 0.02, 0.3]),
        "pose_covariance": covariance, "twist_covariance": twist, "reset_counter": 258,
        "T_map_odom": transform(_TURN, np.array([10.0, 20.0, 0.0])),
    }  # fmt: skip
    return random_pose(**(values | changes))


@needs_dds
def test_odometry_is_in_ros_frames_units_and_order() -> None:
    from vislam.live.bridges.ros2 import odometry

    pose = known_pose()
    message = odometry(pose, 1_700_000_000_250_000_000)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    where, q = message.pose.pose.position, message.pose.pose.orientation
    assert (where.x, where.y, where.z) == (3.0, 2.0, 1.0)
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], [0.0, 0.0, _HALF, _HALF], atol=1e-15)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    assert (linear.x, linear.y, linear.z) == (0.5, 0.1, -0.2)
    assert (angular.x, angular.y, angular.z) == (0.01, 0.02, 0.3)
    assert [message.pose.covariance[k] for k in (0, 1, 7, 8, 11, 14, 21, 28, 31, 35)] == [
        1.0, 0.5, 4.0, 0.125, 0.25, 9.0, 0.01, 0.04, 0.25, 0.09,
    ]  # fmt: skip
    assert [message.twist.covariance[k] for k in (0, 2, 7, 12, 14, 21, 28, 35)] == [
        0.1, 0.05, 0.2, 0.05, 0.3, 0.001, 0.002, 0.003,
    ]  # fmt: skip


@needs_dds
def test_tf_says_where_odom_is_in_map_and_base_in_odom() -> None:
    from vislam.live.bridges.ros2 import transforms

    pose = known_pose()
    links = transforms(pose, 1).transforms
    assert [(link.header.frame_id, link.child_frame_id) for link in links] == [("map", "odom"), ("odom", "base_link")]
    T_map_base = np.eye(4)
    for link in links:
        q, t = link.transform.rotation, link.transform.translation
        T_map_base = T_map_base @ transform(
            rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w])), np.array([t.x, t.y, t.z])
        )
    # 3 ahead and 2 left of a frame that is turned left: 2 back, 3 left; two quarter turns are a half.
    np.testing.assert_allclose(T_map_base[:3, 3], [8.0, 23.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(T_map_base[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


@needs_dds
def test_tf_says_nothing_of_map_while_the_place_in_it_is_not_known() -> None:
    from vislam.live.bridges.ros2 import transforms

    links = transforms(known_pose(health=Health.LEVELLED | Health.NOT_IN_MAP), 1).transforms
    assert [(link.header.frame_id, link.child_frame_id) for link in links] == [("odom", "base_link")]


def publish_until(name: str, at: str, pose, enough, make=known_pose) -> None:
    """Publish a pose again and again, for None a new one that `make` makes, until enough has come of it."""
    publisher = PosePublisher(name, (at,))
    try:
        end = time.monotonic() + 600.0  # only ends a hang
        for k in count(1):
            if time.monotonic() > end:
                pytest.fail("nothing came over the wire")
            now_ns = time.monotonic_ns()
            publisher.publish(make(t_ns=now_ns, published_ns=now_ns, sequence=k) if pose is None else pose)
            if enough():
                return
            time.sleep(0.01)
    finally:
        publisher.close()


class Bridge:
    """A translator's process, run as a live run does."""

    def __init__(self, live: LiveConfig, role: str) -> None:
        self.at, body = translator.asked(live)[role]
        self._signals = Signals(Flag(), Flag())
        self._child = Child.started(role, self._signals, body)
        self._signals.go.set()

    def end(self) -> int | None:
        self._signals.stop.set()
        self._child.process.join(600.0)
        return self._child.process.exitcode


ON_LOOPBACK = '<NetworkInterface address="127.0.0.1" multicast="true"/>'
ASKING = "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"


@needs_dds
@pytest.mark.parametrize(
    "loopback",
    [
        f"<General><Interfaces>{ON_LOOPBACK}</Interfaces></General>",
        f"<General><AllowMulticast>false</AllowMulticast><Interfaces>{ON_LOOPBACK}</Interfaces></General><Discovery>{ASKING}</Discovery>",
    ],
    ids=["multicast", "asking"],
)
def test_a_ros_reader_gets_the_pose_from_the_process_beside(loopback: str) -> None:
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from vislam.live.bridges import ros2, ros2_node, ros2_types

    name = f"vislam-test-{uuid.uuid4().hex[:8]}"
    translator = Bridge(LiveConfig(name=name, ros2_domain=_DOMAIN, bridge_rate_hz=1000.0), "ros2")
    domain = Domain(_DOMAIN, f"<CycloneDDS><Domain>{loopback}</Domain></CycloneDDS>")
    participant = DomainParticipant(_DOMAIN)
    readers = {
        topic: DataReader(participant, Topic(participant, f"rt/{topic}", kind, qos=ros2_node.QOS), qos=ros2_node.QOS)
        for topic, kind in (("odom", ros2_types.Odometry), ("tf", ros2_types.TFMessage))
    }
    got: dict[str, list] = {"odom": [], "tf": []}

    def enough() -> bool:
        for topic, reader in readers.items():
            got[topic] += reader.take(N=100)
        return all(len(messages) >= 3 for messages in got.values())

    try:
        publish_until(name, translator.at, None, enough)
    finally:
        assert translator.end() == 0
        readers.clear()
        del participant, domain
    message = got["odom"][-1]
    expected = ros2.odometry(known_pose(), message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
    assert abs(time.time() - message.header.stamp.sec) < 60.0
    assert message.header == expected.header
    assert message.pose.pose.position == expected.pose.pose.position
    np.testing.assert_allclose(message.pose.covariance, expected.pose.covariance, rtol=1e-6)
    assert [link.child_frame_id for link in got["tf"][-1].transforms] == ["odom", "base_link"]


@needs_dds
def test_a_peer_that_is_not_cyclone_is_called_on_loopback_alone() -> None:
    """Any DDS listens at this address and port for what others announce of themselves (RTPS 2.2, 9.6.1.4)."""
    from vislam.live.bridges import ros2

    domain = _DOMAIN + 32
    peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    peer.bind(("239.255.0.1", 7400 + 250 * domain))
    group = socket.inet_aton("239.255.0.1") + socket.inet_aton("127.0.0.1")
    peer.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
    peer.settimeout(600.0)  # only ends a hang
    before = udp_sockets()
    wire = ros2.Ros2(domain)
    try:
        data, (sender, _) = peer.recvfrom(65536)
        assert data.startswith(b"RTPS") and sender == "127.0.0.1"
        opened = udp_sockets() - before
        assert opened
        with open("/proc/net/udp") as table:  # bound to which addresses and to which device
            bound = {row.split()[9]: row.split()[1].split(":")[0] for row in table.readlines()[1:]}
        assert {bound[inode] for inode, _ in opened} <= {"0100007F", "00000000"}
        assert {device for _, device in opened} == {b"lo"}
    finally:
        wire.close()
        peer.close()


def udp_sockets() -> set[tuple[str, bytes]]:
    """Return inode and device of every UDP socket of this process."""
    found = set()
    for entry in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
        with socket.socket(fileno=os.dup(int(entry.name))) as held:
            if (held.family, held.type) == (socket.AF_INET, socket.SOCK_DGRAM):
                device = held.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0")
                found.add((str(os.fstat(held.fileno()).st_ino), device))
    return found


@needs_dds
def test_a_socket_that_cannot_be_kept_to_loopback_is_named(caplog: pytest.LogCaptureFixture) -> None:
    from vislam.live.bridges import ros2_node

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as open_to_all, pytest.MonkeyPatch.context() as patch:
        open_to_all.bind(("", 0))
        patch.setattr(socket, "SO_BINDTODEVICE", 9999)
        ros2_node.hear_loopback_alone([open_to_all.fileno()])
        assert f"port {open_to_all.getsockname()[1]} hears other machines" in caplog.text


@needs_dds
@pytest.mark.parametrize("changes", [{"health": Health.LEVELLED | Health.INVALID}, _NO_STATE])
def test_ros_hears_nothing_of_a_pose_not_to_steer_by(changes: dict) -> None:
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from vislam.live.bridges import ros2, ros2_node, ros2_types

    wire = ros2.Ros2(_DOMAIN + 30)
    try:
        topic = Topic(wire.node.participant, "rt/odom", ros2_types.Odometry, qos=ros2_node.QOS)
        reader = DataReader(wire.node.participant, topic, qos=ros2_node.QOS)
        wire.send(known_pose(**changes))
        wire.send(known_pose(T_odom_base=np.eye(4)))
        assert [message.pose.pose.position.x for message in reader.take(N=10)] == [0.0]
    finally:
        wire.close()


@needs_dds
def test_ros_hears_the_health_word_of_every_pose() -> None:
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from vislam.live.bridges import ros2, ros2_node, ros2_types

    wire = ros2.Ros2(_DOMAIN + 31)
    words = [Health.LEVELLED | Health.INVALID, Health.LEVELLED | Health.VISION_OK | Health.DOUBTFUL]
    try:
        topic = Topic(wire.node.participant, "rt/vislam/health", ros2_types.UInt32, qos=ros2_node.QOS)
        reader = DataReader(wire.node.participant, topic, qos=ros2_node.QOS)
        for word in words:
            wire.send(known_pose(health=word))
        assert [Health(message.data) for message in reader.take(N=10)] == words
    finally:
        wire.close()


@needs_dds
def test_who_comes_later_finds_the_node_and_where_its_sensors_are() -> None:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
    from cyclonedds.core import Policy
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from vislam.live.bridges import ros2, ros2_node, ros2_types

    T_body_cam = transform(_TURN, np.array([0.1, 0.0, 0.2]))
    sensors = translator.sensor_frames(LiveConfig(base_offset_m=(0.0, 0.0, -0.3)), (T_body_cam,))
    wire = ros2.Ros2(_DOMAIN + 33, sensors)
    try:
        other = DomainParticipant(_DOMAIN + 33)
        static = DataReader(
            other, Topic(other, "rt/tf_static", ros2_types.TFMessage, qos=ros2_node.KEPT), qos=ros2_node.KEPT
        )
        kind = ros2_types.ParticipantEntitiesInfo
        nodes = DataReader(other, Topic(other, "ros_discovery_info", kind, qos=ros2_node.KEPT), qos=ros2_node.KEPT)
        links, told = (reader.take_one(timeout=600 * 10**9) for reader in (static, nodes))
        people = {one.key.bytes: one.qos for one in BuiltinDataReader(other, BuiltinTopicDcpsParticipant).take(N=10)}
    finally:
        wire.close()
    frames = [(link.header.frame_id, link.child_frame_id) for link in links.transforms]
    assert frames == [("base_link", "imu_link"), ("base_link", "cam0_optical")]
    where, q = links.transforms[1].transform.translation, links.transforms[1].transform.rotation
    np.testing.assert_allclose([where.x, where.y, where.z, q.z, q.w], [0.1, 0.0, 0.5, _HALF, _HALF], atol=1e-12)
    assert people[bytes(told.gid.data[:16])][Policy.Userdata].data == b"enclave=/;"
    (node,) = told.node_entities_info_seq
    assert (node.node_namespace, node.node_name, len(node.writer_gid_seq)) == ("/", "vislam", 7)


@needs_dds
def test_messages_are_those_of_ros_to_the_byte() -> None:
    from rosbags.typesys import Stores, get_typestore

    from vislam.live.bridges import ros2, ros2_types

    pose = known_pose(health=Health.LEVELLED | Health.DEAD_RECKONING)
    gid = ros2_types.Gid(list(range(ros2_types.GID_BYTES)))
    node = ros2_types.NodeEntitiesInfo("/", "vislam", [], [gid, gid])
    for name, message in {
        "nav_msgs/msg/Odometry": ros2.odometry(pose, 5),
        "tf2_msgs/msg/TFMessage": ros2.transforms(pose, 6),
        "std_msgs/msg/UInt32": ros2_types.UInt32(7),
        "diagnostic_msgs/msg/DiagnosticArray": ros2.diagnosis(pose, 8),
        "rmw_dds_common/msg/ParticipantEntitiesInfo": ros2_types.ParticipantEntitiesInfo(gid, [node]),
    }.items():
        store, data = get_typestore(Stores.ROS2_JAZZY), message.serialize(use_version_2=False)
        assert bytes(store.serialize_cdr(store.deserialize_cdr(data, name), name)) == data, name


@needs_dds
@pytest.mark.parametrize(
    ("health", "level", "says"),
    [
        (Health.LEVELLED | Health.VISION_OK | Health.AT_REST, 0, "OK"),
        (Health.LEVELLED | Health.DEAD_RECKONING | Health.IMU_GAP, 1, "DEAD_RECKONING, IMU_GAP"),
        (Health.LEVELLED | Health.INVALID | Health.IMU_MISSING, 2, "INVALID, IMU_MISSING"),
        (Health(0), 2, "not LEVELLED"),
    ],
)
def test_diagnostics_name_the_faults(health: Health, level: int, says: str) -> None:
    from vislam.live.bridges.ros2 import diagnosis

    (status,) = diagnosis(known_pose(health=health), 1).status
    assert (status.level, status.message) == (level, says)
    assert {pair.key for pair in status.values if pair.value == "True"} == {bit.name for bit in health}


@needs_mavlink
def test_mavlink_odometry_is_in_forward_right_down() -> None:
    from pymavlink.dialects.v20 import common

    from vislam.live.bridges.mavlink import odometry

    link = common.MAVLink(None, 1, 197)
    message = common.MAVLink(None).parse_char(odometry(known_pose()).pack(link))
    assert message.get_msgId() == 331
    assert message.time_usec == 12_345_678
    assert (message.frame_id, message.child_frame_id) == (common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_BODY_FRD)
    np.testing.assert_allclose([message.x, message.y, message.z], [3.0, -2.0, -1.0])
    np.testing.assert_allclose(message.q, [_HALF, 0.0, 0.0, -_HALF], atol=1e-7)  # a turn to the left is negative
    np.testing.assert_allclose([message.vx, message.vy, message.vz], [0.5, -0.1, 0.2], rtol=1e-6)
    np.testing.assert_allclose(
        [message.rollspeed, message.pitchspeed, message.yawspeed], [0.01, -0.02, -0.3], rtol=1e-6
    )
    pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
    pose[np.triu_indices(6)], twist[np.triu_indices(6)] = message.pose_covariance, message.velocity_covariance
    expected = np.diag([1.0, 4.0, 9.0, 0.01, 0.04, 0.09])
    expected[0, 1], expected[1, 5], expected[1, 2] = -0.5, 0.25, 0.125  # y and z, y and heading both turn over
    np.testing.assert_allclose(pose, expected, rtol=1e-6)
    expected = np.diag([0.1, 0.2, 0.3, 0.001, 0.002, 0.003])
    expected[0, 2] = -0.05
    np.testing.assert_allclose(twist, expected, rtol=1e-6)
    assert message.reset_counter == 2  # of 258: it is a byte there
    assert message.estimator_type == common.MAV_ESTIMATOR_TYPE_VIO


@needs_mavlink
def test_roll_keeps_its_sign_and_pitch_turns_over() -> None:
    from vislam.live.bridges.mavlink import odometry

    rolled = transform(rotation_from_quaternion_xyzw(np.array([math.sin(0.1), 0.0, 0.0, math.cos(0.1)])), np.zeros(3))
    pitched = transform(rotation_from_quaternion_xyzw(np.array([0.0, math.sin(0.1), 0.0, math.cos(0.1)])), np.zeros(3))
    for T, expected in ((rolled, [0.2, 0.0, 0.0]), (pitched, [0.0, -0.2, 0.0])):
        w, x, y, z = odometry(known_pose(T_odom_base=T)).q
        np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_euler("xyz"), expected, atol=1e-12)


@needs_mavlink
def test_what_is_unknown_is_nan_and_quality_follows_the_health() -> None:
    from vislam.live.bridges.mavlink import odometry, quality

    message = odometry(known_pose(health=Health.INVALID, **_NO_STATE))
    assert np.isnan(message.pose_covariance[0])
    assert np.isnan(message.velocity_covariance[0])
    assert message.quality == quality(Health(0)) == quality(Health.LEVELLED | Health.VISION_OK | Health.INVALID) == -1
    assert quality(Health.LEVELLED | Health.VISION_OK) == 100
    assert quality(Health.LEVELLED | Health.VISION_OK | Health.DOUBTFUL) == 50
    assert quality(Health.LEVELLED | Health.DEAD_RECKONING) == 25
    assert quality(Health.LEVELLED | Health.VISION_OK | Health.GATE_REJECT) == 25


@needs_mavlink
def test_an_autopilot_gets_the_pose_from_the_process_beside() -> None:
    from pymavlink.dialects.v20 import common

    name = f"vislam-test-{uuid.uuid4().hex[:8]}"
    autopilot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    autopilot.bind(("127.0.0.1", 0))
    autopilot.setblocking(False)
    live = LiveConfig(name=name, mavlink=f"udp:127.0.0.1:{autopilot.getsockname()[1]}", bridge_rate_hz=1000.0)
    translator = Bridge(live, "mavlink")
    parser, got = common.MAVLink(None), []

    def enough() -> bool:
        try:
            while True:
                got.extend(parser.parse_buffer(autopilot.recv(1024)) or [])
        except BlockingIOError:
            return len(got) >= 4

    try:
        publish_until(name, translator.at, None, enough)
    finally:
        assert translator.end() == 0
        autopilot.close()
    assert [message.get_type() for message in got[:3]] == ["HEARTBEAT", "ODOMETRY", "ODOMETRY"]
    sequence = [message.get_seq() for message in got]
    assert sequence == list(range(len(got)))
    assert (got[1].x, got[1].y, got[1].z) == (3.0, -2.0, -1.0)


class FakeAutopilot:
    """A clock of its own, a socket, and PX4's way of mapping stamps by TIMESYNC; time passes when it is let to."""

    def __init__(self, boot_ns: int) -> None:
        from pymavlink.dialects.v20 import common

        self.now_ns = 50 * 10**9  # of the sender
        self._boot_ns = boot_ns  # in the sender's clock
        self._link, self._parser = common.MAVLink(None, 1, 1), common.MAVLink(None)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(60.0)  # only ends a hang
        self.to = f"udp:127.0.0.1:{self.socket.getsockname()[1]}"
        self.peer: tuple[str, int] | None = None

    def clock_ns(self) -> int:
        return self.now_ns - self._boot_ns

    def receive(self, kind: str):
        while True:
            data, self.peer = self.socket.recvfrom(1024)
            for message in self._parser.parse_buffer(data) or []:
                if message.get_type() == kind:
                    return message

    def send(self, data: bytes) -> None:
        self.socket.sendto(data, self.peer)

    def ask(self, there_ns: int, back_ns: int) -> int:
        """Return its clock less the sender's, taking both ways as equally long."""
        asked_ns = self.clock_ns()
        self.now_ns += there_ns
        self.send(self._link.timesync_encode(0, asked_ns).pack(self._link))
        answer = self.receive("TIMESYNC")
        self.now_ns += back_ns
        assert answer.ts1 == asked_ns
        return (answer.ts1 + self.clock_ns()) // 2 - answer.tc1


@needs_mavlink
@pytest.mark.parametrize("boot_ns", [49 * 10**9, -(10**12)])
def test_an_autopilot_maps_stamps_into_its_own_clock(boot_ns: int) -> None:
    from vislam.live.bridges.mavlink import Mavlink

    autopilot = FakeAutopilot(boot_ns)
    wire = Mavlink(autopilot.to, "vislam-test", clock_ns=lambda: autopilot.now_ns)
    try:
        wire.send(known_pose(t_ns=autopilot.now_ns, published_ns=autopilot.now_ns))
        autopilot.receive("ODOMETRY")
        for garbage in (b"", b"\xfd", np.random.default_rng(0).bytes(300), bytes(range(256)) * 4):
            autopilot.send(garbage)
        offset_ns = autopilot.ask(300_000, 900_000)
        assert abs(offset_ns + boot_ns) <= 300_000  # half of what the ways differ
        for age_ns in (7_000_000, 22_000_000):
            autopilot.now_ns += 20_000_000
            wire.send(known_pose(t_ns=autopilot.now_ns - age_ns, published_ns=autopilot.now_ns))
            stamp_ns = autopilot.receive("ODOMETRY").time_usec * 1000 + offset_ns
            assert abs(autopilot.clock_ns() - stamp_ns - age_ns) < 1_000_000
    finally:
        wire.close()
        wire.close()
        autopilot.socket.close()


@needs_mavlink
def test_what_is_no_request_is_not_answered_nor_who_is_not_the_autopilot() -> None:
    from pymavlink.dialects.v20 import common

    from vislam.live.bridges.mavlink import Mavlink

    autopilot, link = FakeAutopilot(0), common.MAVLink(None, 1, 1)
    wire = Mavlink(autopilot.to, "vislam-test", clock_ns=lambda: 5)
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        wire.send(known_pose())
        autopilot.receive("ODOMETRY")
        assert autopilot.peer is not None and autopilot.peer[0] == "127.0.0.1"
        stranger.sendto(link.timesync_encode(0, 11).pack(link), autopilot.peer)
        autopilot.send(link.timesync_encode(7, 22).pack(link))  # an answer
        autopilot.send(link.timesync_encode(0, 33).pack(link))
        answer = autopilot.receive("TIMESYNC")
        assert (answer.tc1, answer.ts1) == (5, 33)
    finally:
        wire.close()
        stranger.close()
        autopilot.socket.close()


def test_poses_beyond_the_rate_are_left_out() -> None:
    from vislam.live.processes.child import Life

    sent: list[int] = []

    class Kept:
        def send(self, pose) -> None:
            sent.append(pose.sequence)

        def close(self) -> None:
            sent.append(-1)

    class Poses:
        """Hands out a second of poses at 400 Hz, then ends the run."""

        def __init__(self, at: str) -> None:
            self.left = iter([known_pose(published_ns=10**9 + k * 2_500_000, sequence=k) for k in range(1, 401)])

        def next(self, timeout_s: float):
            pose = next(self.left, None)
            if pose is None:
                signals.stop.set()
            return pose

        def close(self) -> None:
            sent.append(-2)

    context = get_context("spawn")
    signals = Signals(Flag(), Flag())
    signals.go.set()
    _, says = context.Pipe(duplex=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(translator, "PoseListener", Poses)
        translator.run(Life("kept", says, signals), "unix:never", 50.0, Kept)
    assert sent == [*range(1, 401, 8), -1, -2]


def test_nothing_is_started_unasked() -> None:
    assert translator.asked(LiveConfig()) == {}


@needs_dds
@needs_mavlink
@pytest.mark.parametrize(
    ("live", "says"),
    [
        (LiveConfig(ros2_domain=233), "domains 0 to 232"),
        (LiveConfig(mavlink="udp:192.0.2.1:14550"), "beyond this machine"),
        (LiveConfig(mavlink="udpout:127.0.0.1:14550"), "write unix, unix:PATH or udp"),
        (LiveConfig(ros2_domain=0, bridge_rate_hz=0.0), "must be more than 0"),
        (LiveConfig(ros2_domain=0, bridge_rate_hz=float("nan")), "must be more than 0"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(live: LiveConfig, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        translator.asked(live)


@pytest.mark.parametrize(
    ("live", "extra"), [(LiveConfig(ros2_domain=0), "ros2"), (LiveConfig(mavlink="udp:127.0.0.1:1"), "mavlink")]
)
def test_a_missing_package_is_named_with_what_installs_it(
    live: LiveConfig, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(translator, "find_spec", lambda package: None)
    with pytest.raises(UsageError, match=rf"pip install '\.\[{extra}\]'"):
        translator.asked(live)


def test_neither_package_is_loaded_beside_the_pose() -> None:
    code = (
        "import sys, vislam.cli, vislam.live.run_live, vislam.live.processes.fast; "
        "print(sorted({name.partition('.')[0] for name in sys.modules} & {'cyclonedds', 'pymavlink'}))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]", found.stdout
