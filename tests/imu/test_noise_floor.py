"""The white noise that the samples show against the noise that the model claims."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vislam.calibration.inertial.noise import driving_floor
from vislam.calibration.inertial.tables import read_inertial
from vislam.config import ImuConfig, MachineConfig
from vislam.core.messages import AS_MODELLED, ImuSample
from vislam.datasets import open_dataset
from vislam.imu import ImuBuffer, ImuNoise, NoiseFloor, join, preintegrate
from worlds.motion import NS, Motion

SEED = 3
RATE_HZ = 200.0
TRUE = ImuNoise(2e-3, 3e-2, 1e-5, 1e-4, RATE_HZ)


def ride(noise: ImuNoise, seconds: float = 10.0) -> list[ImuSample]:
    """Brisk motion with white noise as `noise` says; for the second half at rest."""
    rng = np.random.default_rng(SEED)
    motion = Motion.random(SEED)
    samples = []
    for k in range(int(seconds * RATE_HZ)):
        _, _, rate, force = motion.at(min(k / RATE_HZ, 0.5 * seconds))
        if k / RATE_HZ > 0.5 * seconds:
            rate = np.zeros(3)
        white = rng.normal(size=6) * np.sqrt(RATE_HZ)
        samples.append(
            ImuSample(
                round(k / RATE_HZ * NS),
                rate + noise.gyroscope_noise_density * white[:3],
                force + noise.accelerometer_noise_density * white[3:],
            )
        )
    return samples


def floor(model: ImuNoise, samples: list[ImuSample]) -> NoiseFloor:
    found = NoiseFloor(model)
    for sample in samples:
        found.add(sample)
    return found


def scaled(factor: float) -> ImuNoise:
    return replace(
        TRUE,
        gyroscope_noise_density=factor * TRUE.gyroscope_noise_density,
        accelerometer_noise_density=factor * TRUE.accelerometer_noise_density,
    )


def shaken(samples: list[ImuSample], gyro_rad_s: float, accel_m_s2: float) -> list[ImuSample]:
    """Add vibration above the band that carries motion: three tones between 55 and 90 Hz."""
    tones = np.array([57.0, 71.0, 88.0])
    out = []
    for sample in samples:
        waves = np.sin(2.0 * np.pi * tones * (sample.t_ns / NS) + np.arange(3))
        out.append(
            replace(
                sample,
                gyro_rad_s=sample.gyro_rad_s + gyro_rad_s * waves,
                accel_m_s2=sample.accel_m_s2 + accel_m_s2 * waves,
            )
        )
    return out


@pytest.mark.parametrize("factor", [1.0, 8.0])
def test_true_white_noise_is_found_in_motion_and_at_rest(factor: float) -> None:
    ratios = floor(TRUE, ride(scaled(factor))).ratios
    assert ratios is not None
    assert ratios.gyro_typical == pytest.approx(factor, rel=0.2)
    assert ratios.accel_typical == pytest.approx(factor, rel=0.2)
    assert ratios.gyro_quiet == pytest.approx(factor, rel=0.35)


def test_vibration_above_the_band_of_motion_is_not_white_noise() -> None:
    calm, rough = floor(TRUE, ride(TRUE)), floor(TRUE, shaken(ride(TRUE), 0.3, 5.0))
    assert calm.ratios is not None
    assert rough.ratios is not None
    second_difference = np.std(np.diff([s.accel_m_s2 for s in shaken(ride(TRUE), 0.3, 5.0)], n=2, axis=0))
    assert second_difference / np.sqrt(6.0) > 5.0 * TRUE.accelerometer_noise_density * np.sqrt(RATE_HZ)
    assert rough.ratios.accel_typical < 1.3 * calm.ratios.accel_typical
    assert rough.ratios.gyro_typical < 1.3 * calm.ratios.gyro_typical


@pytest.mark.parametrize("factor", [0.01, 10.0])
def test_a_model_that_cannot_be_right_is_told_and_never_lowered(factor: float) -> None:
    model = scaled(factor)
    found = floor(model, ride(TRUE))
    warnings = found.warnings(tolerance=3.0)
    assert len(warnings) == 2
    assert "gyroscope" in warnings[0]
    assert "accelerometer" in warnings[1]
    used = found.at_least_seen()
    assert used.gyroscope_noise_density == pytest.approx(
        max(model.gyroscope_noise_density, TRUE.gyroscope_noise_density), rel=0.2
    )
    assert used.accelerometer_noise_density == pytest.approx(
        max(model.accelerometer_noise_density, TRUE.accelerometer_noise_density), rel=0.2
    )


def test_a_right_model_gives_no_warning_and_stays() -> None:
    found = floor(TRUE, ride(TRUE))
    assert found.warnings(tolerance=3.0) == []
    assert found.now.scale == AS_MODELLED


def test_too_few_samples_say_nothing() -> None:
    found = floor(TRUE, ride(TRUE)[:50])
    assert found.ratios is None
    assert found.summary() == {}
    assert found.at_least_seen() == TRUE
    assert found.warnings(3.0) == []


def test_a_sensor_too_slow_for_a_band_of_its_own_goes_by_its_model() -> None:
    slow = replace(TRUE, rate_hz=10.0)
    found = floor(slow, ride(TRUE)[::20])
    assert found.ratios is None
    assert found.now.scale == AS_MODELLED


def test_a_hole_begins_a_new_window() -> None:
    samples = ride(TRUE)
    holed = [s for s in samples if not 1.3 < s.t_ns / NS < 1.5]
    ratios = floor(TRUE, holed).ratios
    assert ratios is not None
    assert ratios.accel_typical == pytest.approx(1.0, rel=0.3)


def test_the_scale_follows_a_ride_that_becomes_noisy_and_calm_again() -> None:
    calm, noisy = ride(TRUE, 6.0), ride(scaled(6.0), 12.0)[1200:]
    again = [replace(s, t_ns=s.t_ns + 12 * NS) for s in ride(TRUE, 6.0)]
    found = NoiseFloor(TRUE)
    scales = []
    for sample in [*calm, *noisy, *again]:
        if found.add(sample):
            scales.append((found.now.t_ns / NS, found.now.scale.accel))
    assert max(scale for _, scale in scales) == pytest.approx(6.0, rel=0.35)
    rises = next(t for t, scale in scales if scale > 3.0)
    assert 5.5 < rises < 7.0
    assert found.now.scale.accel < 1.5
    assert max(found.between(0, 5 * NS)) < 1.4
    assert found.between(8 * NS, 11 * NS).accel == pytest.approx(6.0, rel=0.35)
    mixed = found.between(0, 18 * NS).accel
    assert 1.5 < mixed < 6.0


def test_spans_carry_the_noise_that_was_seen_and_preintegration_goes_by_it() -> None:
    buffer = ImuBuffer(ImuConfig(), MachineConfig(), TRUE)
    for sample in ride(scaled(8.0), 5.0):
        buffer.add(sample)
    span = buffer.span(2 * NS, 3 * NS)
    assert span is not None
    assert span.noise.accel == pytest.approx(8.0, rel=0.25)
    told = preintegrate(replace(span, noise=AS_MODELLED), noise=TRUE).covariance
    seen = preintegrate(span, noise=TRUE).covariance
    ratio = np.sqrt(seen[3:6, 3:6].trace() / told[3:6, 3:6].trace())
    assert ratio == pytest.approx(span.noise.accel, rel=0.1)
    halves = join([part for part in (buffer.span(2 * NS, 5 * NS // 2), buffer.span(5 * NS // 2, 3 * NS)) if part])
    np.testing.assert_allclose(halves.noise, span.noise, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "t0_s", "gyro", "accel"),
    [("euroc_v101_imu", 20.0, 0.65e-3, 19e-3), ("euroc_v201_imu", 15.0, 0.59e-3, 22e-3),
     ("euroc_v202_imu", 15.0, 0.86e-3, 25e-3)],
)  # fmt: skip
def test_in_flight_the_floor_is_what_the_imu_errs_by_against_motion_capture(
    data_root: Path, name: str, t0_s: float, gyro: float, accel: float
) -> None:
    """The bars are residuals of quarter- and half-second increments against the truth, as densities."""
    table = read_inertial(data_root / name)
    chosen = table.between(*np.searchsorted(table.t_s, (t0_s, t0_s + 80.0)).tolist())
    found = driving_floor(chosen, ImuNoise(1.7e-4, 2e-3, 2e-5, 3e-3, 200.0))
    summary = found.summary()
    assert gyro / 1.5 < summary["gyro"]["typical"] < 1.5 * gyro
    assert accel / 1.5 < summary["accel"]["typical"] < 1.5 * accel


def test_a_standing_drone_confirms_its_data_sheet(data_root: Path) -> None:
    recording = open_dataset(f"euroc:{data_root / 'euroc_mh01_17s'}")
    assert recording.imu_noise is not None
    found = NoiseFloor(recording.imu_noise)
    for value in recording.events():
        if isinstance(value, ImuSample):
            found.add(value)
    ratios = found.ratios
    assert ratios is not None
    assert 0.5 < ratios.gyro_quiet < 1.5
    assert 0.5 < ratios.accel_quiet < 1.5
