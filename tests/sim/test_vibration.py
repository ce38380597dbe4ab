"""Vibration of one recording in the samples of another: only what is fast, at the other's rate, the same every time."""

from pathlib import Path

import numpy as np
import pytest

from vislam.config import VibrationConfig, load
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array, ImuSample
from vislam.core.recording import Recording
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import shaken
from vislam.sim import open_points
from vislam.sim.faults.vibration import ShakenRecording, Vibration
from worlds.recordings import samples

RATE_HZ, HUM_HZ, HUM_M_S2, HUM_RAD_S = 200.0, 40.0, 1.5, 0.2


def flown(seconds: float = 20.0, rate_hz: float = RATE_HZ) -> tuple[np.ndarray, Array]:
    """Return stamps and samples [N, 6] of a body that sways at 0.5 Hz while rotors shake it at 40 Hz."""
    t_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    sway, hum = np.sin(2.0 * np.pi * 0.5 * t_s)[:, None], np.sin(2.0 * np.pi * HUM_HZ * t_s)[:, None]
    gyro = 0.8 * sway + HUM_RAD_S * hum + np.zeros(3)
    accel = 2.0 * sway + HUM_M_S2 * hum + np.array([0.0, 0.0, 9.81])
    return np.round(t_s * 1e9).astype(np.int64) + 7_000_000_000, np.hstack([gyro, accel])


def folder_of(path: Path, t_ns: np.ndarray, values: Array) -> str:
    """Write an ASL folder with an IMU and nothing else."""
    imu = path / "mav0" / "imu0"
    imu.mkdir(parents=True)
    rows = [f"{t}," + ",".join(map(repr, row)) for t, row in zip(t_ns.tolist(), values.tolist(), strict=True)]
    (imu / "data.csv").write_text("#t,wx,wy,wz,ax,ay,az\n" + "\n".join(rows) + "\n")
    (imu / "sensor.yaml").write_text(
        "rate_hz: 200\ngyroscope_noise_density: 1.7e-4\ngyroscope_random_walk: 1.9e-5\n"
        "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
    )
    return str(path)


def values_of(recording: Recording) -> Array:
    return np.array([[*s.gyro_rad_s, *s.accel_m_s2] for s in recording.events() if isinstance(s, ImuSample)])


@pytest.mark.parametrize("rate_hz", [200.0, 400.0, 125.0])
def test_what_is_slow_stays_behind_and_what_is_fast_comes_along(rate_hz: float) -> None:
    readings = Vibration(*flown(), begin_s=3.0, length_s=10.0, above_hz=15.0).at_rate(rate_hz)
    assert len(readings) == pytest.approx(10.0 * rate_hz, abs=5)
    inner = readings[50:-50]
    spectrum = np.abs(np.fft.rfft(inner[:, 5] * np.hanning(len(inner))))
    frequency = np.fft.rfftfreq(len(inner), 1.0 / rate_hz)
    assert frequency[np.argmax(spectrum)] == pytest.approx(HUM_HZ, abs=0.3)
    assert spectrum[frequency < 5.0].max() < 1e-3 * spectrum.max()
    assert inner[:, 5].std() == pytest.approx(HUM_M_S2 / np.sqrt(2.0), rel=0.03)
    assert inner[:, 0].std() == pytest.approx(HUM_RAD_S / np.sqrt(2.0), rel=0.03)


def test_every_sample_is_shaken_and_nothing_else_changes(tmp_path: Path) -> None:
    config = VibrationConfig(folder_of(tmp_path / "flight", *flown()), begin_s=2.0, length_s=3.0)
    plain = open_points("laps", seed=1, duration_s=8.0)
    wrapped = shaken(plain, config)
    assert isinstance(wrapped, ShakenRecording)
    added = values_of(wrapped) - values_of(plain)
    assert added[:, 3:].std(axis=0) == pytest.approx([HUM_M_S2 / np.sqrt(2.0)] * 3, rel=0.05)
    assert np.abs(np.diff(added[:, 5])).max() < 2.1 * HUM_M_S2  # no jump where it turns round after 3 s
    assert [e.t_ns for e in wrapped.events()] == [e.t_ns for e in plain.events()]
    assert wrapped.truth() is not None and wrapped.rig is plain.rig and wrapped.frame_count == plain.frame_count
    assert values_of(wrapped).tobytes() == values_of(wrapped).tobytes()
    twice = shaken(plain, VibrationConfig(config.recording, begin_s=2.0, length_s=3.0, gain=2.0))
    assert np.allclose(values_of(twice) - values_of(plain), 2.0 * added)
    assert shaken(plain, VibrationConfig()) is plain


def test_a_run_feels_it_and_writes_it_down(tmp_path: Path) -> None:
    flight = folder_of(tmp_path / "flight", *flown())
    settings = {"imu.vibration.recording": flight, "loop.enabled": False, "map.enabled": False, "view.enabled": False}
    recording = open_points("laps", seed=1, duration_s=3.0, tracks=60, descriptors=False, camera_hz=10.0)
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    metrics = execute(recording, load(None, settings), out, "points:laps", [])
    # it is above the band of motion: samples shake, and no white noise is learnt from that
    assert metrics["imu_noise"]["accel"]["typical"] < 1.5 * metrics["imu_noise"]["accel"]["told"]
    assert flight in (out / "config.json").read_text()


def test_what_cannot_shake_says_why(tmp_path: Path) -> None:
    t_ns, values = flown(6.0)
    with pytest.raises(DataError, match=r"from 20 s on lasts 0.0 s of a recording of 6.0 s"):
        Vibration(t_ns, values, 20.0, None, 15.0)
    with pytest.raises(DataError, match="nothing above 120 Hz"):
        Vibration(t_ns, values, 0.0, None, 120.0)
    with pytest.raises(DataError, match=r"lasts 0.0 s of a recording of 0.0 s"):
        Vibration(t_ns[:0], values[:0], 0.0, None, 15.0)
    torn = np.delete(np.arange(len(t_ns)), np.arange(500, 520))
    with pytest.raises(DataError, match=r"gap at 2.50 s"):
        Vibration(t_ns[torn], values[torn], 0.0, None, 15.0)
    Vibration(t_ns[torn], values[torn], 3.8, None, 15.0)  # the gap lies outside of the window
    blind = open_points("laps", duration_s=2.0)
    blind.imu_noise = None
    with pytest.raises(UsageError, match="no IMU that could vibrate"):
        shaken(blind, VibrationConfig(folder_of(tmp_path / "flight", t_ns, values)))
    assert samples(open_points("laps", duration_s=1.0))
