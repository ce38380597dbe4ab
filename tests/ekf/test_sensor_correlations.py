"""Own variables share their errors with the rest of the state, through clones, points and vision of every kind."""

import pickle

import numpy as np
import pytest

from vislam.config import load
from vislam.core.geometry import skew, so3_exp, so3_log
from vislam.core.messages import Array
from vislam.core.readings import OwnStart, Reading
from vislam.ekf import CameraCalibration, Ekf, MsckfEkf
from vislam.ekf.filtering import Filtering
from vislam.ekf.tight.core import by_now
from vislam.ekf.tight.state import CLONES
from vislam.sensors import BodyState, Sensor, Suite, Variable
from worlds import monte_carlo as mc
from worlds.flight import CHEAP, MONO, SIGMAS, STEREO, Flight, motion_of
from worlds.motion import NS, T0_NS, state_error
from worlds.parts import MACHINE
from worlds.sensed_paths import KINDS, Fix, SensedRun, Speed, every_sensor, made

PLACE = (Variable("x_m", 10.0), Variable("y_m", 10.0), Variable("z_m", 10.0))


class Mark(Sensor):
    """The body is at a place of which nothing is known: from then on that is a clone of its position."""

    columns = ("zero_m",) * 3
    touches = ("position",)
    variables = PLACE

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values + own - body.position_m

    def noise(self, values: Array) -> Array:
        return 1e-10 * np.eye(3)


def mark(ekf: Ekf | MsckfEkf, t_ns: int) -> None:
    body = ekf.body_at(t_ns)
    assert body is not None
    assert ekf.begin_sensor(t_ns, OwnStart("mark", body.position_m, np.full(3, 10.0))).accepted
    assert ekf.update_sensor(Reading("mark", t_ns, np.zeros(3))).accepted


@pytest.mark.parametrize("rig", [MONO, STEREO], ids=["mono", "stereo"])
def test_a_marked_place_stays_the_clone_that_was_taken_there(rig) -> None:
    """Frames are cloned, clones leave, points come and go; the rows of P that say the same stay the same.

    To first order: errors of clones are right-invariant, those of the mark are not, so the run starts well known.
    """
    flight = Flight.make(2, 4.0, rig, sigmas=0.1 * SIGMAS, outliers=0.05)
    suite = Suite({"mark": Mark(), "speed": Speed()})
    config = load(
        None, {"ekf.coupling": "tight", "ekf.tight_time_offset_sigma_s": 0.0}
    ).ekf  # a mark is by the IMU's clock
    ekf = MsckfEkf(config, CHEAP, MACHINE, rig, suite)
    ekf.initialise(flight.start)
    marked_ns, compared, i, most = 0, 0, 0, 0.0
    for sample in flight.samples:
        ekf.predict(sample)
        while i < len(flight.frames) and flight.frames[i][0] <= sample.t_ns - 10_000_000:
            ekf.update_vision(motion_of(flight.frames[i][0]), flight.frames[i][1])
            window = mc.inside(ekf).window
            stamps = [frame.t_ns for frame in window.frames]
            if marked_ns in stamps:
                at = CLONES + 6 * stamps.index(marked_ns)
                k = stamps.index(marked_ns)
                by_clone = window.P[at + 3 : at + 6] - skew(window.p[k]) @ window.P[at : at + 3]
                first = window.first_own
                sigmas = np.sqrt(np.diag(window.P))
                scale = np.sqrt(np.diag(window.P)[first : first + 3])[:, None] * np.where(sigmas > 0.0, sigmas, 1.0)
                apart = np.abs(window.P[first : first + 3] - by_clone) / scale
                most = max(most, apart.max())
                np.testing.assert_allclose(window.own[:3], window.p[k], atol=1e-3)
                compared += 1
            elif i % 12 == 8:
                marked_ns = flight.frames[i][0]
                mark(ekf, marked_ns)
            i += 1
    print(f"{compared} times, {most:.4f} apart", {name: n for name, n in ekf.counters.items() if n})
    assert compared > 30
    assert most < 0.03
    assert ekf.counters["points_started"] > 20
    assert ekf.counters["tracks_used"] > 200
    assert not mc.inside(ekf).window.P[-1].any()  # the speed's scale has not begun


