"""Too slow a machine takes fewer frames evenly, says so, and takes all again when it can."""

import numpy as np

from vislam.core.messages import Frame, ImuSample
from vislam.live.pace import MapPace, Pace

PERIOD_NS = 50_000_000  # 20 Hz
RATE_HZ = 200.0


class Camera:
    """A camera that keeps its newest frame, and a machine that needs `work_ns` for each; returns what was taken."""

    def __init__(self) -> None:
        self.pace = Pace(RATE_HZ)
        self.now_ns = self.index = 0

    def runs(self, seconds: float, work_ns: int) -> list[int]:
        taken, end_ns = [], self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self.index = max(self.index + 1, self.now_ns // PERIOD_NS)
            frame = Frame(self.index * PERIOD_NS, self.index, ())
            self.now_ns = max(self.now_ns, frame.t_ns)
            if self.pace.wants(frame):
                taken.append(self.index)
                begun_ns, self.now_ns = self.now_ns, self.now_ns + work_ns
                self.pace.took(frame, begun_ns, self.now_ns, work_ns // 4)
        return taken


def test_a_machine_that_keeps_up_takes_every_frame() -> None:
    camera = Camera()
    taken = camera.runs(20.0, 40_000_000)
    assert camera.pace.every == 1
    assert set(np.diff(taken)) == {1}
    assert camera.pace.counters["frames_left_out"] == camera.pace.counters["frames_dropped"] == 0
    assert camera.pace.counters["busy_percent"] == 80
    assert camera.pace.counters["core_percent"] == 20


def test_a_machine_that_is_too_slow_takes_every_second_frame_evenly() -> None:
    camera = Camera()
    camera.runs(4.0, 70_000_000)
    assert camera.pace.every == 2
    dropped = camera.pace.counters["frames_dropped"]
    assert dropped > 0
    assert set(np.diff(camera.runs(10.0, 70_000_000)[1:])) == {2}
    assert camera.pace.counters["frames_dropped"] <= dropped + 1
    assert camera.pace.counters["late_ms"] < 70


def test_at_most_three_in_four_frames_are_left_out() -> None:
    camera = Camera()
    camera.runs(30.0, 900_000_000)
    assert camera.pace.every == 4


def test_every_frame_is_taken_again_once_there_is_time() -> None:
    camera = Camera()
    camera.runs(8.0, 120_000_000)
    assert camera.pace.every == 4
    camera.runs(30.0, 10_000_000)
    assert camera.pace.every == 1


def test_time_for_half_the_frames_only_is_no_time_for_all() -> None:
    camera = Camera()
    camera.runs(4.0, 70_000_000)
    camera.runs(30.0, 60_000_000)
    assert camera.pace.every == 2


def test_an_unplugged_camera_is_not_the_machine() -> None:
    camera = Camera()
    taken = camera.runs(5.0, 1_000_000)
    camera.now_ns += 5_000_000_000
    taken += camera.runs(5.0, 1_000_000)
    assert camera.pace.counters["frames_dropped"] == 0
    assert camera.pace.counters["frames_offered"] == len(taken)
    assert camera.pace.every == 1


def test_what_comes_while_vision_works_for_long_is_dropped_and_no_outage() -> None:
    camera = Camera()
    camera.runs(1.0, 1_000_000)
    camera.runs(3.0, 3_000_000_000)
    camera.runs(1.0, 1_000_000)
    assert camera.pace.counters["frames_dropped"] == 59
    assert camera.pace.counters["busy_percent"] <= 100


def test_the_map_takes_fewer_keyframes_the_later_it_is() -> None:
    pace = MapPace(2.0)
    assert [pace.wants(0.9) for _ in range(4)] == [True] * 4
    assert [pace.wants(1.5) for _ in range(4)] == [False, True, False, True]
    assert [pace.wants(2.5) for _ in range(4)] == [False] * 4
    assert pace.wants(0.1)
    assert (pace.left_out, pace.latest_s) == (6, 2.5)


def test_a_slow_map_is_never_far_behind() -> None:
    """A keyframe every 0.2 s, and a map that needs 0.5 s for each."""
    pace, now_s, taken, latest_s = MapPace(2.0), 0.0, 0, 0.0
    for k in range(500):
        now_s = max(now_s, 0.2 * k)
        latest_s = max(latest_s, now_s - 0.2 * k)
        if pace.wants(now_s - 0.2 * k):
            now_s, taken = now_s + 0.5, taken + 1
    assert latest_s < 2.5
    assert taken > 180  # of the 200 that there is time for


def test_a_sensor_slower_than_told_is_not_the_machine() -> None:
    pace = Pace(RATE_HZ)
    for k in range(1000):
        pace.add_sample(ImuSample(10_000_000 * (k + (k > 500)), np.zeros(3), np.zeros(3)))
    assert pace.counters["samples_missed"] == 1


def test_inertial_samples_that_did_not_come_are_counted() -> None:
    pace = Pace(RATE_HZ)
    for k in [*range(10), *range(14, 20), 21]:
        pace.add_sample(ImuSample(round(k * 1e9 / RATE_HZ) + 300_000 * (k % 3), np.zeros(3), np.zeros(3)))
    pace.add_sample(ImuSample(5_000_000_000, np.zeros(3), np.zeros(3)))  # it was unplugged
    assert pace.counters["samples"] == 18
    assert pace.counters["samples_missed"] == 5
