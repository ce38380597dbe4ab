"""Map and scan for ROS 2, and what ROS 2 may ask of an armed cart; messages are read by another implementation."""

import importlib.util
import math
import os
import time
import uuid
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from tests.live.test_pose_bridges import known_pose, publish_until
from tests.needs import missing
from vislam.config import LiveConfig
from vislam.core.geometry import so3_exp, transform
from vislam.hw.health import Health
from vislam.live.bridges import translator
from vislam.live.driving import steering
from vislam.live.driving.orders import Goal, Place, Steer
from vislam.live.driving.pursuit import Limits
from vislam.live.notices import MapCells
from vislam.live.processes.child import Child, Flag, Signals
from vislam.live.virtual.pilot import CommandReader
from vislam.live.wire.mail import Outbox
from waiting import wait_for

_DOMAIN = 1 + os.getpid() % 90  # not the domain of whatever else runs here
LEFT = 0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)  # a quarter turn, x, y, z, w
WELL = Health.LEVELLED | Health.VISION_OK


@pytest.fixture(autouse=True)
def dds() -> None:
    if importlib.util.find_spec("cyclonedds") is None:
        missing("cyclonedds is not installed: pip install '.[ros2]'")


def room() -> MapCells:
    """A room from -2 to 2 m along x and -1 to 1 m along y, whose far end was not seen, in walls of one cell."""
    states = np.zeros((42, 82), np.int8)
    states[[0, -1]] = 1
    states[:, 0] = 3
    states[:, -10:] = -1
    return MapCells(states, 0.05, (-2.05, -1.05), 0.1, (0.6, 0.5))


def read_elsewhere(message, name: str):
    """Return a message as another implementation reads it, which writes the same bytes again."""
    from rosbags.typesys import Stores, get_typestore

    store, data = get_typestore(Stores.ROS2_JAZZY), message.serialize(use_version_2=False)
    read = store.deserialize_cdr(data, name)
    assert bytes(store.serialize_cdr(read, name)) == data
    return read


def test_the_map_is_an_occupancy_grid_as_nav2_has_it() -> None:
    from vislam.live.bridges.ros2 import occupancy_grid

    read = read_elsewhere(occupancy_grid(room(), 1_700_000_000_250_000_000), "nav_msgs/msg/OccupancyGrid")
    assert (read.header.frame_id, read.header.stamp.sec, read.header.stamp.nanosec) == (
        "map",
        1_700_000_000,
        250_000_000,
    )
    assert (read.info.width, read.info.height) == (82, 42)
    assert read.info.resolution == pytest.approx(0.05)
    origin = read.info.origin
    assert (origin.position.x, origin.position.y, origin.position.z) == (-2.05, -1.05, 0.1)
    assert (origin.orientation.x, origin.orientation.y, origin.orientation.z, origin.orientation.w) == (0, 0, 0, 1)
    cells = np.asarray(read.data).reshape(42, 82)
    assert {*np.unique(cells).tolist()} == {-1, 0, 100}
    np.testing.assert_array_equal(cells > 0, room().states > 0)  # all that cannot be driven on is one value
    np.testing.assert_array_equal(cells < 0, room().states < 0)


def test_a_scan_has_the_walls_where_they_are_and_nothing_of_what_was_not_seen() -> None:
    from vislam.live.bridges.ros2 import scan

    yaw = 0.5
    T = transform(so3_exp(np.array([0.0, 0.0, yaw])), np.array([-0.5, 0.25, 0.3]))
    read = read_elsewhere(scan(room(), T, 5), "sensor_msgs/msg/LaserScan")
    assert read.header.frame_id == "base_link"
    assert len(read.ranges) == 360 and len(read.intensities) == 0
    assert read.angle_min + 359 * read.angle_increment == pytest.approx(read.angle_max, abs=1e-5)
    ranges = np.asarray(read.ranges)
    seen = 0
    for k, distance in enumerate(ranges):
        bearing = yaw + read.angle_min + k * read.angle_increment
        c, s = math.cos(bearing), math.sin(bearing)
        ends = [
            (edge - at) / way
            for edge, at, way in ((-2.0, -0.5, c), (-1.0, 0.25, s), (1.0, 0.25, s))
            if (edge - at) * way > 0
        ]
        unseen = (1.55 - -0.5) / c if c > 0.0 else math.inf
        if unseen + 0.1 < min(ends):
            assert math.isnan(distance)
        elif unseen - 0.1 > min(ends):
            assert distance == pytest.approx(min(ends), abs=0.04 + 0.03 / max(abs(s), abs(c)))
            seen += 1
    assert seen > 200
    assert read.range_min <= np.nanmin(ranges) and np.nanmax(ranges) <= read.range_max
    assert np.isinf(
        scan(replace(room(), states=np.zeros((400, 400), np.int8), origin_m=(-10.0, -10.0)), T, 5).ranges
    ).all()


