"""The tight filter backwards in time: a state found late gives metres to what was seen until then."""

import numpy as np
import pytest

from vislam.config import EkfConfig
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import NavState
from vislam.ekf.tight.backwards import EarlyFrames, known_from
from vislam.imu.series import ImuSeries
from worlds.flight import CHEAP, SIGMAS, Flight
from worlds.motion import T0_NS, state_error
from worlds.parts import MACHINE

CONFIG = EkfConfig()
_SAMPLE = 1600  # the state is found 8 s into the flight


def found_late(flight: Flight, k: int, seed: int) -> NavState:
    """Return the state at sample k as an initialisation finds it: off by what it says of itself."""
    T, v, bias = flight.truth(k)
    drawn = np.random.default_rng(seed).normal(size=15) * SIGMAS
    drawn[3:6] = 0.0
    T = transform(T[:3, :3] @ so3_exp(drawn[:3]), T[:3, 3])
    biases = bias + drawn[9:]
    return NavState(flight.samples[k].t_ns, T, v + drawn[6:9], biases[:3], biases[3:], np.diag(SIGMAS**2))


def before(flight: Flight, first: NavState, blind: bool = False) -> dict[int, NavState]:
    series = ImuSeries()
    for sample in flight.samples:
        series.append(sample)
    early = EarlyFrames(CONFIG, flight.rig, MACHINE)
    for t_ns, seen in flight.frames:
        if not blind:
            early.see(t_ns, seen, False)
    wanted = [t_ns for t_ns, _ in flight.frames[::4]]
    if blind:
        early.see(*flight.frames[0], False)
    return early.states(first, wanted, series.cut, CHEAP)


@pytest.mark.parametrize("seed", [1, 2])
def test_eight_seconds_before_a_state_are_found_with_their_scale(seed: int) -> None:
    flight = Flight.make(seed, 9.0)
    first = found_late(flight, _SAMPLE, seed)
    states = before(flight, first)
    assert len(states) == len([t for t, _ in flight.frames[::4] if t < first.t_ns])
    times = sorted(states)
    poses = np.array([states[t].T_world_body[:3, 3] for t in times])
    truth = np.array([flight.motion.pose((t - T0_NS) * 1e-9)[:3, 3] for t in times])
    way, true_way = (np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in (poses, truth))
    assert way == pytest.approx(true_way, rel=0.05)
    assert np.linalg.norm(poses - truth, axis=1).max() < 0.3
    assert known_from(first, states) == times[0]
    nees = []
    for t in times[:-20:5]:
        k = round((t - T0_NS) * 1e-9 * 200.0)
        at = (t - T0_NS) * 1e-9
        T, v, *_ = flight.motion.at(at)
        e = state_error((T, v, flight.biases[k]), states[t])
        nees.append(e @ np.linalg.solve(states[t].covariance, e))
    assert np.mean(nees) < 3.0 * 15.0


def test_what_is_dead_reckoned_for_long_does_not_pass_for_known() -> None:
    flight = Flight.make(3, 9.0)
    first = found_late(flight, _SAMPLE, 3)
    states = before(flight, first, blind=True)
    from_ns = known_from(first, states)
    assert min(states) < first.t_ns - 7e9  # they are told all the same
    assert first.t_ns - from_ns < 3e9
