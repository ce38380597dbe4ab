"""Faults at a moment: what they change, when, and that they leave the rest as it was."""

from types import SimpleNamespace

import numpy as np
import pytest
from faults.sensor_faults import BREAKS, FAULTS, FaultyRecording

from vislam.core.camera import Camera, Rig
from vislam.core.messages import Frame, ImuSample
from vislam.core.streams import Happening, StreamJudge
from vislam.core.trajectory import Trajectory
from vislam.imu import ImuNoise
from vislam.imu.series import AXES

LENGTH_S, FROM_S = 10.0, 4.02
BEGIN_NS = 5_001_000_000 + round(FROM_S * 1e9)


def values():
    """A stereo pair with depth at 10 Hz and an inertial unit at 200 Hz, whose numbers are all different."""
    rng = np.random.default_rng(1)
    for i in range(int(LENGTH_S * 200)):
        t_ns = 5_000_000_000 + i * 5_000_000
        if i >= 100:  # the camera starts later
            yield ImuSample(t_ns, rng.normal(size=3), rng.normal(size=3) + 9.81)
        if i % 20 == 0:
            images = tuple(rng.integers(0, 255, (48, 64), dtype=np.uint8) for _ in range(2))
            yield Frame(t_ns + 1_000_000, i // 20, images, None, rng.random((48, 64), np.float32))


def recording():
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    right = np.eye(4)
    right[0, 3] = 0.1
    t_ns = np.arange(5_000_000_000, 16_000_000_000, 10_000_000)
    poses = np.tile(np.eye(4), (len(t_ns), 1, 1))
    poses[:, 0, 3] = t_ns * 1e-9
    noise = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4, 200.0)
    return SimpleNamespace(
        name="made", rig=Rig((camera, camera), (np.eye(4), right), True), imu_noise=noise, frame_count=100,
        problems={}, events=values, truth=lambda: Trajectory(t_ns, poses),
    )  # fmt: skip


def rows(value):
    """Numbers of a value, and its time."""
    if isinstance(value, ImuSample):
        return (value.t_ns, *value.gyro_rad_s, *value.accel_m_s2)
    return (value.t_ns, *(image.tobytes() for image in value.images), value.depth_m.tobytes())


def faulty(fault, seed=0):
    made = FaultyRecording(recording(), fault, seed, from_s=FROM_S)
    return made, list(made.events())


@pytest.mark.parametrize("fault", BREAKS)
def test_a_break_changes_something_and_nothing_before_its_moment(fault):
    made, changed = faulty(fault)
    whole = list(values())
    before = [rows(v) for v in whole if v.t_ns < BEGIN_NS]
    assert [rows(v) for v in changed[: len(before)]] == before
    left_out = [e for judge in made.problems.judges.values() for e in judge.events if e.happening != Happening.HOLE]
    assert left_out or [rows(v) for v in changed] != [rows(v) for v in whole]
    assert made.from_s == FROM_S < made.to_s


@pytest.mark.parametrize("fault", [name for name, f in BREAKS.items() if f.lasts_s[1] < LENGTH_S and f.steps_s == 0.0])
def test_what_lasts_some_seconds_is_over_after_them(fault):
    made, changed = faulty(fault)
    least_s, most_s = BREAKS[fault].lasts_s
    assert least_s - 1e-9 <= made.to_s - made.from_s <= most_s + 1e-9
    end_ns = 5_001_000_000 + round(made.to_s * 1e9)
    after = [rows(v) for v in values() if v.t_ns >= end_ns]
    assert [rows(v) for v in changed[-len(after) :]] == after
    assert made.to_s != faulty(fault, 1)[0].to_s or least_s == most_s


BY_TIMES = [
    (fault, event)
    for fault, known in BREAKS.items()
    for event in known.named
    if event.startswith(("imu0", "cam0"))
    and not event.endswith(("?", "dark", "repeated", "blurred", "clipped", "moving", "contradicting"))
]


@pytest.mark.parametrize(("fault", "event"), BY_TIMES)
def test_the_events_that_a_break_is_are_those_that_the_judge_of_a_stream_sees(fault, event):
    """Of times and of inertial numbers; what images and long stretches of samples show is judged elsewhere.

    So is what two streams together show: see tests/imu/test_witness.py.
    """
    made, changed = faulty(fault)
    judges = [StreamJudge("imu0", AXES, 0.1), StreamJudge("cam0", hole_s=0.25)]
    for value in changed:
        is_frame = isinstance(value, Frame)
        judges[is_frame].takes(value.t_ns, () if is_frame else rows(value)[1:])
    events = [e for judge in (*judges, *made.problems.judges.values()) for e in judge.events]
    found = [e for e in events if f"{e.stream.split()[0]} {e.happening}" == event]
    assert any(abs(e.from_ns - BEGIN_NS) <= 1.1e8 for e in found), events


def test_events_are_of_a_kind_that_there_is():
    kinds = {event.split(" ", 1)[1] for fault in BREAKS.values() for event in fault.named}
    assert kinds <= {*map(str, Happening), "?"}


def test_frames_after_a_step_of_the_clock_are_torn_from_those_before():
    frames = [value for value in faulty("camera back")[1] if isinstance(value, Frame)]
    torn = [frame.t_ns for frame in frames if frame.follows_step]
    assert len(torn) == 1 and torn[0] > BEGIN_NS


@pytest.mark.parametrize(("fault", "by_s"), [("all back 1", -1.0), ("all forth", 5.0), ("glued", -2.0)])
def test_the_truth_keeps_to_the_clock_of_the_frames(fault, by_s):
    made, _ = faulty(fault)
    truth = made.truth()
    late = truth.t_ns >= BEGIN_NS
    shift_s = truth.t_ns * 1e-9 - truth.positions_m[:, 0]  # positions are the times at which they were true
    assert np.allclose(shift_s[~late], 0.0) and np.allclose(shift_s[late], by_s)
    assert 0 < late.sum() < len(late)


def test_what_a_recording_lacks_is_not_spared():
    whole, blind = recording(), recording()
    blind.imu_noise = None
    assert FAULTS["camera hole 0.3"].spared(whole) and not FAULTS["camera hole 0.3"].spared(blind)
    assert not FAULTS["black"].spared(whole)
