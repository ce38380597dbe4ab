"""Readings of other sensors in the pose graph: what they bend, how sure it is of that, and what cannot harm it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from vislam.config import GraphConfig, WindowConfig
from vislam.core.errors import DataError
from vislam.core.geometry import se3_exp
from vislam.core.messages import Array, KeyframePacket, LoopEdge
from vislam.core.readings import OwnStart, Reading
from vislam.factors.keys import X, own_key
from vislam.factors.reading_factor import ReadingFactor, system_of
from vislam.graph import PoseGraph
from vislam.sensors import BodyState, Sensor, Suite
from worlds.fake_window import FakeWindow
from worlds.lap import RIG, World, rmse_m
from worlds.parts import MACHINE
from worlds.sensed import Fixes, Range, Speed, pose_error, reading_at, station_at, with_readings
from worlds.solvers import WatchedSolvers, poses_in

LOOSE = GraphConfig(coupling="loose", vo_inflation=1.0, vo_floor_deg=0.0, vo_floor_m=0.0)
TIGHT = GraphConfig(
    coupling="tight", window_inflation=1.0, window_floor_deg=0.0, window_floor_m=0.0, tilt_floor_deg=0.0
)
FIX_SIGMAS = np.array([0.1, 0.1, 0.1, 0.1, 1.0, 1.0, 1.0])  # of the first guess of what a fix needs
PLACES = {
    name: np.array(place)
    for name, place in {"east": (6.0, 1.0, 1.5), "west": (-6.0, 0.5, -1.0), "north": (0.5, 5.0, 2.0)}.items()
}


def a_world(seed: int, duration_s: float = 24.0, keyframe_hz: float = 5.0) -> World:
    return World(duration_s, keyframe_hz, seed=seed, vo_sigma_rad=np.deg2rad(0.5), vo_sigma_m=0.02)


def drawn_fix(rng: np.random.Generator) -> tuple[Array, OwnStart]:
    """Return what is true of a frame of fixes, and what a start says of it."""
    own = np.concatenate([0.1 * rng.normal(size=3), rng.uniform(-3, 3, 1), 100.0 * rng.normal(size=3)])
    return own, OwnStart("fixes", own + FIX_SIGMAS * rng.normal(size=7), FIX_SIGMAS)


class Drive:
    """A graph of one world with sensors of known truth."""

    def __init__(
        self, world: World, sensors: dict[str, Sensor], own: dict[str, Array], imu: bool = True,
        config: GraphConfig = LOOSE,
    ) -> None:  # fmt: skip
        self.world, self.sensors, self.own, self.imu = world, sensors, own, imu
        self.rng = np.random.default_rng(world.seed + 1000)
        self.packets: list[KeyframePacket] = []
        self.graph = PoseGraph(config, world.noise if imu else None, MACHINE, RIG, WindowConfig(), Suite(sensors))
        self.graph.initialise(world.initial_state() if imu else None, None if imu else world.truth[0])

    def packet(self, k: int, starts: tuple[OwnStart, ...] = (), share: float = 0.4) -> KeyframePacket:
        """Return a keyframe with a reading of each sensor; `starts` come with the second one."""
        packet = self.world.packet(k, imu=self.imu)
        if k == 0:
            return packet
        readings = [
            reading_at(self.world, name, sensor, self.own[name], k, share, self.rng, self.imu)
            for name, sensor in self.sensors.items()
        ]
        return with_readings(packet, *readings, starts=starts if k == 2 else ())

    def run(
        self, starts: tuple[OwnStart, ...] = (), spoil: Callable[[KeyframePacket], KeyframePacket] = lambda p: p,
        end: int | None = None, loops: Callable[[int], list[LoopEdge]] = lambda k: [],
    ) -> Drive:  # fmt: skip
        for k in range(len(self.packets), self.world.count if end is None else end):
            self.packets.append(spoil(self.packet(k, starts)))
            update = self.graph.add(self.packets[-1], loops(k))
            assert "gtsam failed" not in update.note
        return self

    def error_m(self) -> float:
        return rmse_m(self.graph.poses(), self.world.truth[: len(self.packets)])

    def odometry_m(self) -> float:
        return rmse_m(self.world.dead_reckoning(self.packets), self.world.truth)

    def nees(self) -> tuple[float, float]:
        """Return the mean squared error in sigmas, per degree of freedom, of poses and of own variables."""
        states = self.graph.states()
        poses = []
        for k in range(10, self.world.count, 10):
            error = pose_error(self.world.truth[k], states[k].T_world_body)
            poses.append(error @ np.linalg.solve(states[k].covariance[:6, :6], error) / 6.0)
        own = []
        for name, truth in self.own.items():
            values, sigmas = told(self.graph, name)
            own.append(np.mean(((values - truth) / sigmas) ** 2))
        return float(np.mean(poses)), float(np.mean(own))


def told(graph: PoseGraph, name: str) -> tuple[Array, Array]:
    own = graph.own(name)
    assert own is not None
    return own


@pytest.fixture
def fake_window(monkeypatch: pytest.MonkeyPatch) -> Callable[[World], None]:
    def take(world: World) -> None:
        monkeypatch.setattr("vislam.window.SlidingWindow", lambda *_: FakeWindow(world), raising=False)

    return take


def test_pose_and_own_variables_are_told_together(monkeypatch: pytest.MonkeyPatch) -> None:
    watched, errors = WatchedSolvers(monkeypatch), []
    for seed in range(3):
        truth, start = drawn_fix(np.random.default_rng(seed))
        drive = Drive(a_world(seed, 24.0, 2.5), {"fixes": Fixes(0.05)}, {"fixes": truth}, True, LOOSE).run((start,))
        graph, own = drive.graph, told(drive.graph, "fixes")
        assert graph.joint_covariance(0, "nothing") is None
        with pytest.raises(IndexError, match=f"the graph has {len(drive.packets)}"):
            graph.joint_covariance(len(drive.packets), "fixes")
        for k in range(10, drive.world.count, 20):
            joint = graph.joint_covariance(k, "fixes")
            assert joint is not None
            assert joint.shape == (6 + len(truth), 6 + len(truth))
            assert joint == pytest.approx(joint.T, abs=1e-12)
            assert np.sqrt(np.diag(joint)[6:]) == pytest.approx(own[1], rel=1e-6)
            pose = watched.made[-1].joint_covariance([X(k)])
            assert joint[:6, :6] == pytest.approx(pose, rel=1e-5, abs=1e-9)
            # the frame of the fixes is the world's: pose and frame err together, and apart they are not as told
            error = np.concatenate([pose_error(drive.world.truth[k], graph.poses()[k]), truth - own[0]])
            error[3:6] = graph.poses()[k][:3, :3].T @ error[3:6]
            errors.append(error @ np.linalg.solve(joint, error) / len(error))
            assert np.abs(joint[:6, 6:]).max() > 0.1 * np.sqrt(np.diag(joint)[:6].max() * np.diag(joint)[6:].max())
    print(f"NEES of pose and own variables together: {np.mean(errors):.2f}")
    assert 0.3 < np.mean(errors) < 2.0


@pytest.mark.parametrize("kind", ["loose", "no IMU", "tight"])
def test_fixes_in_an_unknown_frame_bend_odometry_back_and_errors_are_as_told(kind: str, fake_window) -> None:
    poses, own, gain = [], [], []
    for seed in range(2):
        world = a_world(seed, 24.0, 2.5)
        fake_window(world)
        truth, start = drawn_fix(np.random.default_rng(seed))
        config = TIGHT if kind == "tight" else LOOSE
        drive = Drive(world, {"fixes": Fixes(0.05)}, {"fixes": truth}, kind != "no IMU", config)
        drive.run((start,)).graph.finish()
        nees = drive.nees()
        poses.append(nees[0])
        own.append(nees[1])
        gain.append(drive.error_m() / drive.odometry_m())
    print(f"{kind}: NEES of poses {np.mean(poses):.2f}, of own {np.mean(own):.2f}, error over odometry {gain}")
    assert np.mean(gain) < 0.5
    assert 0.25 < np.mean(poses) < 1.7
    assert 0.25 < np.mean(own) < 2.0


def test_ranges_to_places_known_to_a_metre_find_them_and_the_body() -> None:
    nees, gain = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        sensors: dict[str, Sensor] = {name: Range(place) for name, place in PLACES.items()}
        own = {name: place + rng.normal(size=3) for name, place in PLACES.items()}
        starts = tuple(OwnStart(name, place, np.ones(3)) for name, place in PLACES.items())
        drive = Drive(a_world(seed, 24.0, 2.5), sensors, own)
        drive.run(starts).graph.finish()
        nees.append(drive.nees())
        gain.append(drive.error_m() / drive.odometry_m())
    print(f"NEES {nees}, error over odometry {gain}")
    assert np.mean(gain) < 0.7
    assert 0.25 < np.mean([n[0] for n in nees]) < 1.7
    assert 0.2 < np.mean([n[1] for n in nees]) < 2.0


def test_body_speed_finds_its_scale_and_follows_an_offset_that_walks() -> None:
    nees = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        world, sensor = a_world(seed, 24.0, 2.5), Speed()
        offsets = 0.1 * rng.normal() + np.cumsum(0.02 * np.sqrt(0.4) * rng.normal(size=world.count))
        scale = 1.0 + 0.1 * rng.normal()
        drive = Drive(world, {"speed": sensor}, {"speed": np.array([scale, offsets[-1]])})
        start = OwnStart("speed", np.array([1.0, 0.0]), np.array([0.1, 0.1]))
        for k in range(world.count):
            drive.own["speed"] = np.array([scale, offsets[k]])
            drive.run((start,), end=k + 1)
        drive.graph.finish()
        nees.append(drive.nees())
        values, sigmas = told(drive.graph, "speed")
        assert sigmas[0] < 0.02 and sigmas[1] < 0.03
        assert abs(values[0] - scale) < 4.0 * sigmas[0]
    print(f"NEES {nees}")
    assert 0.25 < np.mean([n[0] for n in nees]) < 1.7
    assert np.mean([n[1] for n in nees]) < 2.5


def test_a_fix_ten_kilometres_off_moves_nothing_beyond_its_sigma() -> None:
    def wrong(packet: KeyframePacket) -> KeyframePacket:
        if packet.keyframe.id % 20 != 7:
            return packet
        reading = packet.readings[0].reading
        reading = replace(reading, values=reading.values + np.array([1e4, -2e3, 0.0]))
        return replace(packet, readings=(replace(packet.readings[0], reading=reading),))

    truth, start = drawn_fix(np.random.default_rng(5))
    runs = [Drive(a_world(5, 16.0, 2.5), {"fixes": Fixes(0.05)}, {"fixes": truth}) for _ in range(2)]
    runs[0].run((start,)).graph.finish()
    runs[1].run((start,), wrong).graph.finish()
    sigmas = [np.sqrt(np.diag(state.covariance)[3:6]) for state in runs[0].graph.states()]
    moved = np.abs(runs[0].graph.poses() - runs[1].graph.poses())[:, :3, 3]
    assert (moved[1:] < np.array(sigmas)[1:]).all()


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize(
    "sensor", [Fixes(), Speed(), Range(np.array([5.0, 4.0, 1.0]))], ids=["fixes", "speed", "range"]
)
def test_the_derivatives_of_a_factor_are_those_of_its_residual(sensor: Sensor, imu: bool) -> None:
    rng = np.random.default_rng(3)
    world = a_world(3, 4.0)
    own = np.array([variable.start for variable in sensor.variables]) + 0.3
    placed = reading_at(world, "it", sensor, own, 6, 0.4, rng, imu)
    poses = [world.truth[k] @ se3_exp(0.05 * rng.normal(size=6)) for k in (5, 6)]
    system = system_of(sensor, placed, *poses, own)
    h = 1e-6
    for n, by in enumerate((system.by_earlier, system.by_later)):
        for k, e in enumerate(np.eye(6) * h):
            change = []
            for sign in (1.0, -1.0):
                moved = [T @ se3_exp(sign * e) if m == n else T for m, T in enumerate(poses)]
                change.append(system_of(sensor, placed, *moved, own).residual)
            np.testing.assert_allclose(by[:, k], (change[0] - change[1]) / (2.0 * h), atol=2e-6)
    for k, e in enumerate(np.eye(len(own)) * h):
        change = [system_of(sensor, placed, *poses, own + sign * e).residual for sign in (1.0, -1.0)]
        np.testing.assert_allclose(system.by_own[:, k], (change[0] - change[1]) / (2.0 * h), atol=2e-6)


def test_a_factor_costs_its_robust_loss_and_sums_up_all_readings_with_what_they_share() -> None:
    world, sensor = a_world(4, 4.0), Range(np.array([5.0, 4.0, 1.0]))
    own, units = np.array([5.0, 4.0, 1.0]), np.array([1.0, 0.5, 0.25])
    placed = reading_at(world, "it", sensor, own, 6, 0.4, np.random.default_rng(4))
    readings = [
        reading_at(world, "it", sensor, own, 6, share, np.random.default_rng(4)) for share in np.linspace(0.0, 1.0, 30)
    ]
    far = replace(placed, reading=replace(placed.reading, values=placed.reading.values + 1.0))
    readings = [replace(one, station=replace(one.station, accel_sigma_m_s2=20.0)) for one in [*readings, far]]
    poses = (world.truth[5], world.truth[6])
    parts = ReadingFactor(sensor, readings, poses, own, units, lambda n: None)
    values = gtsam.Values()
    for k, T in zip((5, 6), poses, strict=True):
        values.insert(X(k), gtsam.Pose3(T))
    for n in range(3):
        values.insert(own_key(n), float(own[n] / units[n]))
    factor = parts.factor(X(5), X(6), [own_key(n) for n in range(3)])
    systems = [system_of(sensor, one, *poses, own) for one in readings]
    r = np.concatenate([s.residual for s in systems])
    shared = np.vstack([s.by_path for s in systems])  # what the path adds is no noise of each reading
    noise = np.array([s.noise[0, 0] for s in systems])
    squares = r**2 / (noise + (shared**2).sum(axis=1))
    k2 = 10.827566  # the 99.9 % point of chi-square with one degree
    assert squares[-1] > 20.0 and (shared**2).sum(axis=1).max() > 2.0 * noise[0]
    losses = k2 * np.log1p(squares / k2)
    covariance = np.diag(noise * squares / losses) + shared @ shared.T
    assert factor.error(values) == pytest.approx(0.5 * r @ np.linalg.solve(covariance, r), rel=1e-6)
    covariance = np.diag(noise * (k2 + squares) / k2) + shared @ shared.T
    J = np.vstack([np.hstack([s.by_earlier, s.by_later, s.by_own * units]) for s in systems])
    A, b = factor.linearize(values).jacobian()
    assert len(A) <= 16 < len(readings)
    np.testing.assert_allclose(A.T @ A, J.T @ np.linalg.solve(covariance, J), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(A.T @ b, -J.T @ np.linalg.solve(covariance, r), rtol=1e-6, atol=1e-6)
    assert b @ b == pytest.approx(r @ np.linalg.solve(covariance, r), rel=1e-6)


def test_without_readings_a_suite_changes_no_bit() -> None:
    def poses(suite: Suite | None) -> bytes:
        world = World(30.0, seed=2)
        graph = PoseGraph(LOOSE, world.noise, MACHINE, RIG, WindowConfig(), suite)
        graph.initialise(world.initial_state())
        for k in range(world.count):
            graph.add(world.packet(k), [world.loop(k, k - 100, k)] if k > 105 and k % 5 == 0 else [])
        graph.finish()
        return graph.poses().tobytes()

    assert poses(None) == poses(Suite({"fixes": Fixes()}))


def test_long_runs_with_loops_sum_up_only_segments_without_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    world, watched = World(70.0, seed=6), WatchedSolvers(monkeypatch)
    config = replace(LOOSE, freeze_keyframes=20, freeze_after=60, read_newest=60, read_block=40, anchor_after=5)
    truth, start = drawn_fix(np.random.default_rng(6))
    drive = Drive(world, {"fixes": Fixes(0.05)}, {"fixes": truth}, False, config)
    sensed = range(2, 160)  # the last third of the run, half of which is summed up, has none

    def some(packet: KeyframePacket) -> KeyframePacket:
        return packet if packet.keyframe.id in sensed else replace(packet, readings=())

    drive.run((start,), some, loops=lambda k: [world.loop(k, k - 100, k)] if k > 102 else [])
    left = set(range(world.count)) - poses_in(watched.made[-1])
    assert left and min(left) > max(sensed)
    before = drive.error_m()
    drive.graph.finish()
    assert before < 0.1 and drive.error_m() < 0.1
    assert np.all(np.isfinite(told(drive.graph, "fixes")[1]))


class Moody(Fixes):
    """Fixes whose code fails wherever the body is in one half of the world, once they were measured."""

    fails = False

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        if self.fails and body.position_m[0] > 0.0:
            raise RuntimeError("not here")
        return super().residual(values, body, own)


def test_a_sensor_whose_code_fails_says_nothing_where_it_does_and_is_counted() -> None:
    truth, start = drawn_fix(np.random.default_rng(7))
    sensor = Moody(0.05)
    drive = Drive(a_world(7, 24.0, 2.5), {"fixes": sensor}, {"fixes": truth})
    drive.packets = [drive.packet(k, (start,)) for k in range(drive.world.count)]
    sensor.fails = True
    for packet in drive.packets:
        drive.graph.add(packet)
    drive.graph.finish()
    counts = drive.graph.readings.counts
    assert counts["used"] == drive.world.count - 2
    assert 0.3 * counts["used"] < counts["failed"] < 0.7 * counts["used"]
    assert drive.error_m() < drive.odometry_m()


def test_what_cannot_be_used_is_left_out_and_counted() -> None:
    truth, start = drawn_fix(np.random.default_rng(8))
    world = a_world(8, 4.0)
    drive = Drive(world, {"fixes": Fixes(0.05)}, {"fixes": truth})

    def more(packet: KeyframePacket) -> KeyframePacket:
        k = packet.keyframe.id
        if k in {0, 15}:
            placed = reading_at(world, "fixes", Fixes(), truth, 3, 0.5, drive.rng)
            return replace(packet, readings=(placed,), begins_submap=k == 15)
        one = packet.readings[0]
        other = replace(one, reading=Reading("nobody", one.reading.t_ns, np.zeros(1)))
        short = replace(one, reading=replace(one.reading, values=np.zeros(2)))
        return with_readings(packet, *([one] * 13 if k == 9 else []), *([other, short] if k == 10 else []))

    drive.run((start,), more)
    assert drive.graph.readings.counts == {
        "used": world.count - 3 + 13, "early": 1, "unknown": 1, "unusable": 1,
        "dropped": 2, "failed": 0,
    }  # fmt: skip


def test_wild_readings_are_told_as_outliers_at_the_final_estimate() -> None:
    truth, start = drawn_fix(np.random.default_rng(10))
    drive = Drive(a_world(10, 12.0), {"fixes": Fixes(0.05)}, {"fixes": truth})
    wild = range(10, drive.world.count, 10)

    def leap(packet: KeyframePacket) -> KeyframePacket:
        if packet.keyframe.id not in wild:
            return packet
        (one,) = packet.readings
        far = replace(one.reading, values=one.reading.values + 50.0)
        return replace(packet, readings=(replace(one, reading=far),))

    drive.run((start,), leap).graph.finish()
    said = drive.graph.sensed("fixes")
    assert said["used"] == drive.world.count - 2
    assert len(wild) <= said["outliers"] <= len(wild) + 2
    assert drive.graph.sensed("nobody")["used"] == 0


def test_two_wandering_offsets_of_two_submaps_know_nothing_of_each_other() -> None:
    world = a_world(9, 6.0)
    drive = Drive(world, {"speed": Speed()}, {"speed": np.array([1.0, 0.05])}, imu=False)
    start = OwnStart("speed", np.array([1.0, 0.0]), np.array([0.1, 0.1]))

    def cut(packet: KeyframePacket) -> KeyframePacket:
        return replace(packet, begins_submap=packet.keyframe.id == 20)

    drive.run((start,), cut, end=20)
    known = told(drive.graph, "speed")[1][1]
    drive.run((start,), cut, end=22)
    assert told(drive.graph, "speed")[1][1] > 1.2 * known


BAD = {
    "a value that is none": lambda p: replace(p, reading=replace(p.reading, values=np.array([np.nan, 0.0, 0.0]))),
    "a time before": lambda p: replace(p, station=replace(p.station, since_s=-0.1)),
    "a time after": lambda p: replace(p, station=replace(p.station, since_s=p.station.length_s + 0.1)),
    "no time": lambda p: replace(p, station=replace(p.station, since_s=0.0, length_s=0.0)),
    "a turn that is none": lambda p: replace(p, station=replace(p.station, dR=np.eye(3) * 2.0)),
    "a path of another shape": lambda p: replace(p, station=replace(p.station, dp_m=np.zeros(2))),
    "a force that is none": lambda p: replace(p, station=replace(p.station, accel_sigma_m_s2=np.inf)),
    "a covariance that is none": lambda p: replace(p, reading=replace(p.reading, covariance=np.ones((2, 3)))),
}


@pytest.mark.parametrize("bad", BAD)
def test_a_reading_that_makes_no_sense_is_refused_and_changes_nothing(bad: str) -> None:
    truth, start = drawn_fix(np.random.default_rng(10))
    drive = Drive(a_world(10, 4.0), {"fixes": Fixes()}, {"fixes": truth}).run((start,), end=5)
    before = drive.graph.poses()
    packet = drive.packet(5)
    with pytest.raises(DataError, match=r"keyframe 5 .*fixes"):
        drive.graph.add(replace(packet, readings=(BAD[bad](packet.readings[0]),)))
    with pytest.raises(DataError, match="the start of sensor"):
        drive.graph.add(replace(packet, own_starts=(OwnStart("fixes", np.zeros(7), np.full(7, np.nan)),)))
    np.testing.assert_array_equal(drive.graph.poses(), before)
    drive.graph.add(packet)


def test_a_station_at_both_ends_of_its_keyframes_is_one() -> None:
    world = a_world(11, 2.0)
    for share in (0.0, 1.0):
        assert 0.0 <= station_at(world, 3, share).since_s <= station_at(world, 3, share).length_s
