"""What is told of a stream: repeated, late and missing rows, steps of the clock, and nothing where nothing happened."""

import json
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.core.stream_axes import Axis
from vislam.core.streams import Happening, Repeats, StreamJudge, is_dark, together

STEP_NS = 5_000_000
AXES = [Axis(name, 10.0, 1e3) for name in ("a x", "a y", "a z", "b x", "b y", "b z")]


def fed(rows: list[tuple[int, list[float]]]) -> tuple[StreamJudge, list[bool]]:
    judge = StreamJudge("imu0", AXES, 0.1)
    return judge, [judge.takes(t_ns, row) for t_ns, row in rows]


def stream(count: int, resolution: float = 0.0, sigma: float = 1.0) -> list[tuple[int, list[float]]]:
    values = sigma * np.random.default_rng(3).normal(size=(count, 6))
    if resolution:
        values = np.round(values / resolution) * resolution
    return [(k * STEP_NS, row) for k, row in enumerate(np.clip(values, -9.0, 9.0).tolist())]


@pytest.mark.parametrize(("resolution", "sigma"), [(0.0, 1.0), (1.0, 1.0), (1.0, 0.3), (1.0, 0.0)])
def test_chance_repeats_rows_of_a_coarse_or_resting_sensor_and_is_no_event(resolution: float, sigma: float) -> None:
    judge, taken = fed(stream(20_000, resolution, sigma))
    assert all(taken)
    assert judge.events == []


@pytest.mark.parametrize("resolution", [0.0, 1.0])
def test_a_stuck_sensor_is_named_from_its_first_repetition_and_refused_until_it_lives(resolution: float) -> None:
    rows = stream(3000, resolution)
    stuck = [(t_ns, rows[1999][1]) if 2000 <= k < 2600 else (t_ns, row) for k, (t_ns, row) in enumerate(rows)]
    judge, taken = fed(stuck)
    (event,) = judge.events
    assert (event.happening, event.stream) == (Happening.STUCK, "imu0")
    assert abs(event.from_ns - 1999 * STEP_NS) <= STEP_NS
    assert event.to_ns == 2599 * STEP_NS
    assert not any(taken[2010:2600])
    assert all(taken[2600:])
    assert judge.refused["stuck"] == event.rows >= 590


@pytest.mark.parametrize("resolution", [0.0, 0.2])
def test_an_axis_that_is_stuck_alone_is_named_and_one_that_rests_or_is_cut_off_with_others_is_not(
    resolution: float,
) -> None:
    rows = stream(3000, resolution)
    held = [
        (t, [*row[:2], rows[1999][1][2], *row[3:]]) if 2000 <= k < 2600 else (t, row) for k, (t, row) in enumerate(rows)
    ]
    judge, taken = fed(held)
    (event,) = judge.events
    assert (event.happening, event.stream, event.to_ns) == (Happening.STUCK, "imu0 a z", 2599 * STEP_NS)
    assert abs(event.from_ns - 1999 * STEP_NS) <= STEP_NS
    assert not any(taken[2020:2600]) and all(taken[2600:]) and judge.refused["stuck"] == event.rows
    rests = stream(3000, resolution, 1.0)[:2000] + stream(3000, resolution, 0.5 * resolution)[2000:]
    cut_off = [
        (t, [*row[:2], min(row[2], 0.4), *row[3:]]) if k >= 2000 else (t, row) for k, (t, row) in enumerate(rows)
    ]
    high = [(t, [*row[:2], 9.0, *row[3:]]) if k >= 2000 else (t, row) for k, (t, row) in enumerate(rows)]
    assert fed(rests if resolution else rows)[0].events == fed(high)[0].events == []
    assert [e.stream for e in fed(cut_off)[0].events] == []


