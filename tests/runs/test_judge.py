"""From evidence to a verdict: each reason alone, nothing by chance, and words that say what to do next."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import VerdictConfig
from vislam.runs.verdict import (
    Apart,
    Evidence,
    ForceAgreement,
    Moved,
    Trust,
    TurnAgreement,
    judge,
    verdict_sentence,
)

CONFIG = VerdictConfig()
SOUND = Evidence(
    mode="mono", frames=400, frames_lost=1, frames_degraded=5, frames_missing=2, coverage=0.99, has_imu=True,
    innovations={"tracks": (4000, 2400.0, 12000)}, keyframes=60, refused=12, offered=4000, sigma_m=0.1, uniform_s=3.0,
    apart=Apart(0.02, 0.8, 20.0), loops_accepted=30, loops_contradicting=2, clock=Moved(0.0004, 0.0005),
    rotation=Moved(0.4, 0.1), turns=TurnAgreement(50, 0.002, 0.0015, 1e-3),
    forces=ForceAgreement(50, 1.001, 0.002, 9.79, 0.02, 0.2), gyro_noise=2e-3, accel_noise=0.05, rate_hz=200.0,
    rate_told_hz=200.0, force_m_s2=9.85,
)  # fmt: skip


def verdict(**changes):
    return judge(replace(SOUND, **changes), CONFIG)


def test_a_sound_run_is_trusted_without_reasons():
    assert verdict().state is Trust.TRUSTED
    assert verdict().reasons == ()
    assert verdict().moved == ()


def test_a_run_of_which_nothing_is_known_is_not_doubted():
    assert judge(Evidence(), CONFIG).state is Trust.TRUSTED


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frames_lost": 60}, "vision lost 60 of 400 frames"),
        ({"frames_lost": 30, "longest_loss_s": 1.5}, "30 of 400 frames, 1.5 s at once"),
        ({"frames_lost": 60, "lost_reason": "N of N"}, "at once, mostly because N of N"),
        ({"frames": 20, "frames_lost": 8}, "vision lost 8 of 20 frames"),
        ({"events": ("imu0: stuck at one value from 4.00 to 9.00 s",)}, "imu0: stuck at one value from 4.00 to 9.00 s"),
        ({"events": ("imu0: another motion than the camera sees",)}, "axes (T_BS, or its inverse), cable"),
        ({"is_confirmed": False}, "the start was not confirmed"),
        ({"scale_sigma": 0.08}, "one camera's metres are known to 8.0 % (1 sigma) only"),
        ({"frames_degraded": 150}, "vision was weak in 150 of 400 frames"),
        ({"frames_missing": 100}, "100 of 500 frames never arrived"),
        ({"frames_repeated": 40}, "40 images repeat the one before"),
        ({"dark_s": 2.5}, "images were dark for 2.5 s"),
        ({"misplaced_depth": "depth sits elsewhere"}, "depth sits elsewhere"),
        ({"submaps_apart": 2}, "2 submaps"),
        ({"submaps_apart": 1, "apart_reason": "9 is at 4, or 1.0 m from there"}, "nothing (9 is at 4, or 1.0 m from"),
        ({"is_started": False, "start_reason": "gravity norm 1.00"}, "gravity was not found"),
        ({"start_failures": 5}, "contradicted each other in 5 attempts"),
        ({"soft_resets": 2}, "gave up its certainty 2 times"),
        ({"regained": {"gnss": 3}}, "refused readings of gnss until enough agreed that it moved to them, 3 times"),
        ({"refused": 900}, "refused 900 of 4000"),
        ({"innovations": {"vo": (300, 2700.0, 1800)}}, "innovations of vo are 1.5 times"),
        ({"sigma_m": 3.0}, "uncertain by 3.0 m"),
        ({"uniform_s": 40.0}, "uniform motion for 40 s"),
        ({"apart": Apart(1.5, 12.0, 20.0)}, "filter and graph are 1.50 m apart"),
        ({"loops_contradicting": 25}, "25 of 55 verified loops"),
        ({"clock": Moved(0.08, 0.0005)}, "80.0 ± 0.5 ms early"),
        ({"rotation": Moved(3.0, 0.1)}, "the camera is turned by 3.0 degrees against its file: calibrate"),
        ({"turns": TurnAgreement(50, -0.03, 0.002, 1e-3)}, "vision sees turns 3.0 % smaller"),
        (
            {"turns": TurnAgreement(50, 0.0, 0.002, 1e-3, 0.05)},
            "one in ten turns between keyframes is 2.9 degrees",
        ),
        ({"forces": ForceAgreement(50, 1.05, 0.002, 9.8, 0.02, 0.2)}, "metres are 5.0 % larger"),
        ({"forces": ForceAgreement(50, 1.0, 0.002, 10.3, 0.02, 0.2)}, "gravity along the way is 10.30"),
        ({"gyro_noise": 0.05}, "gyroscope noise is 2.9 deg after a second"),
        ({"accel_noise": 0.6}, "accelerometer noise is 0.60 m/s"),
        ({"rate_hz": 50.0}, "come at 50 Hz, stated were 200"),
        ({"rate_hz": 5.0}, "come every 0.20 s and more than 0.10 s is an outage"),
        ({"saturated": ("gyro z",)}, "saturated: gyro z"),
        ({"force_m_s2": 1.0}, "reads 1.00 m/s2 where gravity is 9.81"),
    ],
)
def test_each_contradiction_alone_is_a_doubt_that_names_it(changes, words):
    found = verdict(**changes)
    assert found.state is Trust.DOUBTFUL
    assert len(found.reasons) == 1
    assert words in found.reasons[0]


def test_a_run_with_few_poses_is_lost_and_says_why():
    found = verdict(coverage=0.2, is_started=False, start_reason="parallax 3 px of 12 needed")
    assert found.state is Trust.LOST
    assert "20%" in found.reasons[0]
    assert "parallax 3 px" in found.reasons[0]


def test_a_short_run_without_an_imu_is_judged_as_a_long_one():
    short = Evidence(mode="rgbd", frames=25, frames_lost=14, coverage=1.0, submaps_apart=6, lost_reason="too dark")
    found = judge(short, CONFIG)
    assert found.state is Trust.LOST
    assert found.reasons[0] == "vision placed only 11 of 25 frames (too dark)"
    assert any("6 submaps" in reason for reason in found.reasons)
    assert judge(replace(short, frames_lost=2, submaps_apart=0), CONFIG).state is Trust.TRUSTED
    assert judge(replace(SOUND, frames_lost=250, lost_reason="dark"), CONFIG).state is Trust.DOUBTFUL  # the IMU bridged


def test_no_pose_for_most_frames_is_explained_by_what_most_frames_lacked():
    why = "only N of N corners have depth"
    found = judge(Evidence(frames=400, frames_lost=396, coverage=0.01, lost_reason=why), CONFIG)
    assert found.reasons[0] == f"only 1% of the frames have a pose ({why})"


def test_what_happened_to_a_sensor_is_said_before_what_came_of_it():
    found = verdict(events=("imu0: stuck",), soft_resets=2, rotation=Moved(3.0, 0.1))
    assert found.reasons[0].startswith("imu0: stuck")


def test_a_hole_that_was_bridged_is_no_doubt_but_the_first_cause_of_one():
    assert verdict(causes=("cam0: rows are missing",)).state is Trust.TRUSTED
    assert verdict(causes=("cam0: rows are missing",)).reasons == ()
    assert verdict(causes=("cam0: rows are missing",), soft_resets=2).reasons[0] == "cam0: rows are missing"


def test_no_calibration_is_asked_for_where_turns_contradict_each_other():
    found = verdict(turns=TurnAgreement(50, 0.03, 0.002, 1e-3, 0.05), rotation=Moved(5.0, 0.1))
    assert len(found.reasons) == 1 and "one in ten turns" in found.reasons[0]


def test_what_calibration_corrected_is_told_without_a_doubt():
    found = verdict(clock=Moved(-0.02, 0.0005), rotation=Moved(1.2, 0.1))
    assert found.state is Trust.TRUSTED
    assert any("20.0 ± 0.5 ms late" in words and "corrected" in words for words in found.moved)
    assert any("turned by 1.20 ± 0.10 degrees" in words for words in found.moved)


def test_a_start_that_was_taken_back_is_told_without_a_doubt():
    found = verdict(starts_taken_back=1)
    assert found.state is Trust.TRUSTED
    assert "taken back" in found.moved[0] and "stepped" in found.moved[0]


def test_what_is_found_far_off_but_badly_known_is_no_doubt():
    sigma = 0.4
    assert verdict(turns=TurnAgreement(15, 0.5, sigma, 0.01)).state is Trust.TRUSTED
    assert verdict(forces=ForceAgreement(15, 1.5, sigma, 8.0, 2.0, 3.0)).state is Trust.TRUSTED
    assert verdict(clock=Moved(float("nan"), float("inf"))).state is Trust.TRUSTED


def test_filter_and_graph_may_differ_by_what_both_admit_or_by_a_trifle():
    assert verdict(apart=Apart(3.0, 1.2, 20.0)).state is Trust.TRUSTED
    assert verdict(apart=Apart(0.01, 9.0, 20.0)).state is Trust.TRUSTED


def test_innovations_that_noise_explains_are_rarely_doubted():
    rng = np.random.default_rng(5)
    doubted = 0
    for _ in range(300):
        nis = float(np.sum(rng.normal(size=(60, 6)) ** 2)) * 5.0  # five frames that share the error of each keyframe
        doubted += judge(replace(SOUND, innovations={"vo": (300, nis, 1800)}), CONFIG).state is not Trust.TRUSTED
    assert doubted <= 3


def test_the_sentence_is_the_same_from_a_verdict_that_was_stored():
    found = verdict(rate_hz=50.0)
    stored = {"state": str(found.state), "reasons": list(found.reasons)}
    assert verdict_sentence(stored).startswith("Doubtful: inertial samples come at 50 Hz")
    assert verdict_sentence({"state": "trusted", "reasons": []}) == "Trusted: nothing in the run contradicts itself"


SLOW = {"frames_offered": 593, "frames_dropped": 424, "frames_left_out": 100, "samples": 9000, "samples_missed": 17829}


def test_that_the_machine_is_too_slow_is_said_before_everything_else():
    found = verdict(
        **SLOW, late_s=0.8, busy=0.97, core=0.9, graph_late_s=3.1, map_late_s=2.2, coverage=0.1, frames_lost=60,
        frames_missing=500,
    )  # fmt: skip
    assert found.state is Trust.LOST
    assert found.reasons[0].startswith("the machine is too slow for its sensors: 524 of 593 frames")
    assert "17829 of 26829 inertial samples" in found.reasons[0]
    waited = "waited longest: frames for vision 0.8 s, for the map 2.2 s, keyframes for the graph 3.1 s; vision"
    assert waited in found.reasons[0]
    assert "97% of the time, with 90% of a core: give it less to do (--profile pi, " in found.reasons[0]
    assert "--map.no-enabled" in found.reasons[0] and found.reasons[0].endswith("--live.realtime-priority 50")
    assert not any("never arrived" in reason for reason in found.reasons)


def test_a_machine_that_others_use_is_to_be_freed_first():
    (reason,) = verdict(**SLOW, busy=0.95, core=0.3).reasons
    assert "other work had its core, so end that first; then give it less to do" in reason


def test_a_map_that_left_keyframes_out_is_told():
    assert verdict(keyframes=80, map_left_out=5).state is Trust.TRUSTED
    (reason,) = verdict(keyframes=80, map_left_out=30).reasons
    assert "30 of 80 keyframes left out of the map" in reason and "realtime" not in reason


@pytest.mark.parametrize("changes", [{"samples_missed": 0}, {"frames_dropped": 0, "frames_left_out": 0}])
def test_frames_or_samples_alone_make_a_machine_too_slow(changes):
    found = verdict(**{**SLOW, **changes})
    assert found.state is Trust.DOUBTFUL and "too slow" in found.reasons[0]


def test_where_no_frame_was_offered_the_machine_missed_samples_only():
    (reason,) = verdict(samples=9000, samples_missed=2000).reasons
    assert "sensors: 2000 of 11000 inertial samples missed: give it less to do" in reason


def test_what_a_slow_machine_explains_is_not_told_of_the_sensors():
    reasons = verdict(**SLOW, rate_hz=120.0, rate_told_hz=200.0, frames_missing=500).reasons
    assert len(reasons) == 1 and "waited" not in reasons[0]


def test_a_machine_that_misses_little_is_not_too_slow():
    assert verdict(frames_offered=600, frames_dropped=20, samples=9000, samples_missed=90).state is Trust.TRUSTED
