"""What is told of a stream: repeated, late and missing rows, steps of the clock, and nothing where nothing happened."""

from __future__ import annotations

import numpy as np
import pytest

from vislam.core.streams import Happening, StreamJudge

STEP_NS = 5_000_000
MOST = (10.0,) * 6


def fed(rows: list[tuple[int, list[float]]]) -> tuple[StreamJudge, list[bool]]:
    judge = StreamJudge("imu0", MOST, 0.1)
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
    judge = StreamJudge("imu0", MOST, 0.1)
    for k in range(400):
        judge.takes(k * 1_000_000_000, [np.nan] * 6)
    assert len(judge.events) <= 50
    assert sum(event.rows for event in judge.events) == 400