class Beside:
    """A process as a live run starts it, with its wire of maps."""

    def __init__(self, role: str, body: Callable[..., Callable]) -> None:
        sends, takes = get_context("spawn").Pipe(duplex=False)[::-1]
        self._signals, self.maps = Signals(Flag(), Flag()), Outbox(sends, 1)
        self.child = Child.started(role, self._signals, body(takes))
        self._signals.go.set()

    def end(self) -> int | None:
        self._signals.stop.set()
        self.child.process.join(600.0)
        return self.child.process.exitcode


def test_who_comes_later_gets_the_newest_map_and_scans_from_the_process_beside() -> None:
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from vislam.live.bridges import ros2_node, ros2_types

    live = LiveConfig(name=f"vislam-test-{uuid.uuid4().hex[:8]}", ros2_domain=_DOMAIN, bridge_rate_hz=1000.0)
    at, _ = translator.asked(live)["ros2"]
    beside = Beside("ros2", lambda maps: translator.asked(live, (), maps)["ros2"][1])
    _domain = Domain(_DOMAIN, ros2_node.LOOPBACK)  # held: what joins it is on loopback
    participant, got = DomainParticipant(_DOMAIN), {"map": [], "scan": []}
    kinds = {"scan": (ros2_types.LaserScan, ros2_node.QOS), "map": (ros2_types.OccupancyGrid, ros2_node.KEPT)}
    readers = {}

    def join(topic: str) -> None:
        kind, qos = kinds[topic]
        readers[topic] = DataReader(participant, Topic(participant, f"rt/{topic}", kind, qos=qos), qos=qos)

    def enough() -> bool:
        for topic, reader in readers.items():
            got[topic] += reader.take(N=100)
        if got["scan"] and "map" not in readers:  # the map was written by then, before anybody read it
            join("map")
        return all(got[topic] for topic in ("scan", "map"))

    try:
        join("scan")
        beside.maps.put(room())
        publish_until(live.name, at, known_pose(T_map_odom=np.eye(4), T_odom_base=np.eye(4), health=WELL), enough)
    finally:
        assert beside.end() == 0
        readers.clear()
    assert (got["map"][-1].info.width, got["map"][-1].info.height) == (82, 42)
    assert got["scan"][-1].ranges[180] != got["scan"][-1].ranges[180]  # ahead is what was not seen
    assert got["scan"][-1].ranges[90] == pytest.approx(1.0, abs=0.05)  # to the right is the wall


def test_without_an_armed_cart_nothing_listens() -> None:
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from vislam.live.bridges import ros2, ros2_node, ros2_types
    from vislam.live.bridges.ros2_orders import Ros2Orders

    def readers_of(wire) -> int:
        other = DomainParticipant(_DOMAIN + 91)
        kind, kept = ros2_types.ParticipantEntitiesInfo, ros2_node.KEPT
        nodes = DataReader(other, Topic(other, "ros_discovery_info", kind, qos=kept), qos=kept)
        (node,) = nodes.take_one(timeout=600 * 10**9).node_entities_info_seq
        wire.close()
        return len(node.reader_gid_seq)

    assert readers_of(ros2.Ros2(_DOMAIN + 91)) == 0
    assert readers_of(Ros2Orders(_DOMAIN + 91)) == 3


def test_orders_come_over_dds_and_what_is_none_is_refused() -> None:
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from vislam.live.bridges import ros2_node, ros2_types
    from vislam.live.bridges.ros2_orders import Ros2Orders, goal_of, place_of, steer_of

    def goal(x: float = 1.0, q: tuple = LEFT, frame: str = "map"):
        pose = ros2_types.Pose(ros2_types.Point(x, -2.0, 0.0), ros2_types.Quaternion(*q))
        return ros2_types.PoseStamped(ros2_types.Header(ros2_types.stamp(3), frame), pose)

    def twist(speed: float, rate: float):
        zero = (0.0, 0.0)
        return ros2_types.Twist(ros2_types.Vector3(speed, *zero), ros2_types.Vector3(*zero, rate))

    found = goal_of(goal())
    assert isinstance(found, Goal) and (found.x_m, found.y_m) == (1.0, -2.0)
    assert found.yaw_rad == pytest.approx(math.pi / 2.0)
    tilted = (math.sin(0.2), 0.0, 0.0, math.cos(0.2)), (0.0, math.sin(0.4), 0.0, math.cos(0.4))
    assert isinstance(goal_of(goal(q=tilted[0])), Goal)  # rolled about its own axis: the heading is the same
    for bad, said in (
        (goal(frame="odom"), "'odom'"), (goal(x=math.nan), "nowhere"), (goal(x=1e9), "nowhere"),
        (goal(q=(0.0, 0.0, 0.0, 0.0)), "heading"), (goal(q=tilted[1]), "heading"), (goal(q=(math.nan,) * 4), "heading"),
    ):  # fmt: skip
        assert said in goal_of(bad)
    here = ros2_types.PoseWithCovarianceStamped(goal().header, ros2_types.PoseWithCovariance(goal().pose, [0.0] * 36))
    assert place_of(here) == Place((1.0, -2.0, 0.0), found.yaw_rad)
    read_elsewhere(here, "geometry_msgs/msg/PoseWithCovarianceStamped")
    read_elsewhere(twist(0.1, 0.2), "geometry_msgs/msg/Twist")
    assert "no number" in steer_of(twist(math.inf, 0.0))
    read = read_elsewhere(goal(), "geometry_msgs/msg/PoseStamped")
    assert (read.header.frame_id, read.pose.position.y) == ("map", -2.0)
    orders, other = Ros2Orders(_DOMAIN + 92), DomainParticipant(_DOMAIN + 92)
    goals, twists = (
        DataWriter(other, Topic(other, f"rt/{topic}", kind, qos=ros2_node.QOS), qos=ros2_node.QOS)
        for topic, kind in (("goal_pose", ros2_types.PoseStamped), ("cmd_vel", ros2_types.Twist))
    )
    try:
        heard: list = []

        def hears(*wanted: Goal | Steer) -> bool:
            heard.extend(filter(None, [orders.take()]))
            return all(order in heard for order in wanted)

        def burst() -> bool:  # what is written before both know each other is lost
            goals.write(goal())
            for k in range(50):
                twists.write(twist(0.1 * k, 0.2))
            return hears(found, Steer(0.1 * 49, 0.2))

        wait_for(burst)
        for writer, left, then, order in (
            (goals, goal(), goal(x=7.0), goal_of(goal(x=7.0))),
            (twists, twist(0.0, 0.0), twist(-1.0, 0.0), Steer(-1.0, 0.0)),
        ):
            writer.dispose(left)  # as one that leaves does: no message
            writer.write(then)  # soon after another one, and not lost
            wait_for(partial(hears, order))
    finally:
        orders.close()


