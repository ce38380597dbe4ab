"""The doors of both filters for readings: what they refuse, what they count, and that order does not matter."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from vislam.config import EkfConfig
from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.core.readings import OwnStart, Reading
from vislam.ekf import Ekf, MsckfEkf, make_ekf
from vislam.sensors import BodyState, Sensor, Suite
from vislam.sensors.kinds.anchor_range import AnchorRange, AnchorRangeSettings
from worlds import monte_carlo as mc
from worlds.flight import MONO
from worlds.motion import T0_NS
from worlds.parts import MACHINE
from worlds.sensed_paths import KINDS, Fix, Height, SensedRun, Speed, every_sensor, made

EVERY = {"fix": 40, "height": 20, "beacon": 20, "speed": 20}


def numbers(ekf: Ekf | MsckfEkf) -> list[Array]:
    """Return copies of all that a filter estimates."""
    state, own = ekf.state(), mc.inside(ekf).own
    P = mc.inside(ekf).P if isinstance(ekf, Ekf) else mc.inside(ekf).window.P
    return [a.copy() for a in (mc.inside(ekf).x, state.covariance, P, own.values, own.covariance)]


def assert_same_bytes(before: list[Array], after: list[Array]) -> None:
    assert [a.tobytes() for a in before] == [a.tobytes() for a in after]


def assert_nothing_changed(before: list[Array], after: list[Array]) -> None:
    """State and own variables byte for byte; the tight filter carries its P to the present for every event."""
    for i in (0, 3, 4):
        assert before[i].tobytes() == after[i].tobytes()
    np.testing.assert_allclose(after[1], before[1], rtol=1e-9, atol=1e-15)


def flown(kind: str, sensors: dict[str, Sensor], duration_s: float = 2.0) -> tuple[SensedRun, Ekf | MsckfEkf]:
    run = SensedRun.make(11, duration_s, sensors, EVERY)
    return run, list(run.replay(made(kind, Suite(sensors))))[-1][1]


def changes(before: dict[str, int], ekf: Ekf | MsckfEkf) -> dict[str, int]:
    return {name: n - before.get(name, 0) for name, n in ekf.counters.items() if n != before.get(name, 0)}


@pytest.mark.parametrize("kind", KINDS)
def test_any_order_of_arrival_gives_the_same_answer(kind: str) -> None:
    """In time, late by up to 0.4 s, or all at the end: bit for bit the same state; half of the stamps between samples.

    Starts of own variables come late, too.
    """
    sensors = every_sensor()
    run = SensedRun.make(12, 3.0, sensors, EVERY)
    step_ns = int(run.way.t_ns[1] - run.way.t_ns[0])
    run.readings = [replace(r, t_ns=r.t_ns + (i % 2) * step_ns // 3) for i, r in enumerate(run.readings[:-8])]
    rng = np.random.default_rng(3)
    answers = []
    for late_s in (0.0, 0.4, 3.0):
        ekf = made(kind, Suite(sensors), **{"tight_history_s" if kind == "tight" else "history_s": 5.0})
        ekf.initialise(run.start)
        stamps = [run.start.t_ns] * len(run.starts) + [reading.t_ns for reading in run.readings]
        told = [*run.starts, *run.readings]
        arrives = np.array(stamps) + np.round(rng.uniform(0.0, late_s, len(stamps)) * 1e9).astype(np.int64)
        order = np.argsort(arrives, kind="stable").tolist()
        for k, t_ns in enumerate(run.way.t_ns.tolist()):
            ekf.predict(run.sample(k))
            while order and (arrives[order[0]] <= t_ns or k == len(run.way.t_ns) - 1):
                what = told[order.pop(0)]
                _ = ekf.update_sensor(what) if isinstance(what, Reading) else ekf.begin_sensor(run.start.t_ns, what)
        answers.append((numbers(ekf), ekf.counters, ekf.nis_statistics))
    first, counters, statistics = answers[0]
    assert sum(counters[f"{name}_accepted"] for name in sensors) > 0.97 * len(run.readings)
    for state, counts, tests in answers[1:]:
        assert_same_bytes(first, state)
        assert {name: n for name, n in counts.items() if name != "rewinds"} == {
            name: n for name, n in counters.items() if name != "rewinds"
        }
        for name, sums in statistics.items():
            assert tests[name] == pytest.approx(sums, rel=1e-9)
    assert answers[1][1]["rewinds"] > 10


@pytest.mark.parametrize("kind", KINDS)
def test_a_start_that_comes_late_makes_the_readings_after_it_count(kind: str) -> None:
    sensors = {"speed": Speed()}
    run = SensedRun.make(13, 1.0, sensors, EVERY)
    ekf = made(kind, Suite(sensors))
    ekf.initialise(run.start)
    for k in range(len(run.way.t_ns)):
        ekf.predict(run.sample(k))
    for reading in run.readings:
        result = ekf.update_sensor(reading)
        assert not result.accepted
        assert "has not begun" in result.reason
    assert ekf.counters["speed_waiting"] == len(run.readings)
    np.testing.assert_array_equal(ekf.own("speed"), [[1.0], [0.1]])
    half = run.readings[len(run.readings) // 2].t_ns
    assert ekf.begin_sensor(half - 1_000_000, run.starts[0]).accepted
    waiting = sum(reading.t_ns < half for reading in run.readings)
    assert ekf.counters["speed_waiting"] == waiting
    assert ekf.counters["speed_accepted"] == len(run.readings) - waiting
    assert ekf.own("speed")[1][0] < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_the_gate_refuses_an_outlier_and_the_state_is_untouched(kind: str) -> None:
    """Also where own variables walk: what is refused leaves no walk behind."""
    sensors: dict[str, Sensor] = {"fix": Fix(), "height": Height()}
    _, ekf = flown(kind, sensors, 1.99)
    t_ns = ekf.state().t_ns
    for name, values in (("fix", np.array([9.0, 0.0, 0.0])), ("height", np.array([30.0]))):
        before, counted, tests = numbers(ekf), ekf.counters, ekf.nis_statistics
        result = ekf.update_sensor(Reading(name, t_ns, values))
        assert not result.accepted
        assert result.nis > 100.0
        assert result.reason.startswith("innovation")
        assert changes(counted, ekf) == {f"{name}_gated": 1}
        assert_nothing_changed(before, numbers(ekf))
        assert ekf.nis_statistics == tests


@pytest.mark.parametrize("kind", KINDS)
def test_a_gate_that_says_no_for_ever_inflates_nothing(kind: str) -> None:
    _, ekf = flown(kind, {"fix": Fix()})
    sigma_m = np.sqrt(np.trace(ekf.state().covariance[3:6, 3:6]))
    for i in range(100):
        assert not ekf.update_sensor(Reading("fix", ekf.state().t_ns - 100 + i, np.full(3, 50.0))).accepted
    assert ekf.counters["soft_resets"] == 0
    assert np.sqrt(np.trace(ekf.state().covariance[3:6, 3:6])) < 1.001 * sigma_m


class Broken(Fix):
    """Does what it is told to do wrong."""

    def __init__(self, wrong: Callable[..., Array] | None = None, check: Callable[[Array], str] | None = None) -> None:
        self.wrong, self.complains = wrong, check

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return super().residual(values, body, own) if self.wrong is None else self.wrong(values, body, own)

    def check(self, values: Array) -> str:
        return "" if self.complains is None else self.complains(values)


def raising(*_: object) -> Array:
    raise RuntimeError("loose contact")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("values", "covariance", "reason"),
    [
        ([np.nan, 0.0, 0.0], None, "not finite"),
        ([np.inf, 0.0, 0.0], None, "not finite"),
        ([0.0, 0.0], None, "3 asked"),
        ([[0.0, 0.0, 0.0]], None, "3 asked"),
        ([0.0, 0.0, 0.0], np.full((3, 3), np.nan), "covariance"),
        ([0.0, 0.0, 0.0], np.zeros((3, 3)), "covariance"),
    ],
)
def test_what_cannot_be_a_reading_is_refused(kind: str, values: list[float], covariance: Array, reason: str) -> None:
    _, ekf = flown(kind, {"fix": Fix()}, 0.5)
    before, counted = numbers(ekf), ekf.counters
    result = ekf.update_sensor(Reading("fix", ekf.state().t_ns, np.array(values), covariance))
    assert not result.accepted
    assert reason in result.reason
    assert changes(counted, ekf) == {"fix_refused": 1}
    assert_same_bytes(before, numbers(ekf))


@pytest.mark.parametrize("kind", KINDS)
def test_unknown_names_and_duplicates_are_refused(kind: str) -> None:
    run, ekf = flown(kind, {"fix": Fix(), "speed": Speed()})
    before, counted = numbers(ekf), ekf.counters
    t_ns = ekf.state().t_ns
    unknown = ekf.update_sensor(Reading("compass", t_ns, np.zeros(3)))
    assert unknown.reason == "no sensor is called 'compass'; there is fix, speed"
    assert not ekf.begin_sensor(t_ns, OwnStart("compass", np.zeros(3), np.ones(3))).accepted
    assert "already" in ekf.update_sensor(run.readings[-1]).reason
    assert "already" in ekf.begin_sensor(run.start.t_ns, run.starts[0]).reason
    twice = run.readings[-1].sensor
    assert changes(counted, ekf) in (
        {"sensor_unknown": 2, "speed_refused": 2},
        {"sensor_unknown": 2, "speed_refused": 1, f"{twice}_refused": 1},
    )
    assert_same_bytes(before, numbers(ekf))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("sensor", "covariance", "counter", "reason"),
    [
        (Broken(raising), None, "fix_failed", "RuntimeError: loose contact"),
        (Broken(lambda *_: np.full(3, np.nan)), None, "fix_failed", "not finite"),
        (Broken(lambda *_: np.zeros((3, 1))), None, "fix_failed", "shape"),
        (Broken(), np.ones((2, 2)), "fix_failed", "noise of shape"),
        (Broken(), np.ones((3, 3)) - 2.0 + 3.0 * np.eye(3) - np.eye(3), "fix_failed", "not positive definite"),
        (Broken(check=raising), None, "fix_refused", "RuntimeError: loose contact"),
        (Broken(check=lambda _: "no satellites"), None, "fix_refused", "no satellites"),
    ],
)  # fmt: skip
def test_a_sensor_that_fails_is_counted_and_changes_nothing(
    kind: str, sensor: Sensor, covariance: Array | None, counter: str, reason: str
) -> None:
    run = SensedRun.make(14, 0.5, {}, {})
    _, ekf = list(run.replay(made(kind, Suite({"fix": sensor}))))[-1]
    before, counted = numbers(ekf), ekf.counters
    result = ekf.update_sensor(Reading("fix", ekf.state().t_ns, np.zeros(3), covariance))
    assert not result.accepted
    assert reason in result.reason
    assert "'fix'" in result.reason or counter == "fix_refused"
    assert changes(counted, ekf) == {counter: 1}
    assert_nothing_changed(before, numbers(ekf))


@pytest.mark.parametrize("kind", KINDS)
def test_no_code_of_a_sensor_changes_the_state(kind: str) -> None:
    class Meddler(Speed):
        def residual(self, values: Array, body: BodyState, own: Array) -> Array:
            residual = super().residual(values, body, own)
            for part in (own, body.position_m, body.velocity_m_s, body.R_world_body, body.gyro_bias_rad_s):
                part[:] = 7.0
            raise ValueError(residual)

    run = SensedRun.make(14, 0.5, {"speed": Speed()}, {})
    _, ekf = list(run.replay(made(kind, Suite({"speed": Meddler()}))))[-1]
    before = numbers(ekf)
    assert "ValueError" in ekf.update_sensor(Reading("speed", ekf.state().t_ns, np.zeros(3))).reason
    assert_nothing_changed(before, numbers(ekf))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("sensor", "values", "sigmas", "reason"),
    [
        ("fix", [], [], "no variables of its own"),
        ("speed", [1.0, 2.0], [0.1, 0.1], "asked"),
        ("speed", [1.0], [0.1, 0.1], "asked"),
        ("speed", [np.nan], [0.1], "not finite"),
        ("speed", [1.0], [-0.1], "at least 0"),
        ("speed", [1.0], [np.inf], "not finite"),
    ],
)
def test_a_start_that_makes_no_sense_is_refused(
    kind: str, sensor: str, values: list[float], sigmas: list[float], reason: str
) -> None:
    _, ekf = flown(kind, {"fix": Fix(), "speed": Speed()}, 0.5)
    before, counted = numbers(ekf), ekf.counters
    result = ekf.begin_sensor(ekf.state().t_ns, OwnStart(sensor, np.array(values), np.array(sigmas)))
    assert reason in result.reason
    assert changes(counted, ekf) == {f"{sensor}_refused": 1}
    assert_same_bytes(before, numbers(ekf))


@pytest.mark.parametrize("kind", KINDS)
def test_a_reading_before_the_start_or_out_of_the_history_is_counted_as_others_are(kind: str) -> None:
    run, ekf = flown(kind, {"fix": Fix()}, 0.5)
    newest = ekf.state().t_ns
    assert not ekf.update_sensor(Reading("fix", run.start.t_ns - 1, np.zeros(3))).accepted
    assert not ekf.update_sensor(Reading("fix", newest + 100_000_000_000, np.zeros(3))).accepted
    assert "waits" in ekf.update_sensor(Reading("fix", newest + 1, np.zeros(3))).reason
    assert (ekf.counters["too_late"], ekf.counters["too_early"]) == (1, 1)
    fresh = made(kind, Suite({"fix": Fix()}))
    assert fresh.update_sensor(run.readings[0]).reason == "the filter has no state yet"
    assert fresh.body_at(T0_NS) is None


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_start_forgets_what_was_known_of_own_variables_only(kind: str) -> None:
    _, ekf = flown(kind, every_sensor(), 1.99)
    before, sigmas = numbers(ekf), ekf.own("beacon")[1]
    assert ekf.begin_sensor(ekf.state().t_ns, OwnStart("speed", np.array([1.2]), np.array([0.3]))).accepted
    np.testing.assert_allclose(ekf.own("speed"), [[1.2], [0.3]])
    np.testing.assert_allclose(ekf.own("beacon")[1], sigmas, rtol=1e-12)
    after = numbers(ekf)
    assert before[0][:16].tobytes() == after[0][:16].tobytes()
    np.testing.assert_allclose(after[1], before[1], rtol=1e-9, atol=1e-15)
    P = after[2]
    at = len(P) - 1  # speed is the last
    assert not P[at, :at].any()
    ekf.initialise(ekf.state())
    assert not mc.inside(ekf).own.since_ns
    assert not mc.inside(ekf).own.covariance.any()


@pytest.mark.parametrize("kind", KINDS)
def test_own_variables_walk_between_readings(kind: str) -> None:
    """Seen now, and exactly as much as if it were added at each step."""
    run = SensedRun.make(15, 2.0, {"height": Height()}, {})
    ekf = made(kind, Suite({"height": Height()}))
    ekf.initialise(run.start)
    assert ekf.begin_sensor(run.start.t_ns, run.starts[0]).accepted
    for k in range(len(run.way.t_ns)):
        ekf.predict(run.sample(k))
    assert ekf.own("height")[1][0] == pytest.approx(np.sqrt(1.0 + 2.0 * 0.03**2))
    z_m = float(ekf.state().T_world_body[2, 3])
    variance = float(ekf.state().covariance[5, 5])
    ekf.update_sensor(Reading("height", ekf.state().t_ns, np.array([z_m + 0.5])))
    prior = 1.0 + 2.0 * 0.03**2
    gain = prior / (prior + variance + 0.05**2)
    assert ekf.own("height")[0][0] == pytest.approx(0.5 * gain, abs=1e-9)
    assert ekf.own("height")[1][0] == pytest.approx(np.sqrt((1.0 - gain) * prior), rel=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_filter_without_sensors_is_as_it_was_byte_for_byte(kind: str) -> None:
    config = EkfConfig(coupling=kind)  # type: ignore[arg-type]
    plain, empty, full = (
        make_ekf(config, mc.IMU, MACHINE, MONO, suite=suite) for suite in (None, Suite(), Suite(every_sensor()))
    )
    without = make_ekf(config, mc.IMU, MACHINE, MONO)
    run = SensedRun.make(16, 2.0, {}, {})
    for ekf in (without, plain, empty, full):
        for k, _ in run.replay(ekf):
            if k % 40 == 20:
                ekf.update_zero_velocity(int(run.way.t_ns[k]) - 2_000_000)
    for ekf in (plain, empty):
        assert_same_bytes(numbers(without), numbers(ekf))
        assert ekf.counters == without.counters
        assert not ekf.update_sensor(Reading("fix", ekf.state().t_ns, np.zeros(3))).accepted
    assert numbers(without)[2].shape == (21, 21)
    assert full.counters.keys() - without.counters.keys() == {
        f"{name}_{end}"
        for name in every_sensor()
        for end in ("accepted", "gated", "failed", "refused", "waiting", "begun", "regained")
    }
    with_sensors, bare = full.state(), without.state()
    np.testing.assert_allclose(with_sensors.T_world_body, bare.T_world_body, atol=1e-12)
    np.testing.assert_allclose(with_sensors.covariance, bare.covariance, rtol=1e-9, atol=1e-15)
    assert not mc.inside(full).own.covariance.any()


@pytest.mark.parametrize(
    ("kind", "name"), [("loose", "vo"), ("loose", "nonholonomic"), ("tight", "tracks"), ("tight", "hold")]
)
def test_a_sensor_cannot_have_the_name_of_something_that_the_filter_counts(kind: str, name: str) -> None:
    with pytest.raises(UsageError, match=f"{name}_gated"):
        made(kind, Suite({name: Fix()}))


@pytest.mark.parametrize("kind", KINDS)
def test_the_body_at_a_time_is_the_state_there_and_the_rate_without_bias(kind: str) -> None:
    run, ekf = flown(kind, {"fix": Fix()})
    for k, beside_ns in ((300, 0), (350, 1_000_000)):
        t_ns = int(run.way.t_ns[k]) + beside_ns
        body, state = ekf.body_at(t_ns), ekf.state_at(t_ns)
        assert body is not None
        assert state is not None
        np.testing.assert_array_equal(body.R_world_body, state.T_world_body[:3, :3])
        np.testing.assert_array_equal(body.position_m, state.T_world_body[:3, 3])
        np.testing.assert_array_equal(body.velocity_m_s, state.velocity_world_m_s)
        np.testing.assert_array_equal(body.accel_bias_m_s2, state.accel_bias_m_s2)
        share = beside_ns / (run.way.t_ns[1] - run.way.t_ns[0])
        seen = (1.0 - share) * run.way.samples[k, :3] + share * run.way.samples[k + 1, :3]
        np.testing.assert_allclose(body.rate_rad_s, seen - state.gyro_bias_rad_s, atol=1e-12)
    assert ekf.body_at(run.start.t_ns - 1) is None
    assert ekf.body_at(ekf.state().t_ns + 1) is None


@pytest.mark.parametrize("kind", KINDS)
def test_several_anchors_may_be_ranged_at_once_and_each_only_once(kind: str) -> None:
    anchors = {1.0: (4.0, 0.0, 0.0), 2.0: (0.0, 5.0, 0.0)}
    radio = AnchorRange(AnchorRangeSettings(anchors={"1": anchors[1.0], "2": anchors[2.0]}, frame="known"))
    ends = []
    for order in ((1.0, 2.0), (2.0, 1.0)):
        run, ekf = flown(kind, {"uwb": radio})
        place = ekf.state().T_world_body[:3, 3]
        for anchor in (*order, order[0]):
            values = np.array([anchor, np.linalg.norm(place - anchors[anchor]) + 0.05])
            ekf.update_sensor(Reading("uwb", int(run.way.t_ns[-1]), values))
        assert ekf.counters["uwb_accepted"] == 2
        assert ekf.counters["uwb_refused"] == 1
        ends.append(numbers(ekf))
    assert_same_bytes(*ends)
