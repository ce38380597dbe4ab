"""A session remembers what other sensors said, so that a graph is built again with the same factors."""

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from session_entries import editing, start_facts
from vislam.config import GraphConfig, WindowConfig
from vislam.core.errors import DataError
from vislam.core.memory import KeyframeEntry
from vislam.core.messages import Array, KeyframePacket
from vislam.core.readings import OwnStart
from vislam.graph import PoseGraph
from vislam.runs.session import Session, SessionWriter, recall
from vislam.sensors import Suite
from worlds.fake_window import FakeWindow
from worlds.lap import RIG, World
from worlds.parts import GRAVITY_M_S2, MACHINE
from worlds.sensed import Fixes, Speed, reading_at, with_readings

LOOSE = GraphConfig(coupling="loose")
TIGHT = GraphConfig(coupling="tight")
SENSORS = {"fixes": Fixes(0.05), "speed": Speed()}
OWN = {"fixes": np.array([0.1, 0.0, -0.05, 2.0, 30.0, -20.0, 5.0]), "speed": np.array([1.05, 0.1])}
STARTS = (
    OwnStart("fixes", OWN["fixes"] + 0.1, np.array([0.1, 0.1, 0.1, 0.1, 1.0, 1.0, 1.0])),
    OwnStart("speed", np.array([1.0, 0.0]), np.array([0.1, 0.1])),
)


def packets_of(world: World, imu: bool = True) -> list[KeyframePacket]:
    rng = np.random.default_rng(world.seed)
    out = [world.packet(0, imu=imu)]
    for k in range(1, world.count):
        said = [reading_at(world, name, sensor, OWN[name], k, 0.3, rng, imu) for name, sensor in SENSORS.items()]
        told = replace(said[0], reading=replace(said[0].reading, covariance=0.01 * np.eye(3)))
        out.append(with_readings(world.packet(k, imu=imu), said[1], told, starts=STARTS if k == 3 else ()))
    return out


def graph_of(world: World, config: GraphConfig, imu: bool, suite: Suite | None) -> PoseGraph:
    graph = PoseGraph(config, world.noise if imu else None, MACHINE, RIG, WindowConfig(), suite)
    graph.initialise(world.initial_state() if imu else None, None if imu else world.truth[0])
    return graph


def feed(graph: PoseGraph, world: World, packets: list[KeyframePacket], writer: SessionWriter | None = None) -> None:
    for packet in packets:
        k = packet.keyframe.id
        update = graph.add(packet, [], world.truth[k])
        if writer is not None:
            start = start_facts(world.initial_state(), world.noise) if packets[-1].imu is not None else None
            writer.add(KeyframeEntry(packet, world.truth[k], update, graph.take_record(), start=start))


def stored(path: Path, world: World, config: GraphConfig = LOOSE, imu: bool = True, end: int = 40) -> PoseGraph:
    writer = SessionWriter.create(path, {}, RIG, world.noise if imu else None, GRAVITY_M_S2)
    graph = graph_of(world, config, imu, Suite(SENSORS))
    feed(graph, world, packets_of(world, imu)[:end], writer)
    writer.close()
    return graph


def flat(packet: KeyframePacket) -> list[Array | float | int | str | None]:
    """Return what a packet says of other sensors, number by number."""
    out: list[Array | float | int | str | None] = []
    for placed in packet.readings:
        out += [getattr(placed.reading, f.name) for f in fields(placed.reading)]
        out += [getattr(placed.station, f.name) for f in fields(placed.station)]
    return out + [part for start in packet.own_starts for part in start]


@pytest.mark.parametrize("light", [True, False])
def test_every_bit_of_what_sensors_said_is_read_again(light: bool, tmp_path) -> None:
    world = World(4.0, seed=1)
    stored(tmp_path / "session.db", world, end=world.count)
    read = Session(tmp_path / "session.db").packets(light=light)
    for packet, again in zip(packets_of(World(4.0, seed=1)), read, strict=True):
        assert len(packet.readings) == len(again.readings)
        for a, b in zip(flat(packet), flat(again), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("config", "imu"), [(LOOSE, True), (LOOSE, False), (TIGHT, True)])
def test_a_graph_with_readings_is_built_again_and_ends_where_it_would_have(
    config: GraphConfig, imu: bool, tmp_path, monkeypatch
) -> None:
    world = World(14.0, seed=2)
    monkeypatch.setattr("vislam.window.SlidingWindow", lambda *_: FakeWindow(world, imu=imu), raising=False)
    old = stored(tmp_path / "session.db", world, config, imu, end=50)
    memory = recall(Session(tmp_path / "session.db"))
    assert memory is not None
    new = graph_of(world, config, imu, Suite(SENSORS))
    new.restore(memory.graph)
    assert new.readings.counts == old.readings.counts
    np.testing.assert_allclose(new.poses(), old.poses(), atol=5e-3)
    for name in SENSORS:
        before, after = old.own(name), new.own(name)
        assert before is not None and after is not None
        assert (np.abs(after[0] - before[0]) < 0.5 * before[1]).all()
    packets = packets_of(World(14.0, seed=2), imu)
    if config is TIGHT:
        new.go_on(replace(packets[49], imu=None), world.truth[49])
    for graph in (old, new):
        feed(graph, world, packets[50:])
        graph.finish()
    np.testing.assert_allclose(new.poses(), old.poses(), atol=1e-3 if config is LOOSE else 0.05)


