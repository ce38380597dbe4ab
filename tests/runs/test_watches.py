"""What camera and IMU deliver, told from samples and frames alone: holes, rates, ranges that end, stuck images."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from vislam.core import Frame, ImuSample, Problems
from vislam.core.streams import StreamJudge
from vislam.frontend.intake import CameraFeed
from vislam.imu import ConditionWatch
from vislam.runs.run_input import RunInput

_NS = 1_000_000_000


def samples(seconds=10.0, rate_hz=200.0, clip_rad_s=np.inf, lsb=0.0):
    rng = np.random.default_rng(2)
    for k in range(round(seconds * rate_hz)):
        t_s = k / rate_hz
        gyro = 2.0 * np.sin([1.1 * t_s, 0.9 * t_s, 1.7 * t_s]) + rng.normal(size=3) * 0.002
        if lsb:
            gyro = np.round(gyro / lsb) * lsb
        accel = np.array([np.sin(2.0 * t_s), 0.0, 9.81]) + rng.normal(size=3) * 0.03
        yield ImuSample(round(t_s * _NS), np.clip(gyro, -clip_rad_s, clip_rad_s), accel)


def condition(values):
    watch = ConditionWatch()
    for value in values:
        watch.add(value)
    return watch.condition()


def test_a_sound_unit_shows_its_rate_its_gravity_and_nothing_else():
    found = condition(samples())
    assert found.rate_hz == pytest.approx(200.0, rel=1e-6)
    assert found.longest_gap_s == 0.0
    assert found.saturated_axes == ()
    assert found.force_m_s2 == pytest.approx(9.83, abs=0.05)


@pytest.mark.parametrize("lsb", [0.0, 0.001, 0.02])
def test_peaks_in_coarse_steps_are_no_saturation(lsb):
    assert condition(samples(lsb=lsb)).saturated_axes == ()


@pytest.mark.parametrize("lsb", [0.0, 0.001])
def test_a_range_that_ends_too_early_is_found_by_its_plateaus(lsb):
    assert condition(samples(lsb=lsb, clip_rad_s=1.5)).saturated_axes == ("gyro x", "gyro y", "gyro z")


def test_samples_that_never_change_are_no_saturation():
    still = [ImuSample(k * 5_000_000, np.zeros(3), np.array([0.0, 0.0, 9.81])) for k in range(2000)]
    assert condition(still).saturated_axes == ()


def test_a_hole_counts_with_its_length_and_jitter_does_not():
    jitter = np.random.default_rng(0)
    late = [ImuSample(s.t_ns + int(jitter.integers(0, 2_000_000)), s.gyro_rad_s, s.accel_m_s2) for s in samples()]
    assert condition(late).longest_gap_s == 0.0
    holed = [s for s in samples() if not 3.0 <= s.t_ns / _NS < 4.5]
    assert condition(holed).longest_gap_s == pytest.approx(1.505, abs=0.001)


def test_nothing_is_said_of_nothing():
    found = condition([])
    assert found.samples == 0
    assert np.isnan(found.rate_hz)
    assert np.isnan(found.force_m_s2)


def images(count, seed=1):
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 255, (48, 64), dtype=np.uint8) for _ in range(count)]


def feed(frames, at_rest=False):
    watch = CameraFeed()
    for t_ns, image in frames:
        watch.add(Frame(t_ns, 0, () if image is None else (image,)))
        watch.moved(at_rest, are_two=False)
    return watch


def test_frames_that_never_arrived_are_counted_by_the_usual_interval():
    kept = [k for k in range(100) if k not in (20, 21, 50)]
    watch = feed([(k * 50_000_000, None) for k in kept])
    assert (watch.frames, watch.missing, watch.repeated) == (97, 3, 0)


def test_images_that_repeat_while_the_body_moves_are_counted():
    seen = images(10)
    stuck = [*seen[:5], *[seen[4]] * 20, *seen[5:]]
    assert feed([(k * 50_000_000, im) for k, im in enumerate(stuck)]).repeated == 20
    assert feed([(k * 50_000_000, im) for k, im in enumerate(stuck)], at_rest=True).repeated == 0
    assert feed([(k * 50_000_000, im) for k, im in enumerate(seen)]).repeated == 0


def test_a_second_camera_and_depth_that_fail_alone_are_named_and_black_from_then_on():
    clear = [np.repeat(np.repeat(im, 4, 0), 4, 1) for im in images(80)]
    depths = [im.astype(np.float32) for im in images(80, seed=2)]
    watch, seen = CameraFeed(), []
    for k in range(60):
        right = clear[79] if k >= 20 else clear[60 - k]
        depth = depths[19] if 19 <= k < 40 else np.zeros_like(depths[0]) if k >= 40 else depths[k]
        seen.append(watch.add(Frame(k * 50_000_000, k, (clear[k], right), depth_m=cv2.resize(depth, (256, 192)))))
        watch.moved(False, are_two=False)
    told = {(e.stream, str(e.happening)): e for e in watch.events}
    assert set(told) == {("cam1", "repeated"), ("depth0", "repeated"), ("depth0", "dark")}
    assert told["cam1", "repeated"].from_ns == 20 * 50_000_000
    assert told["depth0", "repeated"].from_ns == 19 * 50_000_000
    assert [bool(frame.images[1].any()) for frame in seen] == [k < 22 for k in range(60)]
    assert all(frame.images[0].any() for frame in seen)
    assert [k for k, frame in enumerate(seen) if not frame.depth_m.any()] == list(range(30, 60))


def test_images_that_are_stuck_are_told_from_hiccups_and_from_rest():
    seen = images(6)
    stamped = [(k * 50_000_000, im) for k, im in enumerate([*seen, seen[5], seen[5]])]
    assert not feed(stamped[:-1]).is_frozen
    assert feed(stamped).is_frozen and feed(stamped).frozen == 1
    drawn = [seen[0].copy() for _ in range(5)]  # without noise, before a body that stops: few pixels change
    for k, image in enumerate(drawn[:3]):
        image[8 * k] += 1
    assert not feed([(k * 50_000_000, im) for k, im in enumerate([*drawn, drawn[4]])]).is_frozen


@pytest.mark.parametrize(
    ("stepping", "kept_s"), [({"imu0"}, 5.0), ({"cam0"}, 5.5), ({"imu0", "cam0"}, 10.0), ((), 10.0)]
)
def test_inertial_data_end_where_one_clock_steps_alone(stepping, kept_s, tmp_path):
    """At 5 s; what is behind the newest row is left out by the reader, which has judged it."""
    problems = Problems()
    problems.judges = {name: StreamJudge(name) for name in ("imu0", "cam0")}
    streams = {"imu0": [k * _NS // 100 for k in range(1000)], "cam0": [k * _NS // 20 for k in range(200)]}
    values = []
    for name, stamps in streams.items():
        late_ns = [t - _NS if name in stepping and t > 5 * _NS else t for t in stamps]
        kept = [t for t in late_ns if problems.judges[name].takes(t)]
        values += [ImuSample(t, np.zeros(3), np.zeros(3)) if name == "imu0" else Frame(t, 0, ()) for t in kept]
    values.sort(key=lambda value: value.t_ns)
    recording = SimpleNamespace(events=lambda from_ns=None: iter(values), name="a cart", problems=problems)
    run = RunInput(recording, None, tmp_path)
    samples = [value.t_ns for value in run.values(None) if isinstance(value, ImuSample)]
    assert max(samples) * 1e-9 == pytest.approx(min(kept_s, values[-1].t_ns * 1e-9), abs=0.06)
    assert len(run.problems) == (len(stepping) == 1)
