"""A filter that is too sure believes good fixes again; what leaps, lies a while or is contradicted does not pass."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.ekf import Ekf, MsckfEkf
from vislam.ekf.regain import Refused, Watch
from vislam.sensors import Suite
from worlds import monte_carlo as mc
from worlds.flight import MONO
from worlds.parts import MACHINE
from worlds.sensed_paths import KINDS, EkfConfig, Fix, SensedRun, Speed

SECOND = int(mc.IMU.rate_hz)
NS = 1_000_000_000


def too_sure(kind: str, suite: Suite) -> Ekf | MsckfEkf:
    """Return a filter that is told an IMU ten times as good as it is."""
    names = (
        "gyroscope_noise_density",
        "accelerometer_noise_density",
        "gyroscope_random_walk",
        "accelerometer_random_walk",
    )
    imu = replace(mc.IMU, **{name: 0.1 * getattr(mc.IMU, name) for name in names})
    if kind == "loose":
        return Ekf(mc.honest(), imu, MACHINE, suite=suite)
    return MsckfEkf(EkfConfig(coupling="tight"), imu, MACHINE, MONO, suite)


def honest(kind: str, suite: Suite) -> Ekf | MsckfEkf:
    if kind == "loose":
        return Ekf(mc.honest(), mc.IMU, MACHINE, suite=suite)
    return MsckfEkf(EkfConfig(coupling="tight"), mc.IMU, MACHINE, MONO, suite)


def fixes(sigma_m: float = 0.5, regain_m: float = 1000.0) -> Fix:
    fix = Fix()
    fix.sigma_m, fix.regain_m = sigma_m, regain_m
    return fix


def blind_minute(seed: int, fix: Fix) -> SensedRun:
    """A fix a second, none for a minute, and fixes again."""
    run = SensedRun.make(seed, 112.0, {"fix": fix}, {"fix": SECOND})
    run.readings = [r for r in run.readings if not 40 * NS < r.t_ns - run.start.t_ns < 100 * NS]
    return run


def ended(run: SensedRun, ekf: Ekf | MsckfEkf) -> tuple[float, float]:
    """Return the error of the place at the end in metres, and its NEES per degree."""
    k, ekf = list(run.replay(ekf))[-1]
    state = ekf.state()
    error = run.way.error(k, state)[3:6]
    nees = float(error @ np.linalg.solve(state.covariance[3:6, 3:6], error)) / 3.0
    return float(np.linalg.norm(error)), nees


def shifted(run: SensedRun, by_m: Array, begin_s: float, end_s: float, name: str = "fix") -> None:
    """Let the readings of a while lie by the same."""
    first = run.start.t_ns
    run.readings = [
        replace(r, values=r.values + by_m) if r.sensor == name and begin_s * NS <= r.t_ns - first < end_s * NS else r
        for r in run.readings
    ]


@pytest.mark.parametrize(("kind", "seed"), [("loose", 7000), ("loose", 7003), ("tight", 7001)])
def test_good_fixes_after_a_blind_minute_are_believed_again(kind: str, seed: int) -> None:
    before_m, before = ended(blind_minute(seed, never := fixes(regain_m=0.0)), too_sure(kind, Suite({"fix": never})))
    run, ekf = blind_minute(seed, fix := fixes()), too_sure(kind, Suite({"fix": fix}))
    after_m, after = ended(run, ekf)
    print(f"{kind} {seed}: {before_m:.0f} m, NEES {before:.0f}; believed again {after_m:.2f} m, NEES {after:.1f}")
    assert before_m > 100.0
    assert after_m < 2.5
    assert after < 8.0  # with an IMU told ten times too good it is 1 to 4 before the gap, too
    assert ekf.counters["fix_regained"] == 1
    assert ekf.counters["fix_gated"] <= 5


def test_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    run = blind_minute(7000, fix := fixes())
    ekf = too_sure("loose", Suite({"fix": fix}))
    update = ekf.update_sensor

    def listening(reading: Reading) -> object:
        result = update(reading)
        told.append(result.reason)
        return result

    monkeypatch.setattr(ekf, "update_sensor", listening)
    ended(run, ekf)
    (reason,) = [reason for reason in told if "believed again" in reason]
    assert reason.startswith("fix believed again: 5 readings over 4.0 s agree that the place is off by ")
    assert reason.endswith(" m, 64 s after the last that was believed")


def test_late_readings_end_at_the_same() -> None:
    run, fix = blind_minute(7000, fixes()), fixes()
    on_time, late = too_sure("loose", Suite({"fix": fix})), too_sure("loose", Suite({"fix": fix}))
    ended(run, on_time)
    late.initialise(run.start)
    waiting = list(run.readings)
    for k, t_ns in enumerate(run.way.t_ns.tolist()):
        late.predict(run.sample(k))
        while waiting and waiting[0].t_ns + 100_000_000 <= t_ns:
            late.update_sensor(waiting.pop(0))
    for reading in waiting:
        late.update_sensor(reading)
    assert late.counters["fix_regained"] == on_time.counters["fix_regained"] == 1
    assert late.state().T_world_body == pytest.approx(on_time.state().T_world_body, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_reflection_of_ten_seconds_is_not_believed_where_something_sees_the_motion(kind: str) -> None:
    sensors = {"fix": fixes(0.3), "speed": Speed()}
    run = SensedRun.make(7100, 30.0, sensors, {"fix": SECOND // 5, "speed": 10})
    clean_m, _ = ended(run, honest(kind, Suite(sensors)))
    shifted(run, np.array([4.0, 3.0, 0.0]), 15.0, 25.0)
    ekf = honest(kind, Suite(sensors))
    error_m, _ = ended(run, ekf)
    print(f"{kind}: {error_m:.2f} m, without the reflection {clean_m:.2f} m; {ekf.counters['fix_gated']} gated")
    assert ekf.counters["fix_regained"] == 0
    assert ekf.counters["fix_gated"] >= 45
    assert error_m < clean_m + 0.3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lasting_s", [0.9, 1e3])
def test_a_leap_by_ten_kilometres_is_never_believed(kind: str, lasting_s: float) -> None:
    run = SensedRun.make(7200, 45.0, {"fix": fixes(0.3)}, {"fix": SECOND})
    shifted(run, np.array([1e4, 0.0, 0.0]), 15.0, 15.0 + lasting_s)
    ekf = honest(kind, Suite({"fix": fixes(0.3)}))
    error_m, _ = ended(run, ekf)
    assert ekf.counters["fix_regained"] == 0
    assert ekf.counters["fix_gated"] == (1 if lasting_s < 1.0 else 31)
    assert error_m < (1.0 if lasting_s < 1.0 else 500.0)


@pytest.mark.parametrize("kind", KINDS)
def test_what_another_sensor_of_places_contradicts_is_not_believed(kind: str) -> None:
    sensors = {"good": fixes(0.3), "other": fixes(0.3)}
    run = SensedRun.make(7300, 40.0, sensors, {"good": SECOND, "other": SECOND})
    shifted(run, np.array([0.0, 5.0, 0.0]), 15.0, 1e3, "other")
    ekf = honest(kind, Suite(sensors))
    error_m, _ = ended(run, ekf)
    assert ekf.counters["other_regained"] == ekf.counters["good_regained"] == 0
    assert ekf.counters["other_gated"] >= 20
    assert error_m < 1.0


def refused(offsets: Array, watch: Watch | None = None, every_s: float = 1.0, begin_s: float = 1.0) -> Watch:
    """Refuse readings [N, 3] of a noise of 1 m."""
    watch = Watch() if watch is None else watch
    for i, offset in enumerate(offsets):
        watch = watch.refused("fix", Refused(round((begin_s + i * every_s) * NS), np.eye(3), offset))
    return watch


def test_readings_that_do_not_agree_are_not_believed() -> None:
    far = np.array([30.0, 0.0, 0.0])
    agreed = refused(np.tile(far, (20, 1)))
    found = agreed.regain("fix", 20 * NS, 1.0, 1000.0)
    assert found is not None and found.place_m == pytest.approx(far)
    wild = refused(far + 20.0 * np.random.default_rng(1).normal(size=(20, 3)))
    assert wild.regain("fix", 20 * NS, 1.0, 1000.0) is None
    assert agreed.regain("fix", 20 * NS, 1.0, 0.0) is None  # told never to
    assert agreed.regain("fix", 20 * NS, 1.0, 29.0) is None  # farther than it may
    assert refused(np.tile(far, (4, 1))).regain("fix", 4 * NS, 1.0, 1000.0) is None  # too few
    assert refused(np.tile(far, (14, 1)), every_s=0.2).regain("fix", round(3.6 * NS), 1.0, 1000.0) is None  # too soon


def test_how_far_it_may_be_off_goes_by_way_and_by_blindness() -> None:
    three_m = np.tile([3.0, 0.0, 0.0], (20, 1))
    seeing = Watch()
    for second in range(1, 61):
        seeing = seeing.seen(second * NS)
    seeing = refused(three_m, seeing, begin_s=41.0)
    assert seeing.blind_until(60 * NS) == 0
    assert seeing.regain("fix", 60 * NS, 1.0, 1000.0) is None  # 60 m of way: 1.7 m
    assert seeing.regain("fix", 60 * NS, 3.0, 1000.0) is not None  # 180 m: 4.1 m
    paused = Watch().seen(10 * NS).seen(15 * NS)  # five seconds without sight, long ago
    for second in range(16, 61):
        paused = paused.seen(second * NS)
    paused = refused(three_m, paused, begin_s=41.0)
    assert paused.regain("fix", 60 * NS, 1.0, 1000.0) is not None  # and 0.25 * 5^2 = 6 m
