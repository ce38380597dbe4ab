"""Wheels that are not as stated: the verdict names what is wrong, and by how much; those that are raise no doubt."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import Config, load
from vislam.core import Reading
from vislam.runs.evidence import front_evidence
from vislam.runs.further_sensors import FurtherReadings
from vislam.runs.sources import open_source
from vislam.runs.verdict import Driven, Evidence, Moved, judge
from vislam.sensors import load_sensor_setup
from vislam.slam import Slam

DELAY_NS = 250_000_000


def verdict_on(tmp_path, fault, seed=0):
    """Drive the cart without a camera by wheels that are stated as usual."""
    setups = []
    for name, width_m in (("stated", 0.5), ("true", 0.6 if fault == "track" else 0.5)):
        (tmp_path / name).write_text(
            f'[sensors.wheels]\nkind = "wheels"\nsimulated_hz = 20.0\ntrack_width_m = {width_m}\n'
        )
        setups.append(load_sensor_setup(tmp_path / name))
    recording = open_source("points:cart-drive,rig=none,duration_s=40", seed)
    values = list(FurtherReadings(recording, setups[1], seed).among(recording.events()))
    for k, value in enumerate(values):
        if isinstance(value, Reading):
            speeds = np.asarray(value.values) / (1.08 if fault == "scale" else 1.0)
            t_ns = value.t_ns + (DELAY_NS if fault == "delay" else 0)
            values[k] = replace(value, t_ns=t_ns, values=speeds[::-1].copy() if fault == "swap" else speeds)
    slam = Slam(load(None, {}), recording.rig, recording.imu_noise, setups[0].suite)
    for value in sorted(values, key=lambda value: value.t_ns):
        slam.feed(value)
    slam.finish()
    return judge(front_evidence(slam.front.report(), Config().machine), Config().verdict)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("track", "track_width_m of wheels is 0.6"),
        ("swap", "wheels turn the other way than the gyroscope"),
        ("delay", "the stamps of wheels are 0.25 ± 0.01 s late"),
    ],
)
def test_wheels_that_are_not_as_stated_are_named(tmp_path, fault, words):
    verdict = verdict_on(tmp_path, fault)
    print(verdict)
    assert verdict.state == "doubtful"
    assert any(words in reason for reason in verdict.reasons)


def test_a_scale_within_what_was_stated_is_corrected_and_said(tmp_path):
    verdict = verdict_on(tmp_path, "scale")
    print(verdict)
    assert verdict.state == "trusted"
    assert "scale_left of wheels is 1.08" in verdict.moved[0] and "corrected" in verdict.moved[0]


@pytest.mark.parametrize("seed", [0, 3])
def test_wheels_as_stated_raise_no_doubt(tmp_path, seed):
    verdict = verdict_on(tmp_path, "", seed)
    assert (verdict.state, verdict.reasons) == ("trusted", ())


def test_turns_and_delays_within_what_any_drive_shows_are_no_doubt():
    own = {"track_width_m": (0.5, 0.015, Moved(0.02, 0.005))}
    for turn, slip, delay, reasons in (
        (0.08, 0.05, 0.06, 0), (0.2, 0.05, 0.06, 1), (0.2, 0.3, 0.06, 0), (0.08, 0.05, -0.2, 1), (-2.0, 0.3, 0.0, 1),
    ):  # fmt: skip
        evidence = Evidence(driven=(Driven("wheels", own, Moved(turn, 0.01), slip, Moved(delay, 0.01)),))
        assert len(judge(evidence, Config().verdict).reasons) == reasons
