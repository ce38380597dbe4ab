"""An error that neighbouring readings share is a state: exact where all is linear, and honest where it is not."""

import math
from pathlib import Path

import numpy as np
import pytest

from vislam.config import GraphConfig, WindowConfig
from vislam.core.errors import UsageError
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array
from vislam.core.readings import OwnStart, PlacedReading, Reading
from vislam.graph import PoseGraph
from vislam.sensors import BodyState, Correlated, Sensor, Suite, Variable, drawn_readings, wrong_jacobians
from vislam.sensors.kinds import AnchorRange, AnchorRangeSettings, Height, Pose, Position, PositionSettings, Wheels
from vislam.sensors.sensor import Configured
from vislam.sensors.toml import load_sensor_setup
from worlds import monte_carlo as mc
from worlds.lap import RIG, World
from worlds.parts import MACHINE
from worlds.sensed import Fixes, pose_error, reading_at, station_at, with_readings
from worlds.sensed_paths import KINDS, SensedRun, later, made

SIGMA, TAU_S, NOISE = 2.0, 5.0, 0.5
ANCHORS = {"1": (0.0, 0.0, 2.5), "7": (30.0, 0.0, 6.0), "0x2a": (30.0, 30.0, 0.5), "4": (0.0, 30.0, 4.0)}


class Level(Sensor):
    """A number that has nothing to do with the body: a level, and an error that readings share."""

    columns = ("level",)
    touches = ()
    variables = (Variable("level", 3.0, 1.0),)
    gate_probability = 1.0 - 1e-9

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values - own

    def noise(self, values: Array) -> Array:
        return np.eye(1) * NOISE**2


TOLD = OwnStart("level", np.array([1.0, 0.0]), np.array([3.0, SIGMA]))


def exactly(t_ns: list[int], levels: list[float]) -> tuple[Array, Array]:
    """Return level and shared error at the last reading, and their covariance, by all readings at once."""
    t_s, values = (np.array(t_ns) - t_ns[0]) * 1e-9, np.array(levels) - 1.0
    S = SIGMA**2 * np.exp(-np.abs(t_s[:, None] - t_s) / TAU_S)
    both = np.vstack([9.0 * np.ones(len(t_s)), S[-1]])  # with each reading
    seen = np.linalg.inv(S + 9.0 + NOISE**2 * np.eye(len(t_s)))
    return both @ seen @ values + [1.0, 0.0], np.diag([9.0, SIGMA**2]) - both @ seen @ both.T


