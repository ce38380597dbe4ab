"""The bridge's clock: device stamps become host time whatever delays, drift, wraps, restarts and sleep do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import BridgeClockConfig
from vislam.hw.bridge.clock import DeviceClock

PERIOD_NS = 2_500_000
HOST_BEGIN_NS = 5_000_000_000_000


def feed(
    clock: DeviceClock, true_ns: np.ndarray, device_us: np.ndarray, delay_ns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and true times of what was passed."""
    pairs = []
    arrival_ns = np.maximum.accumulate(true_ns + delay_ns)  # a serial line keeps the order
    for t_ns, us, at_ns in zip(true_ns.tolist(), device_us.tolist(), arrival_ns.tolist(), strict=True):
        stamp = clock.stamp(us % 2**32, at_ns)
        if stamp is not None:
            pairs.append((stamp, t_ns))
    stamps, truth = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    assert (np.diff(stamps) > 0).all()
    return stamps, truth


def delays(count: int, seed: int) -> np.ndarray:
    """Delays of a busy host: 1 ms at least, 0.1 ms of jitter, stalls of up to 0.3 s now and then."""
    rng = np.random.default_rng(seed)
    delay = 1e6 + rng.exponential(1e5, count)
    for begin in rng.integers(400, count, count // 2000):
        length = int(rng.integers(1, 120))
        delay[begin : begin + length] += np.linspace(length * PERIOD_NS, 0, length)[: count - begin]
    return delay.astype(np.int64)


def run(count: int, drift: float, device_begin_us: int = 0) -> tuple[np.ndarray, np.ndarray]:
    elapsed_ns = np.arange(count) * PERIOD_NS
    return HOST_BEGIN_NS + elapsed_ns, device_begin_us + (elapsed_ns * (1 + drift) / 1000).astype(np.int64)


@settings(max_examples=6)
@given(st.floats(-0.02, 0.02), st.integers(0, 2**32 - 1), st.integers(0, 1000))
def test_drift_jitter_stalls_and_wraps_move_no_stamp(drift: float, device_begin_us: int, seed: int) -> None:
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(12_000, drift, device_begin_us)
    stamps, truth = feed(clock, true_ns, device_us, delays(len(true_ns), seed))
    error_ns = stamps - truth - 1_000_000  # the constant part of the delay is nobody's to know
    assert len(stamps) >= len(true_ns) - 300  # all but the first half second
    assert np.abs(error_ns[truth > HOST_BEGIN_NS + 5e9]).max() < 0.1e6
    assert np.abs(error_ns).max() < 2e6
    interval_ns = np.diff(stamps)
    assert np.abs(interval_ns - PERIOD_NS).max() < 0.06 * PERIOD_NS
    assert abs(clock.rate * (1 + drift) - 1) < 5e-5
    assert clock.steps == clock.doubted == 0


def test_a_wrap_after_71_minutes_is_no_step() -> None:
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(8000, 0.01, 2**32 - 10_000_000)
    assert device_us[0] < 2**32 < device_us[-1]
    stamps, truth = feed(clock, true_ns, device_us, delays(8000, 1))
    assert clock.steps == clock.doubted == 0
    assert np.abs(stamps - truth - 1e6).max() < 2e6


@pytest.mark.parametrize("ran_s", [0.6, 30.0, 3000.0])
def test_a_restarted_device_gets_a_new_line_without_loss_of_rate(ran_s: float) -> None:
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(4000, 0.02, int(ran_s * 1e6))
    feed(clock, true_ns, device_us, delays(4000, 2))
    after_ns = true_ns + 4000 * PERIOD_NS + 2_000_000_000  # boots for 2 s
    stamps, truth = feed(clock, after_ns, (np.arange(4000) * 2550).astype(np.int64), delays(4000, 3))
    assert (clock.steps, clock.doubted) == (1, 1)
    assert len(stamps) >= 3998
    assert np.abs(stamps - truth - 1e6).max() < 2e6
    assert stamps[0] > true_ns[-1]


def test_a_host_that_slept_is_one_step() -> None:
    """CLOCK_MONOTONIC stands still in sleep while the device runs on."""
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(8000, -0.01)
    device_us[4000:] += 30_000_000
    stamps, truth = feed(clock, true_ns, device_us, delays(8000, 4))
    assert clock.steps == 1
    error_ns = np.abs(stamps - truth - 1e6)
    assert error_ns.max() < 5e6  # the first arrival on the new line may have been delayed
    assert error_ns[(truth < true_ns[4000]) | (truth > true_ns[4000] + 1e9)].max() < 2e6


def test_a_device_clock_that_lost_time_is_one_step() -> None:
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(8000, 0.0)
    device_us[4000:] -= 400_000  # interrupts were off for 0.4 s
    keep = np.r_[0:4000, 4160:8000]
    stamps, truth = feed(clock, true_ns[keep], device_us[keep], delays(8000, 5)[keep])
    assert clock.steps == 1
    late = truth > true_ns[4160] + 2.5e9
    assert np.abs(stamps - truth - 1e6)[late].max() < 2e6


def test_a_burst_after_a_long_stall_of_the_host_is_no_step() -> None:
    """What waited 5 s in the kernel comes at once."""
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(8000, 0.015)
    delay = delays(8000, 6)
    delay[3000:5000] += (true_ns[5000] - true_ns[3000:5000]).astype(np.int64)
    stamps, truth = feed(clock, true_ns, device_us, delay)
    assert clock.steps == clock.doubted == 0
    assert np.abs(stamps - truth - 1e6).max() < 2e6


@pytest.mark.parametrize("late", [400, 720])
def test_stamps_that_a_late_begin_bent_are_taken_back_before_a_hole(late: int) -> None:
    """Samples of a second or two, from the first on, come one soon after another."""
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(8000, 0.003)
    feed(clock, true_ns[:2000], device_us[:2000], delays(2000, 7))
    clock.restart()
    waited_ns = np.maximum(true_ns[2000 + late] + np.arange(6000) * 50_000 - true_ns[2000:], 0)
    stamps, truth = feed(clock, true_ns[2000:], device_us[2000:] - device_us[2000], 1_000_000 + waited_ns)
    error_ns = np.abs(stamps - truth - 1e6)
    wrong = np.flatnonzero(error_ns > 3e6)
    assert len(wrong) < 60
    assert stamps[wrong[-1] + 1] - stamps[wrong[-1]] > 0.85 * error_ns.max()
    assert clock.steps == 2


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1000, 1900))
def test_one_absurd_stamp_is_left_out(wrong_us: int, at: int) -> None:
    clock = DeviceClock(BridgeClockConfig())
    true_ns, device_us = run(2000, 0.01, 1_000_000)
    if abs(wrong_us - int(device_us[at])) < 200_000:
        return
    device_us[at] = wrong_us
    stamps, truth = feed(clock, true_ns, device_us, np.full(2000, 1_000_000))
    assert (clock.steps, clock.doubted) == (0, 1)
    assert len(stamps) >= 2000 - 300
    assert np.abs(stamps - truth - 1e6).max() < 1e6


def test_intervals_of_what_is_stamped_besides_stay_true_while_the_line_gets_better() -> None:
    clock, besides = DeviceClock(BridgeClockConfig()), []
    true_ns, device_us = run(2000, 0.01)
    delay_ns = np.where(true_ns < HOST_BEGIN_NS + 1e9, 90_000_000, 1_000_000)  # the host was busy when it began
    arrival_ns = np.maximum.accumulate(true_ns + delay_ns)
    for k, (us, at_ns) in enumerate(zip(device_us.tolist(), arrival_ns.tolist(), strict=True)):
        stamp = clock.stamp(us, at_ns)
        if k % 8 == 7 and stamp is not None:
            besides.append(clock.host_ns(us + 1000))
            assert abs(besides[-1] - stamp - 1e6) < 0.06e6  # beside the sample: wheels and IMU have one time
    intervals_ns = np.diff(besides)
    assert len(intervals_ns) > 150
    assert np.abs(intervals_ns - 8 * PERIOD_NS).max() < 0.08 * 8 * PERIOD_NS
