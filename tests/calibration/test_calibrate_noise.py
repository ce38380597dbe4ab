"""Allan deviation: densities with honest sigmas, files that a run takes, and refusals."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.calibration.inertial.noise import allan_curve, fit_noise
from vislam.datasets.imu_files import read_noise
from worlds.calibration import calibrate, refusal, still_imu, write_table

WHITE = np.array([5e-4, 5e-4, 6e-4, 3e-3, 3e-3, 4e-3])
WALK = np.array([2e-5, 2e-5, 2e-5, 2e-4, 2e-4, 2e-4])


def axis(seed: int, white: float, walk: float, duration_s: float = 1800.0, rate_hz: float = 50.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = round(duration_s * rate_hz)
    return rng.normal(0.0, white * np.sqrt(rate_hz), count) + np.cumsum(rng.normal(0.0, walk / np.sqrt(rate_hz), count))


def test_the_deviation_is_that_of_its_definition() -> None:
    values = np.random.default_rng(0).normal(size=200)
    curve = allan_curve(values, 10.0)
    for tau_s, deviation in zip(curve.tau_s, curve.deviation, strict=True):
        m = round(tau_s * 10.0)
        means = np.array([values[k : k + m].mean() for k in range(len(values) - m + 1)])
        assert deviation == pytest.approx(np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2)))


def test_the_curve_that_is_drawn_is_the_one_that_was_measured() -> None:
    curve = allan_curve(axis(0, 0.03, 0.03), 50.0)
    assert fit_noise(curve).deviation(curve.tau_s[:10]) == pytest.approx(curve.deviation[:10], rel=0.2)


def test_errors_are_as_large_as_their_sigmas() -> None:
    white, walk = [], []
    for seed in range(40):
        fit = fit_noise(allan_curve(axis(seed, 0.03, 3e-3), 50.0))
        white.append((fit.white - 0.03) / fit.white_sigma)
        walk.append((fit.walk - 3e-3) / fit.walk_sigma)
    assert 0.75 < np.sqrt(np.mean(np.square(white))) < 1.25
    assert 0.75 < np.sqrt(np.mean(np.square(walk))) < 1.4


def test_a_walk_that_is_not_there_is_bounded_not_invented() -> None:
    fits = [fit_noise(allan_curve(axis(seed, 0.03, 0.0), 50.0)) for seed in range(30)]
    assert sum(fit.walk_determined for fit in fits) <= 4
    assert all(0.0 < fit.walk_limit < 1e-3 for fit in fits)


def test_a_sensor_that_filters_is_fitted_where_it_is_white() -> None:
    fast = axis(1, 0.03, 0.0, rate_hz=200.0)
    filtered = np.convolve(fast, np.full(10, 0.1), "valid")
    fit = fit_noise(allan_curve(filtered, 200.0))
    assert fit.tau_min_s > 0.1
    assert fit.white == pytest.approx(0.03, rel=0.05)


def test_the_verb_writes_a_file_that_kalibr_and_the_config_take(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t_s = np.arange(45_000) / 50.0
    recording = write_table(tmp_path / "still", "imu0", t_s, still_imu(3, 900.0, 50.0, WHITE, WALK))
    shaken = still_imu(4, 60.0, 50.0, np.array([2.0] * 3 + [3.0] * 3) * WHITE, WALK)
    driving = write_table(tmp_path / "driving", "imu0", t_s[:3000], shaken)
    out = tmp_path / "out"
    answer = calibrate(capsys, "noise", recording, "--out", out, "--driving", driving)
    for name, white in zip(answer["axes"], WHITE, strict=True):
        fit = answer["axes"][name]
        assert abs(fit["white"] - white) < 4.0 * fit["white_sigma"]
    assert answer["driving"]["accel_typical"] == pytest.approx(3.0, rel=0.1)
    assert 1.7 < answer["driving"]["accel_quiet"] < 3.0  # the quietest of 120 windows of 25 samples
    written = read_noise(out / "noise.yaml")
    assert written.gyroscope_noise_density == pytest.approx(answer["written"]["gyroscope_noise_density"])
    assert written.accelerometer_noise_density > 1.7 * answer["model"]["accelerometer_noise_density"]
    assert written.rate_hz == pytest.approx(50.0)
    picture = cv2.imread(str(out / "noise.png"))
    assert picture is not None and picture.std() > 10.0
    assert "already holds" in refusal(capsys, "noise", recording, "--out", out, code=2)


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t_s = np.arange(30_000) / 50.0
    still = still_imu(5, 600.0, 50.0, WHITE, WALK)
    out = ("--out", tmp_path / "out")
    short = write_table(tmp_path / "short", "imu0", t_s[:10_000], still[:10_000])
    assert "300 s are the least" in refusal(capsys, "noise", short, *out)
    moved = still.copy()
    moved[14_900:15_100, :3] += 0.5 * np.sin(np.arange(200) / 10.0)[:, None]
    touched = write_table(tmp_path / "moved", "imu0", t_s, moved)
    assert "300 s are the least" in refusal(capsys, "noise", touched, *out)
    holes = write_table(tmp_path / "holes", "imu0", t_s + (np.arange(30_000) // 5000) * 1.0, still)
    assert "without holes" in refusal(capsys, "noise", holes, *out)
    stuck = still.copy()
    stuck[:, 4] = 0.25
    assert "accel y never changes" in refusal(capsys, "noise", write_table(tmp_path / "s", "imu0", t_s, stuck), *out)
    empty = tmp_path / "empty"
    (empty / "mav0" / "imu0").mkdir(parents=True)
    assert "imu0/data.csv" in refusal(capsys, "noise", empty, *out)
    assert "does not exist" in refusal(capsys, "noise", tmp_path / "nowhere", *out)
    assert not list((tmp_path / "out").glob("*"))


def test_the_verb_itself(capsys: pytest.CaptureFixture[str]) -> None:
    assert "there are: " in refusal(capsys, "toaster", code=2)