class Wheels:
    """Satisfies what `Steering` needs of orders, and reads the wheels' commands."""

    def __init__(self, *orders: object) -> None:
        self.orders = list(orders)

    def take(self) -> object:
        return self.orders.pop(0) if self.orders else None

    def close(self) -> None:
        """Nothing is held."""


def test_an_armed_cart_obeys_within_its_limits_and_only_by_a_good_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"vislam-test-{uuid.uuid4().hex[:8]}"
    armed = steering.Armed((Goal(1.0, 0.0, 0.0),), Limits(0.5, 0.7), True, name)
    notes: list[dict] = []
    guesses: list[np.ndarray] = []
    live = LiveConfig(name=name, base_offset_m=(0.1, 0.0, 0.0))
    wheels = steering.Steering(armed, live, lambda **values: notes.append(values), guesses.append)
    reader, now = CommandReader(name), [10**9]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])

    def commanded(order: object = None, **changes: object) -> tuple[float, float]:
        wheels._orders = Wheels(order) if order is not None else None
        now[0] += 20_000_000
        pose = known_pose(t_ns=now[0], T_odom_base=np.eye(4), T_map_odom=np.eye(4), **({"health": WELL} | changes))
        wheels.send(pose)
        return reader.newest(now[0] * 1e-9)

    try:
        assert commanded() == (0.0, 0.0)  # there is no map
        wheels.see(room())
        assert commanded()[0] > 0.0
        assert commanded(Steer(9.0, -9.0)) == (0.5, -0.7)
        assert notes[-1]["arrivals"][0].reason == "something else was asked for"
        assert commanded(health=WELL | Health.INVALID) == (0.0, 0.0)
        assert commanded() == (0.5, -0.7)
        now[0] += 300_000_000
        assert commanded() == (0.0, 0.0)  # not repeated
        assert commanded(Goal(0.9, 0.0, 0.0))[0] > 0.0
        assert not notes[-1]["is_over"]
        assert commanded(Place((2.0, 1.0, 0.0), math.pi / 2.0))[0] > 0.0  # it says where the base is, and moves nothing
        np.testing.assert_allclose(guesses[0][:3, 3], [2.0, 0.9, 0.0], atol=1e-9)
        assert len(guesses) == 1
    finally:
        wheels.close()
    assert not Path(f"/dev/shm/{name}").exists()


def test_the_process_that_drives_commands_wheels_by_what_is_published() -> None:
    live = LiveConfig(name=f"vislam-test-{uuid.uuid4().hex[:8]}", bridge_rate_hz=1000.0)
    armed = steering.Armed((Goal(1.2, 0.0, 0.0),), Limits(), True, f"{live.name}-command")
    beside = Beside("drive", lambda maps: partial(steering.run, armed=armed, live=live, maps=maps, guesses=maps))
    reader, commands = CommandReader(armed.command_name), list[tuple[float, float]]()

    def enough() -> bool:
        commands.append(reader.newest(0.0))
        return commands[-1][0] > 0.0

    try:
        beside.maps.put(room())
        at = steering.listening_at(live)
        publisher_pose = partial(known_pose, T_map_odom=np.eye(4), T_odom_base=np.eye(4), health=WELL)
        publish_until(live.name, at, None, enough, publisher_pose)
    finally:
        assert beside.end() == 0
    assert commands[0] == (0.0, 0.0)
