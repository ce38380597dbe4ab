"""Wheels that slip: when that begins and ends, what nobody is told meanwhile, and what it costs filter and graph."""

from pathlib import Path

import numpy as np
import pytest

from vislam.core.errors import UsageError
from vislam.pipeline.slip_watch import SlipWatch
from vislam.runs.report.run_files import read_run
from vislam.runs.report.sensor_section import sensors_section
from vislam.sensors.kinds import Wheels
from vislam.sensors.simulated import Faults, slipping
from vislam.sensors.toml import load_sensor_setup
from worlds.sensed_drive import WHEELS, drive, driven

SLIPPING = f"{WHEELS}simulated_hz = 20.0\nsimulated_slips = [[8.0, 9.5], [11.0, 13.0]]\n"
STEP_NS = 50_000_000


def watched(answers: str) -> SlipWatch:
    """Return a watch that was told readings 50 ms apart: `.` passes the gate, `x` fails it."""
    watch = SlipWatch()
    for k, answer in enumerate(answers):
        watch.judge(k * STEP_NS, answer == ".")
    return watch


@pytest.mark.parametrize("answers", ["." * 50, "x.xx.xx.x" * 9, "..xx" * 5])
def test_single_wild_readings_are_no_slip(answers: str) -> None:
    watch = watched(answers)
    assert (watch.slips, watch.times, watch.seconds) == (False, 0, 0.0)
    assert watch.summary() == {}
    assert watch.status() == ""


def test_a_slip_is_from_the_first_that_fails_to_the_first_that_agrees_for_long() -> None:
    going_on = watched("...xxxx.x...")
    assert going_on.slips
    assert going_on.begin_ns == 3 * STEP_NS
    assert going_on.seconds == pytest.approx(8 * 0.05)
    assert going_on.status() == "slips for 0.4 s"
    over = watched("...xxxx.x" + "." * 11)
    assert not over.slips
    assert over.summary() == {"times": 1, "seconds": pytest.approx(6 * 0.05), "slips": False, "contradicts": False}
    again = watched(("...xxxx" + "." * 12) * 3)
    assert again.times == 3
    assert again.seconds == pytest.approx(3 * 4 * 0.05)


def test_what_lasts_for_a_minute_is_no_slip_any_more() -> None:
    watch = watched("x" * 1210)
    assert not watch.slips
    assert watch.contradicts
    assert watch.status() == "contradicts inertial data and vision"
    assert watch.seconds == pytest.approx(60.0, abs=0.1)
    for k in range(1210, 1225):
        watch.judge(k * STEP_NS, True)
    assert watch.status() == ""
    assert watch.times == 1


def test_stamps_that_go_back_lengthen_nothing() -> None:
    watch = watched("xxxx")
    watch.judge(0, True)
    watch.judge(STEP_NS, True)
    watch.judge(2 * STEP_NS, True)
    assert watch.slips
    assert watch.seconds == pytest.approx(0.15)


def test_one_wheel_may_slip_alone() -> None:
    faults = Faults(slip_share=1.0, slip_columns=("left_m_s",))
    assert slipping(Wheels(), np.array([0.5, 0.5]), faults).tolist() == [1.0, 0.5]
    assert slipping(Wheels(), np.array([0.5, 0.5]), Faults()).tolist() == [0.75, 0.75]


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ('kind = "height"\nsimulated_hz = 5\nsimulated_slips = [[1.0, 2.0]]', "kind height has no wheels"),
        ('kind = "wheels"\nsimulated_hz = 5\nsimulated_slips = [[2.0, 1.0]]', "begins before it ends"),
    ],
)
def test_slips_that_cannot_be_are_refused(table: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "cart.toml").write_text(f"[sensors.it]\n{table}\n")
    with pytest.raises(UsageError, match=why):
        load_sensor_setup(tmp_path / "cart.toml")


@pytest.mark.slow
def test_two_slips_cost_filter_and_graph_little_and_are_told(tmp_path: Path, tmp_path_factory) -> None:
    clean, without = (driven(tmp_path_factory, name) for name in ("clean", "without"))
    slipped = drive(tmp_path, SLIPPING)
    print(slipped.ate_m, without.ate_m)
    for by in ("ekf", "live", "graph"):
        assert slipped.ate_m[by] < without.ate_m[by] + 0.005
    assert "slip" not in clean.metrics["sensors"]["wheels"]
    entry = slipped.metrics["sensors"]["wheels"]
    assert entry["slip"]["times"] == 2
    assert entry["slip"]["seconds"] == pytest.approx(3.5, abs=0.3)
    assert not entry["slip"]["slips"]
    filter_, graph = entry["readings"]["filter"], entry["readings"]["graph"]
    assert filter_["slipped"] == pytest.approx(20 * (3.5 + 2 * 0.5), abs=8)  # until it has agreed for half a second
    assert filter_["gated"] <= 8
    assert graph["outliers"] <= 4  # those of a keyframe that was made before the slip was known
    of_used = graph["outliers"] + graph["failed"]
    assert sum(filter_.values()) == sum(graph.values()) - of_used == entry["readings"]["came"]
    assert "slipped 2 times, 3.5 s" in sensors_section(read_run(slipped.out))
