"""The noise that the samples show against the noise that the model claims."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inertial_world import NS, Motion

from vislam.imu import ImuNoise, NoiseFloor, SeenNoise
from vislam.messages import ImuSample

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
                rate + noise.gyro_noise_density * white[:3],
                force + noise.accel_noise_density * white[3:],
            )
        )
    return samples


def envelope(model: ImuNoise, samples: list[ImuSample]) -> NoiseFloor:
    found = NoiseFloor(model)
    for sample in samples:
        found.add(sample)
    return found


def test_the_quietest_window_shows_the_sensors_own_noise() -> None:
    ratios = envelope(TRUE, ride(TRUE)).ratios
    assert ratios is not None
    assert ratios.gyro_quiet == pytest.approx(1.0, abs=0.25)
    assert ratios.accel_quiet == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_model_ten_times_off_is_told_and_never_lowered(factor: float) -> None:
    model = replace(
        TRUE,
        gyro_noise_density=factor * TRUE.gyro_noise_density,
        accel_noise_density=factor * TRUE.accel_noise_density,
    )
    found = envelope(model, ride(TRUE))
    warnings = found.warnings(tolerance=3.0)
    assert len(warnings) == 2
    assert "gyroscope" in warnings[0]
    assert "accelerometer" in warnings[1]
    used = found.at_least_seen(tolerance=3.0)
    assert used.gyro_noise_density >= model.gyro_noise_density
    if factor < 1.0:
        assert used.gyro_noise_density > TRUE.gyro_noise_density / 4.0
        assert used.accel_noise_density > TRUE.accel_noise_density / 4.0


def test_a_right_model_gives_no_warning_and_stays() -> None:
    found = envelope(TRUE, ride(TRUE))
    assert found.warnings(tolerance=3.0) == []
    assert found.at_least_seen(tolerance=3.0) == TRUE


def test_too_few_samples_say_nothing() -> None:
    found = envelope(TRUE, ride(TRUE)[:50])
    assert found.ratios is None
    assert found.at_least_seen(3.0) == TRUE
    assert found.warnings(3.0) == []


def test_a_standing_drone_confirms_its_data_sheet(data_root: Path) -> None:
    from vislam.datasets import open_dataset

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


@pytest.mark.parametrize("factor", [0.2, 1.0, 4.0])
def test_the_newest_window_follows_a_ride_in_steps_and_never_goes_below_the_model(factor: float) -> None:
    seen = NoiseFloor(TRUE)
    levels, begins, newest = [], [], SeenNoise(0, 1.0, 1.0)
    for sample in ride(replace(TRUE, gyro_noise_density=factor * 2e-3, accel_noise_density=factor * 3e-2)):
        if seen.add(sample):
            newest = seen.newest_over(TRUE, newest)
            levels.append((newest.gyro, newest.accel))
            begins.append(newest.t_ns)
    assert begins == [round(k * 0.5 * NS) for k in range(len(levels))]
    least, most = max(1.0, factor / 1.5), max(1.0, 1.5 * factor)
    assert all(least <= level <= most for pair in levels for level in pair)
    assert all(len(set(channel)) <= 2 for channel in zip(*levels, strict=True))