def test_a_variable_that_forgets_keeps_its_variance_and_two_steps_are_one() -> None:
    variable = Variable("x", SIGMA, 1.0, correlation_s=TAU_S)
    decay, variance = variable.after(3.0)
    assert SIGMA**2 * decay**2 + variance == pytest.approx(SIGMA**2, rel=1e-15)
    (one, first), (two, second) = variable.after(1.2), variable.after(1.8)
    assert one * two == pytest.approx(decay) and first * two**2 + second == pytest.approx(variance)
    assert variable.after(TAU_S)[0] == pytest.approx(math.exp(-1.0)) and variable.after(-1.0) == (1.0, 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_the_filters_have_it_as_all_readings_at_once_do(kind: str) -> None:
    sensor, way, rng = Correlated(Level(), [SIGMA], TAU_S), mc.drive("hand", 3, 6.0), np.random.default_rng(4)
    start, found = mc.start(way, mc.START_SIGMAS, rng), []
    run = SensedRun(way, start, [], [])
    for _ in range(2):
        ekf, readings = made(kind, Suite({"level": sensor})), list[Reading]()
        ekf.initialise(start)
        assert ekf.begin_sensor(start.t_ns, TOLD).accepted
        for k in range(1, len(way.t_ns)):
            ekf.predict(run.sample(k))
            if k % 97 == 0:
                readings.append(Reading("level", int(way.t_ns[k]), np.array([1.0 + math.sin(k)])))
                assert ekf.update_sensor(readings[-1]).accepted
            elif k % 97 == 50:  # it is refused, and leaves the state as it was
                assert not ekf.update_sensor(Reading("level", int(way.t_ns[k]), np.array([900.0]))).accepted
        found.append((*ekf.own("level"), ekf.own_covariance("level")))
    assert all(np.array_equal(one, other) for one, other in zip(*found, strict=True))
    values, P = exactly([r.t_ns for r in readings], [r.values[0] for r in readings])
    decays, variances = Suite({"level": sensor}).after("level", (int(way.t_ns[-1]) - readings[-1].t_ns) * 1e-9)
    np.testing.assert_allclose(found[0][0], [values[0], decays[1] * values[1]], rtol=1e-6)
    np.testing.assert_allclose(found[0][2], P * np.outer(decays, decays) + np.diag(variances), rtol=1e-6)


def test_the_graph_has_it_as_all_readings_at_once_do() -> None:
    world, t_ns, values = World(8.0, seed=1), [], []
    sensor = Correlated(Level(), [SIGMA], TAU_S)
    graph = PoseGraph(
        GraphConfig(coupling="loose"), world.noise, MACHINE, RIG, WindowConfig(), Suite({"level": sensor})
    )
    graph.initialise(world.initial_state(), None)
    for k in range(world.count):
        packet = world.packet(k)
        if k >= 2 and k not in range(10, 20):  # a gap: the step over it is longer
            t_ns.append(round(world.times_s[k] * 1e9))
            values.append(1.0 + 0.01 * math.sin(k))  # small, for the kernel weighs what is not
            one = PlacedReading(Reading("level", t_ns[-1], np.array(values[-1:])), station_at(world, k, 1.0))
            packet = with_readings(packet, one, starts=(TOLD,) if k == 2 else ())
        graph.add(packet, [])
    graph.finish()
    told, joint = graph.own("level"), graph.joint_covariance(world.count - 1, "level")
    assert told is not None and joint is not None
    exact, P = exactly(t_ns, values)
    np.testing.assert_allclose(told[0] - [1.0, 0.0], exact - [1.0, 0.0], rtol=1e-3)
    np.testing.assert_allclose(joint[6:, 6:], P, rtol=1e-3)


SENSORS: dict[str, Configured] = {
    "position": Position(PositionSettings(lever_sigma_m=0.1)),
    "range": AnchorRange(AnchorRangeSettings(ANCHORS, bias_sigma_m=0.2)),
    "height": Height(),
    "wheels": Wheels(),
    "pose": Pose(),
}


@pytest.mark.parametrize("name", SENSORS)
def test_its_jacobians_are_slopes_and_what_is_drawn_has_the_error(name: str) -> None:
    rng, sensor = np.random.default_rng(6), SENSORS[name]
    shared = Correlated(sensor, [0.05, 0.05, 0.0, 0.0] if name == "wheels" else [0.05], 10.0)
    inner = np.array([v.start + 0.1 * rng.normal() for v in sensor.variables])
    own = np.concatenate([inner, 0.05 * rng.normal(size=len(shared.variables) - len(inner))])
    body = BodyState(0, so3_exp(rng.normal(size=3)), rng.normal(size=3), *rng.normal(size=(4, 3)))
    values = shared.draw(body, own, np.random.default_rng(7))
    assert not wrong_jacobians(shared, Reading(name, 0, values), body, own)
    plain = sensor.residual(sensor.draw(body, inner, np.random.default_rng(7)), body, inner)
    np.testing.assert_allclose(shared.residual(values, body, own), plain, atol=2e-3)
    assert name == "wheels" or len(own) - len(inner) == len(plain) * len(sensor.sources)


def a_way(seconds: float, hz: float = 5.0) -> list[BodyState]:
    """A cart on bends, some 2 m/s fast."""
    none, out = np.zeros(3), []
    for k in range(int(seconds * hz)):
        s = k / hz
        place = np.array([40.0 * math.sin(0.05 * s), 30.0 * (1.0 - math.cos(0.041 * s)), math.sin(0.03 * s)])
        out.append(BodyState(int(s * 1e9), so3_exp(np.array([0.0, 0.0, 0.05 * s])), place, *[none] * 4))
    return out


def test_what_is_drawn_over_a_time_forgets_as_it_is_said() -> None:
    sensor, bodies = Correlated(Height(), [SIGMA], TAU_S), a_way(4000.0)
    errors = [r.values[0] for r in drawn_readings("h", sensor, bodies, np.zeros(2), 3)]
    errors = np.array(errors) - [body.position_m[2] for body in bodies]
    lagged = [float(np.mean(errors[25 * n :] * errors[: len(errors) - 25 * n])) for n in range(3)]  # of 5 s
    np.testing.assert_allclose(lagged, SIGMA**2 * np.exp(-np.arange(3.0)) + [0.3**2, 0.0, 0.0], rtol=0.2)


@pytest.mark.parametrize("tau_s", [2.0, 40.0])
def test_a_frame_that_begins_is_as_sure_as_readings_that_err_together_make_it(tau_s: float) -> None:
    plain = Position(PositionSettings(0.3, 0.3))
    sensor, bodies, off, plainly = Correlated(plain, [1.0], tau_s), a_way(100.0), [], []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        own = np.concatenate([rng.uniform(-3, 3, 1), 10.0 * rng.normal(size=3), rng.normal(size=3)])
        readings = drawn_readings("it", sensor, bodies, own, seed)
        for one, into in ((sensor, off), (plain, plainly)):
            counts = range(5, len(readings) + 1, 5)
            found = next(f for n in counts if (f := one.begin(readings[:n], bodies[:n])) is not None)
            into.append(((found.values - own[: len(found.values)]) / found.sigmas)[:4])
    nees, plain_nees = np.mean(np.square(off)), np.mean(np.square(plainly))
    print(f"{tau_s} s: {nees:.2f}, of readings taken each for itself {plain_nees:.2f}")
    assert 0.4 < nees < 1.6
    assert plain_nees > 2.0


def test_the_graph_is_honest_about_fixes_that_err_together_and_was_not() -> None:
    nees: dict[str, list[float]] = {"shared": [], "each for itself": []}
    for name, into in nees.items():
        for seed in range(2):
            into.extend(nees_of_graph(seed, name == "shared"))
    print({name: round(float(np.mean(values)), 2) for name, values in nees.items()})
    assert 0.3 < np.mean(nees["shared"]) < 1.7
    assert np.mean(nees["each for itself"]) > 3.0


def nees_of_graph(seed: int, shared: bool) -> list[float]:
    """Return the NEES of poses over degrees of freedom, with fixes by 0.3 m off for 8 s."""
    rng, world = (
        np.random.default_rng(seed),
        World(24.0, 2.5, seed=seed, vo_sigma_rad=math.radians(0.5), vo_sigma_m=0.02),
    )
    fixes = Fixes(0.05)
    truth = Correlated(fixes, [0.3], 8.0)
    sensor: Sensor = truth if shared else fixes
    own = np.concatenate([0.1 * rng.normal(size=3), np.zeros(4), 0.3 * rng.normal(size=3)])
    sigmas = np.array([0.1, 0.1, 0.1, 1e-4, 1e-3, 1e-3, 1e-3, 0.3, 0.3, 0.3])
    config = GraphConfig(coupling="loose", vo_inflation=1.0, vo_floor_deg=0.0, vo_floor_m=0.0)
    graph = PoseGraph(config, world.noise, MACHINE, RIG, WindowConfig(), Suite({"fixes": sensor}))
    graph.initialise(world.initial_state(), None)
    for k in range(world.count):
        packet = world.packet(k)
        if k >= 2:
            own = later(truth, own, 1.0 / world.keyframe_hz, rng)
            reading = reading_at(world, "fixes", truth, own, k, 0.4, rng)
            n = len(sensor.variables)
            start = OwnStart("fixes", np.zeros(n), sigmas[:n])
            packet = with_readings(packet, reading, starts=(start,) if k == 2 else ())
        graph.add(packet, [])
    graph.finish()
    states = graph.states()
    errors = [(k, pose_error(world.truth[k], states[k].T_world_body)) for k in range(5, world.count, 5)]
    return [e @ np.linalg.solve(states[k].covariance[:6, :6], e) / 6.0 for k, e in errors]


def sensor_of(tmp_path: Path, text: str) -> Sensor:
    path = tmp_path / "sensors.toml"
    path.write_text(f"[sensors.a]\n{text}", encoding="utf-8")
    return load_sensor_setup(path).suite["a"]


def test_a_file_gives_any_kind_a_shared_error(tmp_path: Path) -> None:
    up = sensor_of(tmp_path, "kind='position'\ncorrelated_sigma=[1.5, 1.5, 0]\ncorrelation_s=60\nregain_m=0.0")
    assert [v.name for v in up.variables[4:]] == ["shared_0_0", "shared_0_1"]
    assert up.variables[4].sigma == 1.5 and up.variables[4].correlation_s == 60.0 and up.regain_m == 0.0
    anchors = "anchors={1=[0,0,0], 7=[5,0,0]}"
    ranges = sensor_of(tmp_path, f"kind='range'\n{anchors}\ncorrelated_sigma=0.2\ncorrelation_s=20.0")
    assert [v.name for v in ranges.variables[4:]] == ["shared_1_0", "shared_7_0"]
    assert isinstance(sensor_of(tmp_path, "kind='height'"), Height)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("correlated_sigma=1.0", "correlation_s: a time above 0 is asked with correlated_sigma, got 0"),
        ("correlation_s=1.0", "correlated_sigma: one for each of 3 numbers of its residual, or one for all, is asked"),
        ("correlated_sigma=[1.0,1.0]\ncorrelation_s=1.0", "got [1.0, 1.0]"),
        ("correlated_sigma=-1.0\ncorrelation_s=1.0", "got [-1.0]"),
        ("correlated_sigma=nan\ncorrelation_s=1.0", "got [nan]"),
        ("correlated_sigma='x'\ncorrelation_s=1.0", "option correlated_sigma"),
        ("correlated_sigma=1.0\ncorrelation_s=inf", "correlation_s is inf"),
    ],
)
def test_a_shared_error_that_is_none_is_refused(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(UsageError) as caught:
        sensor_of(tmp_path, f"kind='position'\n{text}")
    assert why in str(caught.value) and "[sensors.a]" in str(caught.value)