def test_single_rows_far_off_are_left_out_and_named_and_a_motion_that_goes_on_is_taken() -> None:
    axes = [axis._replace(most=1e3, leap=100.0) for axis in AXES]
    rows, far = stream(1000), {200: 150.0, 400: 150.0, 401: -150.0, 999: 150.0}
    rows = [(t_ns, [far.get(k, row[0]), *row[1:]]) for k, (t_ns, row) in enumerate(rows)]
    judge = StreamJudge("imu0", axes, 0.1)
    taken = [judge.takes(t_ns, row) for t_ns, row in rows]
    assert [k for k, is_taken in enumerate(taken) if not is_taken] == list(far)
    assert [(e.happening, e.from_ns // STEP_NS, e.rows) for e in judge.events] == [
        (Happening.SPIKE, 200, 1),
        (Happening.SPIKE, 400, 2),
    ]
    judge, shift = StreamJudge("imu0", axes, 0.1), 300.0
    moved = [judge.takes(t_ns, [row[0] + shift * (k >= 500), *row[1:]]) for k, (t_ns, row) in enumerate(stream(1000))]
    assert [k for k, is_taken in enumerate(moved) if not is_taken] == [500] and judge.events == []


def test_holes_are_told_by_the_rate_of_the_stream_itself() -> None:
    rows = stream(1000)
    judge, _ = fed([*rows[:400], *rows[402:600], *rows[700:]])
    (event,) = judge.events
    assert (event.happening, event.from_ns, event.to_ns, event.rows) == (
        Happening.HOLE, 599 * STEP_NS, 700 * STEP_NS, 100,
    )  # fmt: skip


def test_rows_that_come_late_are_left_out_and_a_clock_that_steps_back_is_named_as_one_event() -> None:
    rows = stream(1000)
    late = [*rows[:500], (rows[490][0] + 1, rows[490][1]), *rows[500:]]
    judge, taken = fed(late)
    assert [(e.happening, e.rows) for e in judge.events] == [(Happening.LATE, 1)]
    assert taken.count(False) == 1
    back = [(t_ns - 1_000_000_001 * (k >= 500), row) for k, (t_ns, row) in enumerate(rows)]
    judge, taken = fed(back)
    (event,) = judge.events
    assert (event.happening, event.from_ns, event.to_ns) == (Happening.STEP_BACK, rows[499][0], back[500][0])
    assert "by 1.00 s at 2.50 s" in event.words(0).replace("1.005", "1.00")
    assert taken.count(False) == event.rows == 200
    assert all(taken[:500] + taken[700:])


def test_what_is_no_number_or_beyond_any_sensor_is_no_measurement() -> None:
    rows = stream(300)
    for k, value in ((100, np.nan), (101, np.inf), (102, 1e9)):
        rows[k] = (rows[k][0], [*rows[k][1][:5], value])
    rows.insert(200, rows[199])
    judge, taken = fed(rows)
    assert [(e.happening, e.rows) for e in judge.events] == [(Happening.UNUSABLE, 3), (Happening.DUPLICATE, 1)]
    assert taken.count(False) == 4
    entry = judge.events[0].entry(STEP_NS)
    assert (entry["from_s"], entry["to_s"]) == pytest.approx((0.495, 0.505))


def test_a_stream_of_nothing_but_events_stays_small() -> None:
    judge = StreamJudge("imu0", AXES, 0.1)
    for k in range(400):
        judge.takes(k * 1_000_000_000, [np.nan] * 6)
    assert len(judge.events) <= 50
    assert sum(event.rows for event in judge.events) == 400


def judged(
    times_ns: list[int], rows: list[list[float]] | None = None, hole_s: float = 0.0, rate_hz: float = 0.0, recorded=True
) -> StreamJudge:
    judge = StreamJudge("imu0", (), hole_s, rate_hz, recorded)
    for k, t_ns in enumerate(times_ns):
        judge.takes(t_ns, () if rows is None else rows[k])
    return judge


def ticks(count: int, jitter_s: float = 0.0, begin_s: float = 0.0, rate_hz: float = 200.0) -> list[int]:
    """Times of an even rate with a uniform jitter."""
    jitter = np.random.default_rng(4).uniform(0.0, jitter_s, count) if jitter_s else np.zeros(count)
    return np.rint((begin_s + np.arange(count) / rate_hz + jitter) * 1e9).astype(np.int64).tolist()


def kinds(judge: StreamJudge) -> list[tuple[str, float, float]]:
    return [(str(e.happening), round(e.from_ns * 1e-9, 3), round(e.to_ns * 1e-9, 3)) for e in judge.events]


@pytest.mark.parametrize("apart_ns", [0, 100_000, 600_000])
@pytest.mark.parametrize("held_s", [0.05, 0.4])
def test_rows_that_waited_and_were_stamped_on_arrival_are_a_burst_and_no_hole(apart_ns: int, held_s: float) -> None:
    times, waiting = [], 0
    for t_ns in ticks(2000, 0.0005):
        waiting = waiting + 1 if 4.0 <= t_ns * 1e-9 < 4.0 + held_s else 0
        times.append(t_ns if not waiting else round((4.0 + held_s) * 1e9) + waiting * apart_ns)
    judge = judged(sorted(times), stream_rows(2000))
    (event,) = [e for e in judge.events if e.happening is not Happening.DUPLICATE]
    assert event.happening is Happening.BURST
    assert event.from_ns * 1e-9 == pytest.approx(3.995, abs=0.001)
    assert event.to_ns * 1e-9 == pytest.approx(4.0 + held_s, abs=0.06)
    assert judge.usual_ns == pytest.approx(STEP_NS, rel=0.05)


def stream_rows(count: int) -> list[list[float]]:
    return [row for _, row in stream(count)]


@pytest.mark.parametrize("batch", [4, 10])
def test_a_stream_that_always_comes_in_batches_is_one_burst(batch: int) -> None:
    times = [(k // batch * batch + batch) * STEP_NS + k % batch * 80_000 for k in range(2000)]
    (event,) = judged(times).events
    assert (event.happening, event.from_ns) == (Happening.BURST, times[0])
    assert event.to_ns > times[-40]


def test_a_burst_at_the_very_end_and_a_hole_there_are_told_too() -> None:
    times = ticks(400)
    held = [t_ns for t_ns in times if t_ns < 1_800_000_000] + [2_000_000_000 + k * 50_000 for k in range(40)]
    assert kinds(judged(held)) == [("burst", 1.795, 2.002)]
    assert kinds(judged([*times, times[-1] + 500_000_000], hole_s=0.1)) == [("hole", 1.995, 2.495)]


@pytest.mark.parametrize(("rate_hz", "grid_ms"), [(286.0, 1), (400.0, 1), (60.0, 10), (30.0, 10)])
@pytest.mark.parametrize("begin_s", [0.0, 3.0])
def test_stamps_on_a_coarse_grid_are_named_since_when_they_are(rate_hz: float, grid_ms: int, begin_s: float) -> None:
    grid = grid_ms * 1_000_000
    times = [t // grid * grid if t >= begin_s * 1e9 else t for t in ticks(4000, rate_hz=rate_hz)]
    (event,) = judged(times, rate_hz=rate_hz).events
    assert event.happening is Happening.SAWTOOTH
    assert event.from_ns * 1e-9 == pytest.approx(begin_s, abs=0.1)


def test_two_rows_of_one_coarse_stamp_are_named_beside_those_that_are_left_out() -> None:
    judge = judged([t // 10_000_000 * 10_000_000 for t in ticks(1000)], stream_rows(1000))
    assert {e.happening for e in judge.events} == {Happening.DUPLICATE, Happening.SAWTOOTH}
    rows = [row for row in stream_rows(500) for _ in "ab"]  # the same rows twice are no rounding
    assert {e.happening for e in judged([t for t in ticks(500) for _ in "ab"], rows).events} == {Happening.DUPLICATE}


def test_stamps_that_run_wrong_and_are_set_right_again_and_again_are_named() -> None:
    times = [k * 4_700_000 + k // 8 * 2_400_000 for k in range(1000)]
    (event,) = judged(times).events
    assert (event.happening, event.from_ns, event.to_ns > times[-40]) == (Happening.SAWTOOTH, 0, True)


@given(
    jitter=st.floats(0.0, 0.8), lost=st.sets(st.integers(40, 960), max_size=60), seed=st.integers(0, 1000),
    rate_hz=st.sampled_from([5.0, 20.0, 200.0, 1000.0]),
)  # fmt: skip
@settings(max_examples=150, deadline=None)
def test_jitter_and_lost_rows_are_no_burst_grid_wrong_rate_or_step(jitter, lost, seed, rate_hz) -> None:
    even = np.arange(1000) / rate_hz
    times = np.rint((even + np.random.default_rng(seed).uniform(0.0, 0.5 * jitter, 1000) / rate_hz) * 1e9)
    kept = [t_ns for k, t_ns in enumerate(times.astype(np.int64).tolist()) if k not in lost]
    assert {e.happening for e in judged(kept, rate_hz=rate_hz).events} <= {Happening.HOLE}


@given(times=st.lists(st.integers(-(10**12), 10**12), max_size=300), rate_hz=st.sampled_from([0.0, 200.0]))
@settings(max_examples=100, deadline=None)
def test_whatever_the_stamps_are_only_rising_ones_are_taken_and_events_are_few(times, rate_hz) -> None:
    judge = StreamJudge("imu0", (), 0.1, rate_hz)
    taken = [t_ns for t_ns in times if judge.takes(t_ns)]
    assert taken == sorted(set(taken))
    assert all(len([e for e in judge.events if e.happening is kind]) <= 50 for kind in Happening)


@pytest.mark.parametrize("jitter_s", [0.0, 0.0004])
@pytest.mark.parametrize("begin_s", [0.0, 5.0])
def test_a_rate_that_is_not_the_stated_one_is_named_since_when_it_is(jitter_s: float, begin_s: float) -> None:
    fast = ticks(round(200 * begin_s), jitter_s) + ticks(1200, jitter_s, begin_s, 120.0)
    (event,) = judged(fast, rate_hz=200.0).events
    assert event.happening is Happening.WRONG_RATE
    assert event.from_ns * 1e-9 == pytest.approx(begin_s, abs=0.1)
    assert event.to_ns * 1e-9 == pytest.approx(begin_s + 10.0, abs=0.3)
    assert judged(fast).events == []


def test_playback_that_begins_again_is_told_from_a_clock_that_steps_back_and_from_another_log() -> None:
    times, rows = ticks(1000), stream_rows(1000)
    others = (np.array(rows) + 1.0).tolist()
    day_ns = 86_400_000_000_000
    assert ("looped", 4.995, 0.0) in kinds(judged([*times, *times], [*rows, *rows]))
    assert ("appended", 4.995, 0.0) in kinds(judged([*times, *times], [*rows, *others]))
    assert kinds(judged([t + day_ns for t in times] + times, [*rows, *others]))[0] == ("appended", 86404.995, 0.0)
    later = judged([*times, *(t + day_ns for t in times)], [*rows, *others], hole_s=0.1)
    assert kinds(later) == [("appended", 4.995, 86400.0)]
    live = judged([*times, *(t + day_ns for t in times)], [*rows, *others], 0.1, recorded=False)
    assert kinds(live) == [("hole", 4.995, 86400.0)]
    assert all(event.tears for event in later.events)
    assert "another log follows, off by 86395.0" in later.events[0].words(0)
    back = [t - 2_000_000_000 for t in times]
    assert kinds(judged([*times, *back[600:]], [*rows, *rows[600:]])) == [("step back", 4.995, 1.0)]
    assert kinds(judged([*times, times[-1] + 30_000_000_000], [*rows, rows[0]], 0.1)) == [("hole", 4.995, 34.995)]


def test_it_is_said_that_a_clock_which_steps_back_alone_ends_the_use_of_inertial_data() -> None:
    times, cut = ticks(1000), 600
    back = [*times[:cut], *(t - 1_000_000_000 for t in times[cut:])]

    def done(**streams: list[int]) -> dict[str, str]:
        judges = []
        for name, stamps in streams.items():
            judges.append(StreamJudge(name, recorded=True))
            for t_ns in stamps:
                judges[-1].takes(t_ns)
        return {e.stream: e.entry(0)["done"] for e in together([], judges) if e.happening is Happening.STEP_BACK}

    assert done(imu0=back, cam0=times)["imu0"].startswith("no sample is used from then on")
    assert "inertial samples are used no more" in done(imu0=times, cam0=back)["cam0"]
    assert set(done(imu0=back, cam0=back).values()) == set(done(imu0=back).values()) == {Happening.STEP_BACK.done}


def test_a_hole_is_a_step_forth_where_the_stream_ends_later_than_another_by_as_much() -> None:
    names = ("imu0", "cam0")

    def found(imu: list[int], camera: list[int]) -> list[tuple[str, str]]:
        judges = [StreamJudge(name) for name in names]
        for judge, times in zip(judges, (imu, camera), strict=True):
            for t_ns in times:
                judge.takes(t_ns)
        events = [event for judge in judges for event in judge.events]
        return [(e.stream, str(e.happening)) for e in together(events, judges)]

    def stepped(times: list[int]) -> list[int]:
        return [t + 2_000_000_000 * (t >= 4_000_000_000) for t in times]

    imu, camera = ticks(2000), ticks(200, rate_hz=20.0)
    assert found(imu, camera) == []
    assert found(stepped(imu), camera) == [("imu0", "step forth")]
    assert found(imu, stepped(camera)) == [("cam0", "step forth")]
    assert found(stepped(imu), stepped(camera)) == [("cam0", "hole"), ("imu0", "hole")]  # nobody can tell
    assert found([t for t in imu if not 4.0 <= t * 1e-9 < 6.0], camera) == [("imu0", "hole")]


def shown(count: int, blurred: range, motion_px: int = 0) -> StreamJudge:
    """Images of 20 Hz of random edges, some of them out of focus, all of them blurred along their rows if asked for."""
    judge, rng = StreamJudge("cam0"), np.random.default_rng(7)
    for k in range(count):
        image = cv2.resize(rng.integers(0, 255, (24, 32), dtype=np.uint8), (256, 192), interpolation=cv2.INTER_NEAREST)
        image = cv2.GaussianBlur(image, (0, 0), 3.0 if k in blurred else 0.7)
        if motion_px and k % 60 > 25:
            image = cv2.blur(image, (motion_px, 1))
        judge.look(image, k * 50_000_000, k * 50_000_000)
    return judge


def test_images_out_of_focus_are_named_and_those_blurred_by_motion_or_for_a_moment_are_not() -> None:
    assert kinds(shown(200, range(80, 140))) == [("blurred", 4.0, 6.95)]
    assert shown(200, range(80, 90)).events == []
    assert shown(200, range(0), motion_px=25).events == []
    assert shown(200, range(200)).events == []  # nobody knows it otherwise


@pytest.mark.parametrize("shape", [(480, 640), (240, 320)])
def test_an_image_of_noise_alone_is_dark_whatever_its_brightness_and_one_through_a_lens_is_not(shape) -> None:
    rng, (v, u) = np.random.default_rng(4), np.mgrid[: shape[0], : shape[1]]
    scene = cv2.GaussianBlur(rng.normal(0.0, 60.0, shape), (0, 0), 0.7)
    for mean, sigma in ((40.0, 2.0), (120.0, 12.0), (250.0, 0.0)):
        noise = sigma * rng.standard_normal(shape)
        uneven = 0.02 * u + 0.03 * v
        assert is_dark(np.clip(mean + uneven + noise, 0, 255).astype(np.uint8)) == (sigma > 0.0)
        assert is_dark(np.clip(mean + noise, 0, 255).astype(np.uint8))
        faint = 0.5 * sigma / scene.std() * scene  # half of the noise
        assert sigma == 0.0 or not is_dark(np.clip(mean + faint + noise, 0, 255).astype(np.uint8))
    assert is_dark(rng.integers(0, 3, shape, dtype=np.uint8))


def test_images_that_repeat_are_told_by_their_pixels_and_depth_without_a_measurement_is_equal_to_itself() -> None:
    rng, repeats = np.random.default_rng(4), Repeats()
    depth = rng.uniform(1.0, 3.0, (48, 64)).astype(np.float32)
    depth[::16] = np.nan
    assert [repeats.take(image) for image in (depth, depth.copy(), depth + 1.0, depth + 1.0)] == [False, True] * 2
    assert repeats.row == 1 and repeats.changed == 0.5


def test_what_happened_goes_to_another_process_and_back() -> None:
    for event in shown(200, range(80, 140)).events:
        assert pickle.loads(pickle.dumps(event)) == event  # noqa: S301
        assert event.entry(0)["done"] == "used as they are"
        assert json.loads(json.dumps(event.entry(0)))["happening"] == "blurred"
