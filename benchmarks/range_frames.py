"""How soon and how well the frame of anchors is found from ranges: python benchmarks/range_frames.py [ROOMS].

Four anchors in a room of 8 x 6 m, a path of 4 m with a height that changes by 1.6 m, ranges with a sigma of 5 cm, the
heading and place of the start drawn anew for each room.
"""

import math
import sys
import time

import numpy as np

from vislam.core.geometry import so3_exp
from vislam.sensors import BodyState
from vislam.sensors.kinds import AnchorRange, AnchorRangeSettings
from vislam.sensors.simulated import drawn_readings

ROOM = {"1": (0.0, 0.0, 2.5), "2": (8.0, 0.0, 2.2), "3": (8.0, 6.0, 0.5), "4": (0.0, 6.0, 2.0)}
STEP = 6  # readings between two attempts


def path() -> list[BodyState]:
    """Return a body every eighth of a second."""
    bodies = []
    for s in np.arange(0.0, 30.0, 0.125):
        place = np.array([2.0 * math.sin(0.5 * s), 2.0 - 2.0 * math.cos(0.31 * s), 0.8 * math.sin(0.7 * s)])
        turned = so3_exp(np.array([0.0, 0.0, 0.4 * s])) @ so3_exp(np.array([0.1 * math.sin(s), 0.05, 0.0]))
        bodies.append(BodyState(int(s * 1e9), turned, place, *[np.zeros(3)] * 4))
    return bodies


def main(rooms: int) -> None:
    """Print readings until the beginning, errors in sigmas, and the time of an attempt."""
    sensor, bodies = AnchorRange(AnchorRangeSettings(ROOM, sigma_m=0.05, lever_m=(0.1, 0.0, 0.3))), path()
    counts, off, seconds = [], [], []
    for seed in range(rooms):
        rng = np.random.default_rng(seed)
        truth = np.array([rng.uniform(-math.pi, math.pi), *rng.uniform([2.0, 1.0, 0.5], [5.0, 4.0, 1.5])])
        readings = drawn_readings("uwb", sensor, bodies, truth, seed)
        for count in range(STEP, len(readings), STEP):
            begin = time.process_time()
            found = sensor.begin(readings[:count], bodies[:count])
            if count >= 20:
                seconds.append(time.process_time() - begin)
            if found is not None:
                break
        assert found is not None, f"room {seed} never began"
        away = found.values - truth
        away[0] = (away[0] + math.pi) % (2.0 * math.pi) - math.pi
        counts.append(count)
        off.append(away / found.sigmas)
    print(f"{rooms} rooms: began after {np.median(counts):.0f} ranges in the median, {max(counts)} at most")
    print(f"errors: {np.abs(off).max():.1f} sigmas at most, {np.mean(np.square(off)):.2f} in the mean square")
    print(f"an attempt: {1e3 * np.median(seconds):.0f} ms")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
