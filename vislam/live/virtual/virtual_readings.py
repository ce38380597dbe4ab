"""Further sensors of the virtual cart: drawn on its true motion as it drives."""

from __future__ import annotations

import math
import time

import numpy as np

from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.live.epoch import Epoch
from vislam.live.reading_source import Heard
from vislam.live.virtual.motion import Follower, Segment
from vislam.live.virtual.place import BODY_HEIGHT_M
from vislam.sensors import BodyState, SensorSetup
from vislam.sensors.simulated import slipping, within

_NS = 1_000_000_000
_KNOWN_S = 5.0  # of the motion; a later query misses what was before


class VirtualReadings(Heard):
    """Satisfies `ReadingSource`; own variables are drawn by their sigmas, as of a recording."""

    def __init__(self, cart: str, epoch: Epoch, setup: SensorSetup, seed: int) -> None:
        """Put the simulated sensors of a setup on the cart whose segments are published under a name."""
        super().__init__(tuple(setup.simulated_hz))
        self._follower, self._epoch, self._setup = Follower.waiting(cart), epoch, setup
        self._rngs, self._own = {}, dict[str, Array]()
        self._is_placed = dict.fromkeys(setup.simulated_hz, False)
        for number, name in enumerate(setup.simulated_hz):
            self._rngs[name] = np.random.default_rng([seed, number])
            self._own[name] = setup.suite.drawn_own(name, self._rngs[name])
        self._drawn = dict.fromkeys(setup.simulated_hz, 0)  # how many of each, those that were missed included
        self._missed = dict.fromkeys(setup.simulated_hz, 0)

    def read(self) -> list[Reading]:
        """Return the readings whose time has come; see `ReadingSource`."""
        begin_ns = self._epoch.begin_ns()
        now_s = (time.monotonic_ns() - begin_ns) / _NS
        out = []
        for name, rate_hz in self._setup.simulated_hz.items():
            while (t_s := self._drawn[name] / rate_hz) <= now_s:
                self._drawn[name] += 1
                if t_s < now_s - _KNOWN_S:
                    self._missed[name] += 1
                    continue
                body = body_at(self._follower.at(t_s), begin_ns + round(t_s * _NS))
                sensor, faults = self._setup.sensors[name], self._setup.simulated_faults[name]
                if not self._is_placed[name]:  # about where it begins: where it will drive is unknown yet
                    self._own[name] = sensor.about(body.position_m[None], self._own[name])
                    self._is_placed[name] = True
                values = sensor.draw(body, self._own[name].copy(), self._rngs[name])
                if within(t_s, faults.slips):
                    values = slipping(sensor, values, faults)
                out.append(Reading(name, body.t_ns, values))
        self.hear(out)
        return out

    def counters(self) -> dict[str, dict[str, int]]:
        """Return how many readings of each sensor were drawn, and how many were not asked for in time."""
        return {name: {"drawn": count, "missed": self._missed[name]} for name, count in self.count.items()}


def body_at(segment: Segment, t_ns: int) -> BodyState:
    """Return the body at a time, above the middle of the axle, level."""
    T, none = segment.T_world_body(BODY_HEIGHT_M), np.zeros(3)
    ahead = np.array([math.cos(segment.yaw_rad), math.sin(segment.yaw_rad), 0.0])
    rate = np.array([0.0, 0.0, segment.rate_rad_s])
    return BodyState(t_ns, T[:3, :3], T[:3, 3], segment.speed_m_s * ahead, none, none, rate)
