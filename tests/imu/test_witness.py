"""Samples that contradict good vision are found and named; those that a wrong vision contradicts are believed."""

import numpy as np
import pytest

from vislam.config import ImuConfig, MachineConfig
from vislam.core.geometry import se3_exp
from vislam.core.messages import ImuSample, ImuSpan, Tracking, VoMeasurement
from vislam.imu import ImuBuffer, MotionWitness

RATE_HZ, FRAME_S, BREAK_S = 200.0, 0.05, 4.0
GRAVITY = np.array([0.0, 0.0, 9.81])
NO_BIAS = np.zeros(3), np.zeros(3)


def pose(t_s):
    turn = np.array([0.3 * np.sin(1.1 * t_s), 0.2 * np.sin(0.7 * t_s + 1.0), 0.5 * np.sin(0.9 * t_s)])
    T = se3_exp(np.concatenate([turn, np.zeros(3)]))
    T[:3, 3] = [np.sin(0.8 * t_s), 0.5 * np.cos(1.3 * t_s), 0.2 * np.sin(t_s)]
    return T


def sample(t_s):
    h = 1e-3
    R = pose(t_s)[:3, :3]
    W = R.T @ (pose(t_s + h)[:3, :3] - pose(t_s - h)[:3, :3]) / (2.0 * h)
    accel = (pose(t_s + h)[:3, 3] - 2.0 * pose(t_s)[:3, 3] + pose(t_s - h)[:3, 3]) / h**2
    return np.concatenate([[W[2, 1], W[0, 2], W[1, 0]], R.T @ (accel + GRAVITY)])


def watched(
    change, until_s=8.0, turned=lambda t_s: 0.0, outliers=lambda t_s: 0.05, is_metric=True, way_m=lambda t_s: 2e-3,
    stated_m=lambda t_s: 1e-3,
):  # fmt: skip
    """Yield the witness after each frame; samples are changed by `change(t_s, six)`, vision is turned by rad.

    Its way scatters by `way_m(t_s)`, where `stated_m(t_s)` is stated.
    """
    rng, witness = np.random.default_rng(7), MotionWitness()
    sigmas = np.repeat([1e-3, 1e-2], 3)

    def samples(t0_ns, t1_ns):
        times = np.arange(round(t0_ns * 1e-9 * RATE_HZ), round(t1_ns * 1e-9 * RATE_HZ) + 1) / RATE_HZ
        rows = np.array([change(t, sample(t)) for t in times]) + sigmas * rng.standard_normal((len(times), 6))
        return ImuSpan((times * 1e9).astype(np.int64), rows[:, :3].copy(), rows[:, 3:].copy())

    for k in range(round(until_s / FRAME_S)):
        t_s = k * FRAME_S
        T = pose(t_s) @ se3_exp(np.array([0.0, 0.0, turned(t_s), *(way_m(t_s) * rng.standard_normal(3))]))
        covariance = np.diag(np.repeat([1e-3, stated_m(t_s)], 3) ** 2)
        vo = VoMeasurement(round(t_s * 1e9), 0, T, covariance, is_metric, Tracking.OK, 100)
        witness.see(vo, outliers(t_s), T, samples, NO_BIAS)
        yield t_s, witness


@pytest.mark.parametrize("is_metric", [True, False])
def test_good_samples_are_believed(is_metric):
    assert all(w.until_ns is None and not w.doubts for _, w in watched(lambda _, six: six, is_metric=is_metric))


@pytest.mark.parametrize(
    "bad",
    [
        lambda t, six: six * [-1, -1, 1, -1, -1, 1],
        lambda t, six: six * [1, 1, 1, *3 * [1 / 9.81]],
        lambda t, six: sample(t - 1.0),
    ],
    ids=["other axes", "another unit", "another clock"],
)
def test_samples_that_break_are_not_believed_from_then_on_and_are_again_when_they_agree(bad):
    seen = list(watched(lambda t, six: bad(t, six) if BREAK_S <= t < 6.0 else six, until_s=5.9))
    _, witness = seen[-1]
    assert witness.until_ns is not None
    assert BREAK_S - 0.3 < witness.until_ns * 1e-9 <= BREAK_S + 0.3
    assert abs(witness.since_ns * 1e-9 - BREAK_S) <= 0.35
    *_, (_, witness) = watched(lambda t, six: bad(t, six) if BREAK_S <= t < 6.0 else six, until_s=10.0)
    assert witness.until_ns is None


def test_a_camera_that_follows_what_moves_does_not_take_the_samples_away():
    turned = {"turned": lambda t: 0.5 * max(t - BREAK_S, 0.0)}
    *_, (_, witness) = watched(lambda _, six: six, outliers=lambda t: 0.4 if t >= BREAK_S - 0.3 else 0.05, **turned)
    assert witness.until_ns is None
    *_, (_, witness) = watched(lambda _, six: six, **turned)  # the same, with tracks that agree as ever
    assert witness.until_ns is not None


def test_a_vision_that_states_how_unsure_it_is_takes_no_samples_away():
    scatters = {"way_m": lambda t: 0.06 if t >= BREAK_S else 2e-3}
    *_, (_, witness) = watched(lambda _, six: six, stated_m=scatters["way_m"], **scatters)
    assert not witness.doubted_ns
    *_, (_, witness) = watched(lambda _, six: six, **scatters)  # the same, unstated
    assert witness.doubted_ns


def test_a_buffer_gives_no_span_of_what_is_not_believed_and_names_it():
    buffer = ImuBuffer(ImuConfig(), MachineConfig())
    times = [5_000_000 * k for k in range(1, 400)]
    for t_ns in times[:200]:
        buffer.add(ImuSample(t_ns, np.zeros(3) + 1e-9 * t_ns, GRAVITY))
    buffer.believe(times[99], times[109])
    assert buffer.span(times[10], times[90]) is not None
    assert buffer.span(times[90], times[110]) is None
    for t_ns in times[200:300]:
        buffer.add(ImuSample(t_ns, np.zeros(3) + 1e-9 * t_ns, GRAVITY))
    buffer.believe(None, times[109])
    for t_ns in times[300:]:
        buffer.add(ImuSample(t_ns, np.zeros(3) + 1e-9 * t_ns, GRAVITY))
    assert buffer.span(times[280], times[310]) is None
    assert buffer.span(times[310], times[390]) is not None
    (event,) = [event for event in buffer.events if event.happening == "contradicting"]
    assert (event.from_ns, event.to_ns, event.rows) == (times[109], times[299], 191)
