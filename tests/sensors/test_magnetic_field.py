"""The machine's magnetometer as a sensor: it holds heading, is believed as far as it is right, and needs no wiring."""

import numpy as np
import pytest
from scipy.stats import chi2

from vislam.core.messages import Array, MagSample
from vislam.core.readings import OwnStart, Reading
from vislam.pipeline.reading_intake import ReadingIntake
from vislam.sensors import BodyState, Suite
from vislam.sensors.kinds import MagneticField, MagneticFieldSettings
from vislam.sensors.toml import load_sensor_setup
from worlds import monte_carlo as mc
from worlds.sensed_paths import KINDS, SensedRun, body_of_truth, made

EARTH_UT = np.array([18.0, 6.0, -42.0])
EVERY = 10  # samples of the IMU
RUNS = 16


def field_run(seed: int, duration_s: float, sensor: MagneticField) -> SensedRun:
    """A run with the field of the earth, which the filter begins with as the sensor's first reading has it."""
    run, rng = SensedRun.make(seed, duration_s, {}, {}), np.random.default_rng([seed, 3])
    for k in range(EVERY, len(run.way.t_ns), EVERY):
        body = body_of_truth(run.way, k)
        run.readings.append(Reading("field", body.t_ns, sensor.draw(body, EARTH_UT, rng)))
    first = run.readings.pop(0)
    T_odom_body = run.start.T_world_body
    begun = sensor.begin([first], [BodyState(first.t_ns, T_odom_body[:3, :3], T_odom_body[:3, 3], *np.zeros((4, 3)))])
    assert begun is not None
    run.starts.append(OwnStart("field", begun.values, begun.sigmas))
    return run


def heading_sigma_rad(T_world_body: Array, covariance: Array) -> float:
    """Return the sigma about up; covariance [3, 3] is about the body's axes."""
    up = T_world_body[2, :3]
    return float(np.sqrt(up @ covariance @ up))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_holds_heading_as_well_as_it_says(kind: str) -> None:
    """Without it a cheap gyroscope's heading spreads; with it errors stay within what the first one was."""
    sensor = MagneticField(MagneticFieldSettings(sigma_ut=1.0))
    nees, own, sigmas = [], [], {True: [], False: []}
    for seed in range(RUNS):
        run = field_run(8000 + seed, 20.0, sensor)
        readings = run.readings
        for with_field in (True, False) if seed < 4 else (True,):  # a sigma hardly depends on the noise
            run.readings = readings if with_field else []
            k, ekf = list(run.replay(made(kind, Suite({"field": sensor}))))[-1]
            state = ekf.state()
            sigmas[with_field].append(heading_sigma_rad(state.T_world_body, state.covariance[:3, :3]))
            if with_field:
                error = run.way.error(k, state)[:3]
                nees.append(error @ np.linalg.solve(state.covariance[:3, :3], error))
                off = EARTH_UT - ekf.own("field")[0]
                own.append(off @ np.linalg.solve(ekf.own_covariance("field"), off))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * RUNS) / RUNS
    ratio = np.mean(sigmas[True][:4]) / np.mean(sigmas[False])
    print(f"{kind}: NEES {np.mean(nees):.2f} and {np.mean(own):.2f} of 3, {low:.2f} .. {high:.2f}; sigma x {ratio:.2f}")
    assert low < np.mean(nees) < high
    assert low < np.mean(own) < high
    assert ratio < 0.8


def test_its_first_reading_says_where_to_be_linear_and_no_more() -> None:
    body = body_of_truth(mc.drive("hand", 1, 2.0), 100)
    reading = Reading("field", 0, body.R_world_body.T @ EARTH_UT)
    begun = MagneticField().begin([reading], [body])
    assert begun is not None
    np.testing.assert_allclose(begun.values, EARTH_UT, atol=1e-9)
    np.testing.assert_array_equal(begun.sigmas, [60.0] * 3)
    told = MagneticField(MagneticFieldSettings(field_ut=(20.0, 0.0, -40.0), field_sigma_ut=5.0))
    begun = told.begin([reading], [body])
    assert begun is not None
    np.testing.assert_array_equal(begun.values, [20.0, 0.0, -40.0])
    np.testing.assert_array_equal(begun.sigmas, [5.0] * 3)


@pytest.mark.parametrize("values", [(0.0, 0.0, 0.0), (0.2, 0.0, -0.42), (20_000.0, 0.0, -42_000.0)])
def test_a_disconnected_chip_and_other_units_are_refused(values: tuple[float, ...]) -> None:
    assert "uT, 2 to 1000 asked" in MagneticField().check(np.array(values))


def test_samples_of_the_magnetometer_are_its_readings_and_those_of_nobody_else(tmp_path) -> None:
    path = tmp_path / "cart.toml"
    path.write_text(
        '[sensors.compass]\nkind = "magnetic_field"\n[sensors.drawn]\nkind = "magnetic_field"\nsimulated_hz = 10.0\n'
        '[sensors.height]\nkind = "height"\nsimulated_hz = 10.0\n'
    )
    suite = load_sensor_setup(path).suite
    intake = ReadingIntake(suite, None, None, 9.81)
    assert intake.report()["compass"]["note"] == "no reading came"
    for k in range(3):
        intake.add_field(MagSample(k * 20_000_000, EARTH_UT))
    intake.add_field(MagSample(80_000_000, np.zeros(3)))
    assert intake.counters["compass"]["readings"] == 4
    assert intake.counters["compass"]["unusable"] == 1
    assert intake.counters["drawn"]["readings"] == intake.counters["height"]["readings"] == 0
    assert "note" in intake.report()["compass"]