def test_a_marked_place_stays_the_keyframe_that_was_taken_there() -> None:
    """The same for the loose filter, which has one clone; metric motions and directions."""
    for metric in (True, False):
        scenario = mc.Scenario("", metric=metric, duration_s=6.0)
        way, rng = mc.drive("hand", 21, 6.0), np.random.default_rng(4)
        config = mc.honest(odom="corrected", vo_shared_fraction=0.0)
        ekf = Ekf(config, mc.IMU, MACHINE, None if metric else mc.CAMERA, Suite({"mark": Mark()}))
        ekf.initialise(mc.start(way, 0.1 * mc.START_SIGMAS, rng))
        frames, compared = list(mc.vision(scenario, way, rng)), 0
        most = 0.0
        for k, t_ns in enumerate(way.t_ns.tolist()):
            ekf.predict(SensedRun(way, ekf.state(), [], []).sample(k))
            while frames and frames[0][1].t_ns <= t_ns:
                _, vo, begins = frames.pop(0)
                mc.deliver(ekf, vo, begins)
                if begins is not None:
                    mark(ekf, vo.t_ns)
                P = mc.inside(ekf).P
                sigmas = np.sqrt(np.diag(P))
                apart = np.abs(P[21:] - P[18:21]) / np.outer(sigmas[21:], sigmas)
                most = max(most, apart.max())
                np.testing.assert_allclose(ekf.own("mark")[0], mc.inside(ekf).x[16:19], atol=1e-3)
                compared += 1
        print(f"{compared} times, {most:.4f} apart")
        assert most < 0.03
        assert compared == ekf.counters["vo_accepted"] + 1 + ekf.counters["vo_gated"]
        assert ekf.counters["vo_accepted"] > 50


