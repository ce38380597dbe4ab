"""Readings on their way to filter and graph: what waits, what begins a sensor, what goes with which keyframe."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.config import ImuConfig, MachineConfig
from vislam.core.geometry import transform
from vislam.core.messages import ImuSample, KeyframePacket, NavState, no_observations
from vislam.core.readings import OwnStart, Reading
from vislam.imu import ImuBuffer
from vislam.pipeline import reading_intake as intake_module
from vislam.pipeline.reading_intake import ReadingIntake
from vislam.sensors import Begun, BodyState, Sensor, Suite, Variable
from vislam.sensors.body import between_keyframes
from worlds.parts import GRAVITY_M_S2, bare_keyframe, derivative, ideal_imu

MS = 10**6
NEEDED = 3  # readings that `Offset` begins with
SPOILT, ENDED = -1.0, -2.0  # values at which `Fragile` fails, and ends the program


class Plain(Sensor):
    """Has nothing of its own."""

    columns = ("x_m",)
    touches = ("position",)

    def residual(self, values, body, own):
        return values - body.position_m[:1]

    def noise(self, values):
        return np.eye(1)

    def check(self, values):
        return "" if values[0] >= 0.0 else "x is below zero"


class Offset(Plain):
    """Begins with its first few readings, at their mean offset."""

    variables = (Variable("offset_m", 10.0),)

    def begin(self, readings, bodies):
        if len(readings) < NEEDED:
            return None
        offsets = [r.values[0] - b.position_m[0] for r, b in zip(readings, bodies, strict=True)]
        return Begun(np.array([np.mean(offsets)]), np.array([0.1]))


class Fragile(Plain):
    """Its check fails at some values."""

    def check(self, values):
        if values[0] == SPOILT:
            raise KeyError("nobody thought of that")
        if values[0] == ENDED:
            sys.exit(3)
        return ""


class Derived(Plain):
    """Gives its own derivative, `factor` times what it is."""

    def __init__(self, factor: float) -> None:
        self._factor = factor

    def jacobians(self, values, body, own):
        H = np.zeros((1, 15))
        H[0, 3] = self._factor
        return H, np.zeros((1, 0))


class Broken(Offset):
    """Its begin fails, or says what cannot be."""

    def __init__(self, begun: Begun | None = None) -> None:
        self._begun = begun

    def begin(self, readings, bodies):
        if self._begun is None:
            raise ZeroDivisionError("no two places")
        return self._begun


class FakeFiltering:
    """Remembers what it was told; knows the body up to a time."""

    def __init__(self, known_from_ns: int = 0) -> None:
        self.told: list[tuple[int, Reading | OwnStart]] = []
        self._known_from_ns = known_from_ns
        self.ekf = SimpleNamespace(body_at=self._body_at, initialised=True, own=lambda name: (np.zeros(1), np.ones(1)))

    def add_reading(self, reading: Reading) -> None:
        self.told.append((reading.t_ns, reading))

    def begin_sensor(self, t_ns: int, start: OwnStart) -> None:
        self.told.append((t_ns, start))

    def _body_at(self, t_ns: int) -> BodyState | None:
        none = np.zeros(3)
        return None if t_ns < self._known_from_ns else BodyState(t_ns, np.eye(3), none, none, none, none, none)


def reading(sensor: str, t_ms: float, x_m: float = 1.0) -> Reading:
    return Reading(sensor, round(t_ms * MS), np.array([x_m]))


def packet(t_ms: float, k: int = 1) -> KeyframePacket:
    return KeyframePacket(bare_keyframe(k, round(t_ms * MS)), None, no_observations(), None)


def stamps_ms(told: list[tuple[int, Reading | OwnStart]], kind: type = Reading) -> list[float]:
    return [t_ns / MS for t_ns, what in told if isinstance(what, kind)]


def intake_of(sensors: dict[str, Sensor], filtering: FakeFiltering | None = None) -> ReadingIntake:
    return ReadingIntake(Suite(sensors), filtering, None, GRAVITY_M_S2)


# ---- on the way to the filter


def test_readings_wait_until_somebody_knows_the_body_then():
    filtering = FakeFiltering()
    intake = intake_of({"plain": Plain()}, filtering)
    for t_ms in (10, 20, 30):
        intake.add(reading("plain", t_ms))
    assert filtering.told == []
    intake.hand_on(20 * MS)
    assert stamps_ms(filtering.told) == [10, 20]
    intake.hand_on(40 * MS)
    assert stamps_ms(filtering.told) == [10, 20, 30]


def test_own_variables_begin_once_the_sensor_knows_them_and_no_reading_counts_twice():
    filtering = FakeFiltering()
    intake = intake_of({"offset": Offset()}, filtering)
    for k in range(6):
        intake.add(reading("offset", 10 * k, 2.0 + 0.1 * k))
        intake.hand_on(10 * k * MS)
    ((start_ns, start),) = [(t_ns, what) for t_ns, what in filtering.told if isinstance(what, OwnStart)]
    assert start.values == pytest.approx([2.1])
    assert start_ns == 20 * MS + 1  # the filter uses readings of a start's stamp, and that of 20 ms is in the start
    assert stamps_ms(filtering.told) == [30, 40, 50]
    packed = intake.pack(packet(50), 0, None)
    assert [one.reading.t_ns / MS for one in packed.readings] == [30, 40, 50]
    assert [start.sensor for start in packed.own_starts] == ["offset"]
    assert intake.pack(packet(60, 2), 50 * MS, None).own_starts == ()


def test_a_start_from_readings_in_disorder_is_after_the_newest_of_them():
    filtering = FakeFiltering()
    intake = intake_of({"offset": Offset()}, filtering)
    for t_ms in (10, 30, 20):
        intake.add(reading("offset", t_ms))
    intake.hand_on(40 * MS)
    assert [t_ns for t_ns, _ in filtering.told] == [30 * MS + 1]


def test_readings_from_before_the_filter_are_counted_and_begin_nothing():
    filtering = FakeFiltering(known_from_ns=25 * MS)
    intake = intake_of({"offset": Offset()}, filtering)
    for k in range(1, 6):
        intake.add(reading("offset", 10 * k))
    intake.hand_on(60 * MS)
    assert intake.counters["offset"]["too_early"] == 2
    assert stamps_ms(filtering.told, OwnStart) == [50 + 1e-6]
    assert intake.report()["offset"]["begun"]


def test_unusable_readings_are_counted_with_a_note_of_the_first():
    filtering = FakeFiltering()
    intake = intake_of({"plain": Plain()}, filtering)
    bad = [reading("plain", 10, -2.0), reading("plain", 20, np.nan), Reading("plain", 30 * MS, np.zeros(2))]
    for one in (*bad, reading("plain", 40), reading("nobody", 50)):
        intake.add(one)
    intake.hand_on(60 * MS)
    assert stamps_ms(filtering.told) == [40]
    assert (intake.counters["plain"]["readings"], intake.counters["plain"]["unusable"]) == (4, 3)
    assert intake.report()["plain"]["note"] == f"x is below zero (at {10 * MS} ns)"
    assert "there is plain" in intake.notes["nobody"]


def test_a_check_that_raises_costs_that_reading_only():
    filtering = FakeFiltering()
    intake = intake_of({"fragile": Fragile(), "plain": Plain()}, filtering)
    for one in (reading("fragile", 10, SPOILT), reading("fragile", 20), reading("plain", 20)):
        intake.add(one)
    intake.add(reading("fragile", 30, ENDED))
    intake.hand_on(60 * MS)
    assert [what.sensor for _, what in filtering.told] == ["fragile", "plain"]
    assert intake.counters["fragile"]["unusable"] == 2
    assert "KeyError" in intake.notes["fragile"]
    assert "plain" not in intake.notes


@pytest.mark.parametrize(
    ("begun", "why"),
    [
        (None, "ZeroDivisionError: no two places"),
        (Begun(np.zeros(2), np.ones(2)), "(2,) values"),
        (Begun(np.array([np.nan]), np.ones(1)), "not finite"),
        (Begun(np.zeros(1), -np.ones(1)), "at least 0"),
    ],
)
def test_a_sensor_that_cannot_begin_is_left_out_alone_and_named(begun, why):
    filtering = FakeFiltering()
    intake = intake_of({"broken": Broken(begun), "plain": Plain()}, filtering)
    for k in range(4):
        intake.add(reading("broken", 10 * k))
        intake.add(reading("plain", 10 * k))
        if k == 1:
            intake.hand_on(10 * MS)
    intake.hand_on(40 * MS)
    assert stamps_ms(filtering.told) == [0, 10, 20, 30]
    assert all(what.sensor == "plain" for _, what in filtering.told)
    report = intake.report()
    assert why in report["broken"]["note"]
    assert not report["broken"]["begun"]
    assert intake.counters["broken"]["unusable"] == 3  # all but the one with which it failed
    assert "note" not in report["plain"]


@pytest.mark.parametrize("factor", [1.0, 1.05, -1.0, 0.0, 2.0])
def test_a_sensor_whose_jacobians_are_wrong_is_left_out_and_named(factor):
    filtering = FakeFiltering()
    intake = intake_of({"derived": Derived(factor)}, filtering)
    for k in range(10):
        intake.add(reading("derived", 10 * k))
    intake.hand_on(100 * MS)
    is_right = abs(factor - 1.0) < 0.1
    assert len(filtering.told) == (10 if is_right else 0)
    assert intake.counters["derived"]["unusable"] == (0 if is_right else 10)
    assert ("not those of its residual: position" in intake.report()["derived"].get("note", "")) != is_right


def test_a_residual_that_ends_the_program_beside_its_point_does_not_end_the_run(monkeypatch):
    filtering, ends = FakeFiltering(), lambda _, values, body, own: sys.exit(3) if body.position_m.any() else values
    monkeypatch.setattr(Derived, "residual", ends, raising=False)
    intake = intake_of({"derived": Derived(1.0)}, filtering)
    intake.add(reading("derived", 10))
    intake.hand_on(100 * MS)
    assert stamps_ms(filtering.told) == [10]


def test_queues_are_bounded_and_what_leaves_them_is_counted(monkeypatch):
    monkeypatch.setattr(intake_module, "_MAX_WAITING", 5)
    monkeypatch.setattr(intake_module, "_MAX_SINCE", 4)
    monkeypatch.setattr(intake_module, "_MAX_TRIED", 2)
    filtering = FakeFiltering()
    intake = intake_of({"plain": Plain(), "offset": Offset()}, filtering)
    for k in range(8):
        intake.add(reading("plain", 10 * k))
    assert intake.counters["plain"]["dropped"] == 3
    intake.hand_on(100 * MS)
    assert stamps_ms(filtering.told) == [30, 40, 50, 60, 70]
    assert intake.counters["plain"]["crowded"] == 1  # the graph has room for four
    assert len(intake.pack(packet(100), 0, None).readings) == 4
    for k in range(50):
        intake.add(reading("offset", 10 * k))
        intake.hand_on(10 * k * MS)
    assert stamps_ms(filtering.told, OwnStart) == []  # two readings are never the three that it needs


# ---- with a keyframe


def place(t):
    return np.stack([2.0 * np.sin(0.7 * t), 1.5 * np.cos(0.5 * t), 0.3 * np.sin(1.1 * t)], axis=-1)


def attitude(t):
    t = np.atleast_1d(t)
    return Rotation.from_euler("ZYX", np.stack([0.8 * np.sin(0.6 * t), 0.2 * np.sin(t), 0.1 * np.cos(t)], axis=-1))


def pose(t_s: float):
    return transform(attitude(t_s).as_matrix()[0], place(np.array([t_s]))[0])


def true_buffer(length_s: float) -> ImuBuffer:
    """Exact samples at 200 Hz from 0 s on."""
    buffer = ImuBuffer(ImuConfig(), MachineConfig())
    for k in range(round(200 * length_s) + 1):
        gyro, accel = ideal_imu(place, attitude, np.array([k / 200.0]))
        assert buffer.add(ImuSample(k * 5 * MS, gyro[0], accel[0]))
    return buffer


def still_state(t_ms: float) -> NavState:
    return NavState(round(t_ms * MS), np.eye(4), *[np.zeros(3)] * 3, 1e-6 * np.eye(15))


@pytest.fixture(scope="module")
def buffer() -> ImuBuffer:
    return true_buffer(2.0)


def test_a_keyframe_has_exactly_the_readings_since_the_one_before(buffer):
    intake = ReadingIntake(Suite({"plain": Plain()}), None, buffer, GRAVITY_M_S2)
    for t_ms in range(0, 2000, 130):
        intake.add(reading("plain", t_ms))
    intake.hand_on(2000 * MS)
    first = intake.pack(packet(520), 0, still_state(520))  # at 520 ms there is a reading
    second = intake.pack(packet(1100, 2), 520 * MS, still_state(1100))
    assert [one.reading.t_ns // MS for one in first.readings] == [130, 260, 390, 520]
    assert [one.reading.t_ns // MS for one in second.readings] == [650, 780, 910, 1040]
    assert intake.counters["plain"]["late"] == 1  # that of 0 ms, which no keyframe comes before


def test_stations_say_where_on_the_true_path_a_reading_was_taken(buffer):
    """To a millimetre, though the keyframes are a second apart."""
    intake = ReadingIntake(Suite({"plain": Plain()}), None, buffer, GRAVITY_M_S2)
    at_ms = [300.0005, 300.01, 301, 302.7, 505, 777.7, 1000.1, 1299, 1300]
    for t_ms in at_ms:
        intake.add(reading("plain", t_ms))
    intake.hand_on(2000 * MS)
    packed = intake.pack(packet(1300), 300 * MS, still_state(1300))
    assert len(packed.readings) == len(at_ms)
    for one in packed.readings:
        t_s = one.reading.t_ns * 1e-9
        body = between_keyframes(pose(0.3), pose(1.3), one.reading.t_ns, one.station)
        velocity = derivative(place, np.array([t_s]), 1e-3)[0]
        turned = Rotation.from_matrix(body.R_world_body.T @ pose(t_s)[:3, :3]).magnitude()
        assert np.linalg.norm(body.position_m - pose(t_s)[:3, 3]) < 1e-3
        assert np.linalg.norm(body.velocity_m_s - velocity) < 2e-3
        assert turned < 1e-3
        assert one.station.length_s == pytest.approx(1.0)


def test_a_late_reading_still_goes_to_the_filter_and_to_the_keyframe_that_it_is_in_time_for(buffer):
    filtering = FakeFiltering()
    intake = ReadingIntake(Suite({"plain": Plain()}), filtering, buffer, GRAVITY_M_S2)
    intake.add(reading("plain", 600))
    intake.hand_on(1000 * MS)
    intake.pack(packet(800), 300 * MS, still_state(800))
    for t_ms in (700, 900, 850):
        intake.add(reading("plain", t_ms))
    intake.hand_on(1000 * MS)
    assert stamps_ms(filtering.told) == [600, 700, 900, 850]
    packed = intake.pack(packet(1000, 2), 800 * MS, still_state(1000))
    assert sorted(one.reading.t_ns // MS for one in packed.readings) == [850, 900]
    assert intake.counters["plain"]["late"] == 1


def test_readings_where_inertial_data_are_missing_are_counted_and_left_out(buffer):
    intake = ReadingIntake(Suite({"plain": Plain()}), None, buffer, GRAVITY_M_S2)
    intake.add(reading("plain", 2100))
    intake.hand_on(3000 * MS)
    assert intake.pack(packet(2500), 1900 * MS, still_state(2500)).readings == ()
    assert intake.counters["plain"]["unplaced"] == 1


def test_without_an_imu_the_path_of_vision_begins_sensors_and_carries_their_readings():
    intake = intake_of({"offset": Offset()})
    for k in range(10):
        x_m = 0.1 * k
        intake.add(reading("offset", 100 * k, x_m + 5.0))
        intake.see(100 * k * MS, transform(np.eye(3), np.array([x_m, 0.0, 0.0])))
    packed = intake.pack(packet(900), 0, None)
    (start,) = packed.own_starts
    assert start.values == pytest.approx([5.0])
    assert packed.readings
    assert packed.readings[-1].reading.t_ns == 900 * MS
    ends = transform(np.eye(3), np.zeros(3)), transform(np.eye(3), np.array([0.9, 0.0, 0.0]))
    for one in packed.readings:
        body = between_keyframes(*ends, one.reading.t_ns, one.station)
        assert body.position_m[0] == pytest.approx(one.reading.values[0] - 5.0)
    report = intake.report()["offset"]
    assert report == {"begun": True, "variables": ["offset_m"], "queued": 0, "since_keyframe": 0}