def test_readings_of_a_sensor_that_is_no_more_are_left_out_and_counted(tmp_path) -> None:
    world = World(4.0, seed=3)
    stored(tmp_path / "session.db", world, end=20)
    memory = recall(Session(tmp_path / "session.db"))
    assert memory is not None
    graph = graph_of(world, LOOSE, True, Suite({"speed": Speed()}))
    graph.restore(memory.graph)
    assert graph.readings.counts["unknown"] == 19 and graph.readings.counts["used"] == 17
    assert graph.own("fixes") is None and graph.own("speed") is not None


def without_readings(path: Path) -> None:
    """Turn a session into one of format 8, which knew nothing of other sensors."""
    with closing(sqlite3.connect(path)) as db:
        db.execute("DROP TABLE readings")
        db.execute("DROP TABLE own_starts")
        db.execute("DROP TABLE labels")
        db.execute("DROP TABLE motions")
        db.execute("DROP TABLE further")
        db.execute("PRAGMA user_version=8")


def test_a_session_of_the_format_before_is_read_and_gone_on_with(tmp_path) -> None:
    world, path = World(4.0, seed=4), tmp_path / "session.db"
    writer = SessionWriter.create(path, {}, RIG, world.noise, GRAVITY_M_S2)
    packets = [world.packet(k) for k in range(world.count)]
    graph = graph_of(world, LOOSE, True, None)
    feed(graph, world, packets[:10], writer)
    writer.close()
    without_readings(path)
    session = Session(path)
    memory = recall(session)
    assert memory is not None and memory.graph.own == ()
    assert not any(packet.readings for packet in session.packets())
    session.close()
    writer = SessionWriter.reopen(path)
    sensed = packets_of(World(4.0, seed=4))[10]
    update = graph.add(sensed, [], world.truth[10])
    writer.add(KeyframeEntry(sensed, world.truth[10], update, graph.take_record()))
    writer.close()
    assert [len(packet.readings) for packet in Session(path).packets()] == [0] * 10 + [2]


def test_a_session_that_lacks_a_table_of_its_format_is_refused(tmp_path) -> None:
    stored(tmp_path / "session.db", World(4.0, seed=5), end=5)
    with closing(sqlite3.connect(tmp_path / "session.db")) as db:
        db.execute("DROP TABLE own_starts")
        db.execute("DROP TABLE labels")
    with pytest.raises(DataError, match="other tables"):
        Session(tmp_path / "session.db")


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "session.db"
    stored(path, World(4.0, seed=6), end=6)
    return path


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE readings SET station = x'00' WHERE id = 3",
        "UPDATE readings SET station = zeroblob(320) WHERE id = 3",
        "UPDATE readings SET numbers = zeroblob(100000) WHERE id = 3",
        "UPDATE readings SET numbers = x'000000000000f87f' WHERE id = 3",
        "UPDATE readings SET covariance = zeroblob(40) WHERE id = 3",
        "UPDATE readings SET covariance = zeroblob(33554432) WHERE id = 3",
        "UPDATE readings SET sensor = '' WHERE id = 3",
        "UPDATE readings SET sensor = x'00' WHERE id = 3",
        "UPDATE readings SET t_ns = 'noon' WHERE id = 3",
        "UPDATE readings SET id = 1000 WHERE id = 3",
        "UPDATE own_starts SET id = -1",
        "UPDATE own_starts SET sigmas = zeroblob(8)",
        "UPDATE own_starts SET numbers = zeroblob(9)",
        """UPDATE newest SET value = replace(value, '"values": [', '"values": ["much", ')""",
        """UPDATE newest SET value = replace(value, '"values": [', '"values": [NaN, ')""",
        """UPDATE newest SET value = replace(value, '"sensor": "fixes"', '"sensor": 7')""",
    ],
)
def test_what_makes_no_sense_of_other_sensors_is_damage(statement: str, sound: Path, tmp_path) -> None:
    world, path = World(4.0, seed=6), tmp_path / "session.db"
    shutil.copy(sound, path)
    with editing(path) as db:
        assert db.execute(statement).rowcount > 0
    restore: Callable[[], object] = lambda: graph_of(world, LOOSE, True, Suite(SENSORS)).restore(  # noqa: E731
        recall(Session(path)).graph
    )
    with pytest.raises(DataError):
        restore()