def test_a_new_keyframe_shares_all_errors_of_the_body() -> None:
    """Those with own variables, too: whatever tells a scale tells where the keyframe is."""
    sensors = {"speed": Speed(), "fix": Fix()}
    run = SensedRun.make(30, 2.0, sensors, {"speed": 20, "fix": 30})
    _, ekf = list(run.replay(made("loose", Suite(sensors))))[-1]
    assert ekf.add_keyframe(7, ekf.state().t_ns).accepted
    P = mc.inside(ekf).P
    assert np.abs(P[21:, 3:6]).min() > 1e-7
    np.testing.assert_allclose(P[15:21], P[0:6], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(P[:, 15:21], P[:, 0:6], rtol=1e-9, atol=1e-15)


def test_the_error_of_the_body_a_moment_ago_hangs_on_that_of_now_as_it_says() -> None:
    rng, ago_s, h = np.random.default_rng(8), 0.05, 1e-6
    bias = rng.normal(size=(2, 3))
    body = BodyState(0, so3_exp(rng.normal(size=3)), *rng.normal(size=(2, 3)), *bias, rng.normal(size=3))
    there, M = body.later(-ago_s), by_now(body, ago_s)
    for k, e in enumerate(np.eye(15) * h):
        moved = body.moved(e).later(-ago_s)
        turned = so3_log(np.ascontiguousarray(there.R_world_body.T @ moved.R_world_body))
        parts = ("position_m", "velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2")
        change = np.concatenate([turned, *(getattr(moved, part) - getattr(there, part) for part in parts)])
        np.testing.assert_allclose(change / h, M[:, k], atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_fix_says_of_the_path_tells_the_scale_of_a_speed(kind: str) -> None:
    """The fix does not show the scale; what speed and scale have in common does."""
    fine = Fix()
    fine.sigma_m = 0.001
    sensors = {"speed": Speed(), "fix": fine}
    run = SensedRun.make(31, 1.5, sensors, {"speed": 20})
    k, ekf = list(run.replay(made(kind, Suite(sensors))))[-1]
    values, sigmas = ekf.own("speed")
    T = run.way.pose(k)
    result = ekf.update_sensor(Reading("fix", int(run.way.t_ns[k]), T[:3, 3] + T[:3, :3] @ Fix.lever_m))
    better, surer = ekf.own("speed")
    print(f"{kind}: scale {values} +- {sigmas}, with the fix {better} +- {surer}, true {run.own['speed']}")
    assert result.accepted
    assert surer[0] < 0.8 * sigmas[0]
    assert abs(better[0] - run.own["speed"][0]) < 3.0 * surer[0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_scale_that_is_not_known_makes_speeds_tell_less(kind: str) -> None:
    run = SensedRun.make(32, 4.0, {"speed": Speed()}, {"speed": 10})
    sigmas = []
    for sigma in (0.0, 0.05, 0.3):
        run.starts = [OwnStart("speed", run.own["speed"], np.array([sigma]))]
        _, ekf = list(run.replay(made(kind, Suite({"speed": Speed()}))))[-1]
        sigmas.append(np.sqrt(np.trace(ekf.state().covariance[3:6, 3:6])))
    print(f"{kind}: sigmas of position {np.round(sigmas, 4)} m")
    assert sigmas[0] < 0.95 * sigmas[1] < 0.95 * sigmas[2]


@pytest.mark.parametrize("offset_s", [-0.03, 0.03])
def test_a_camera_whose_clock_is_off_does_not_spoil_readings(offset_s: float) -> None:
    """Stamps of frames are 30 ms off, those of readings are not: a reading between may be applied after its time."""
    nis, readings = 0.0, 0
    for seed in range(2):
        flight = Flight.make(seed, 4.0, offset_s=offset_s)
        fine = Fix()
        fine.sigma_m = 0.002
        ekf = MsckfEkf(load(None, {"ekf.coupling": "tight"}).ekf, CHEAP, MACHINE, MONO, Suite({"fix": fine}))
        ekf.initialise(flight.start, None, CameraCalibration(offset_s, 1e-4, np.zeros(3), np.full(3, 1e-3)))
        rng = np.random.default_rng(seed)
        i = 0
        for sample in flight.samples:
            ekf.predict(sample)
            while i < len(flight.frames) and flight.frames[i][0] + round(offset_s * NS) <= sample.t_ns:
                t_ns = flight.frames[i][0] + round(0.5 * offset_s * NS)  # between stamp and time of the frame
                T = flight.motion.pose((t_ns - T0_NS) / NS)
                said = T[:3, 3] + T[:3, :3] @ Fix.lever_m + 0.002 * rng.normal(size=3)
                ekf.update_vision(motion_of(flight.frames[i][0]), flight.frames[i][1])
                if i > 20:
                    ekf.update_sensor(Reading("fix", t_ns, said))
                i += 1
        error = state_error(flight.truth(len(flight.samples) - 1), ekf.state())
        assert np.linalg.norm(error[3:6]) < 0.02
        _, total, degrees = ekf.nis_statistics["fix"]
        assert ekf.counters["fix_gated"] <= 1
        nis, readings = nis + total, readings + degrees
    print(f"offset {1e3 * offset_s:.0f} ms: NIS {nis / readings:.3f} of {readings // 3} readings")
    assert 0.85 < nis / readings < 1.15


@pytest.mark.parametrize("coupling", ["loose", "tight"])
def test_the_filter_of_a_run_remembers_what_it_told_of_sensors(coupling: str) -> None:
    """A twin in another process that is told the same has the same state, bit for bit."""
    config = load(None, {"ekf.coupling": coupling}).ekf
    sensors = every_sensor()
    run = SensedRun.make(33, 1.0, sensors, {"fix": 40, "height": 20, "beacon": 20, "speed": 20})
    filtering, twin = (Filtering(config, mc.IMU, MACHINE, MONO, Suite(every_sensor())) for _ in range(2))
    for one in (filtering, twin):
        one.ekf.initialise(run.start)
        for k in range(len(run.way.t_ns)):
            one.ekf.predict(run.sample(k))
    for start in run.starts:
        assert filtering.begin_sensor(run.start.t_ns, start).accepted
    for reading in run.readings:
        assert filtering.add_reading(reading).accepted
    for told in pickle.loads(pickle.dumps(filtering.take_applied_readings())):  # noqa: S301
        assert told.apply(twin.ekf).accepted
    assert filtering.take_applied_readings() == []
    assert filtering.ekf.state().T_world_body.tobytes() == twin.ekf.state().T_world_body.tobytes()
    assert filtering.ekf.state().covariance.tobytes() == twin.ekf.state().covariance.tobytes()
    assert filtering.ekf.own("beacon")[0].tobytes() == twin.ekf.own("beacon")[0].tobytes()
