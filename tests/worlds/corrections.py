"""A body with exact motion, its samples, and what vision says of it, for the fast path's tests."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vislam.config import Config, EkfConfig
from vislam.core.messages import ImuSample, NavState, Observations
from vislam.ekf import Correction
from vislam.imu import ImuNoise
from vislam.live.notices import Start
from worlds.motion import T0_NS, Motion, SimulatedVision
from worlds.parts import MACHINE

CART_IMU = ImuNoise(5e-4, 5e-3, 2e-5, 3e-4, 100.0)
CONFIG = Config(machine=MACHINE, ekf=EkfConfig(vo_inflation=1.0))
NOTHING_SEEN = Observations(np.empty(0, dtype=np.int64), np.empty((0, 2)))


@dataclass(frozen=True)
class VisionWorld:
    """Samples, and the messages of the front process, in the order of their own times."""

    motion: Motion
    samples: list[ImuSample]
    start: Start
    corrections: list[Correction]

    @staticmethod
    def make(seed: int, duration_s: float, camera_hz: float = 10.0, vigour: float = 0.6) -> VisionWorld:
        rng = np.random.default_rng(seed)
        motion, vision = Motion.random(seed, vigour), SimulatedVision()
        samples, biases = motion.samples(duration_s, CART_IMU.rate_hz, CART_IMU, rng)
        times = np.arange(0.2, duration_s, 1.0 / camera_hz)
        stamps = (T0_NS + np.round(times * 1e9)).astype(np.int64).tolist()
        motions = vision.motions([motion.pose(t) for t in times], stamps, rng)
        T, velocity, _, _ = motion.at(times[0])
        sigmas = np.repeat([1e-3, 1e-3, 0.02, 1e-3, 0.02], 3)
        state = NavState(stamps[0], T, velocity, biases[0, :3], biases[0, 3:], np.diag(sigmas**2))
        corrections = [
            Correction(vo.t_ns, vo, NOTHING_SEEN, False, False, i // vision.keyframe_every if i % 8 == 0 else None)
            for i, vo in enumerate(motions)
        ]
        return VisionWorld(motion, samples, Start(state, motions[0]), corrections)

    def lost(self, begin_s: float, end_s: float) -> VisionWorld:
        """Return the same without frames between two times since the first sample."""
        kept = [c for c in self.corrections if not begin_s <= (c.t_ns - T0_NS) * 1e-9 < end_s]
        return replace(self, corrections=kept)
