"""One clock for what a device stamps: whatever the line under the arrivals does, images stay between the samples."""

import numpy as np

from vislam.config import BridgeClockConfig
from vislam.hw.cameras.realsense import SharedClock

WRAP_US = 2**32
RATE = 1.0001  # device time per host time
HOST_0_NS = 10**12


def device_us(true_ns: int, began_us: int) -> int:
    return (began_us + round((true_ns - HOST_0_NS) * RATE * 1e-3)) % WRAP_US


def played(seconds: float, began_us: int) -> tuple[SharedClock, list[tuple[int, int]]]:
    """A clock after so long at 200 Hz with late arrivals, and true time and stamp of each tick."""
    clock, rng, ticks = SharedClock(BridgeClockConfig(), 0.002), np.random.default_rng(4), []
    for k in range(round(seconds * 200)):
        true_ns = HOST_0_NS + k * 5_000_000
        late_ns = 2_000_000 + round(rng.exponential(3e6))
        stamp_ns = clock.tick(device_us(true_ns, began_us), true_ns + late_ns)
        if stamp_ns is not None:
            ticks.append((true_ns, stamp_ns))
    return clock, ticks


def test_stamps_are_true_and_images_lie_between_samples_across_the_wrap() -> None:
    began_us = WRAP_US - 4_000_000  # wraps after four seconds
    clock, ticks = played(5.0, began_us)
    off_ns = np.array([stamp - true for true, stamp in ticks])
    assert np.abs(off_ns[-200:]).max() < 200_000  # the least late of many
    (true_a, stamp_a), (_, stamp_b) = ticks[-40], ticks[-39]
    found = clock.at(device_us(true_a + 2_500_000, began_us))
    assert found is not None
    assert abs(found - (stamp_a + stamp_b) / 2) < 2_000  # of microseconds the device counts
    ahead = clock.at(device_us(ticks[-1][0] + 20_000_000, began_us))
    assert ahead is not None
    assert abs(ahead - ticks[-1][0] - 20_000_000) < 1_500_000


def test_what_is_of_no_near_tick_is_of_another_clock() -> None:
    clock, ticks = played(4.0, 77)
    assert clock.is_settled
    assert clock.at(device_us(ticks[-1][0], 77) + 2_000_000) is None
    assert clock.at(device_us(ticks[-1][0], 77) - 3_500_000) is None
    fresh = SharedClock(BridgeClockConfig(), 0.0)
    assert fresh.at(5) is None
    assert not fresh.is_settled


def test_a_device_that_began_to_count_anew_begins_a_new_line() -> None:
    clock, ticks = played(3.0, 3_000_000_000)
    now_ns = ticks[-1][0]
    for k in range(400):
        clock.tick(k * 5000, now_ns + 50_000_000 + k * 5_000_000)
    assert clock.steps >= 1
    found = clock.at(399 * 5000 - 2500)
    assert found is not None
    assert abs(found - (now_ns + 50_000_000 + 399 * 5_000_000 - 2_500_000)) < 20_000_000
