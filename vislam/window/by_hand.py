"""`Window`: a sliding window by hand, of tracks and inertial samples, without packets."""

from collections.abc import Iterable

import numpy as np

from vislam.config import ImuConfig, MachineConfig, WindowConfig
from vislam.core.blas import on_one_blas_thread
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.messages import (
    Array,
    Frame,
    ImuSample,
    Keyframe,
    KeyframePacket,
    NavState,
    Observations,
    Tracking,
    VoMeasurement,
)
from vislam.imu import ImuBuffer, ImuNoise
from vislam.window.messages import WindowUpdate
from vislam.window.window import SlidingWindow


class Window:
    """Visual-inertial bundle adjustment over the newest keyframes: `add` each one's tracks, read `state` and `poses`.

        window = Window(rig, imu_noise, state_at_rest(samples, imu_noise))
        for t_ns, tracks, samples in keyframes:
            window.add(t_ns, tracks, samples)
        print(window.state)

    Keyframes have ids 0, 1, 2, ... in the order in which they come.
    """

    def __init__(
        self, rig: Rig, imu: ImuNoise | None = None, state: NavState | None = None, *,
        gravity_m_s2: float = 9.81, config: WindowConfig | None = None,
    ) -> None:  # fmt: skip
        """Begin with the first keyframe in `state`, which a window with an `imu` needs; without, at the origin.

        Raises UsageError where the sensors cannot see scale or the state is missing, DataError where it is not usable.
        """
        machine = MachineConfig(gravity_m_s2=gravity_m_s2)
        self._window = SlidingWindow(config or WindowConfig(), rig, imu, machine)
        self._window.initialise(state)
        self._samples = None if imu is None else ImuBuffer(ImuConfig(), machine, imu)
        self._count, self._t_ns = 0, 0
        self._update: WindowUpdate | None = None

    def __repr__(self) -> str:
        held = 0 if self._update is None else len(self._update.ids)
        newest = "" if self.state is None else f"; newest {self.state}"
        return f"Window({held} of {self._count} keyframes{newest})"

    @property
    def state(self) -> NavState | None:
        """The state of the newest keyframe with its covariance; None without an IMU or keyframe."""
        return None if self._update is None else self._update.newest

    @property
    def poses(self) -> Array:
        """The poses T_local_body [M, 4, 4] of the keyframes in the window, oldest first."""
        return np.empty((0, 4, 4)) if self._update is None else self._update.T_local_body

    @on_one_blas_thread
    def add(
        self, t_ns: int, tracks: Observations, samples: Iterable[ImuSample] = (), T_local_body: Array | None = None
    ) -> WindowUpdate:
        """Take a keyframe, optimise, let the oldest go where the window is full; return what changed.

        Args:
            t_ns: its time, after that of the one before.
            tracks: what it sees.
            samples: inertial ones since the last call, in the order of time; the first at the keyframe before or
                earlier, the last at this one or later.
            T_local_body: a first guess of its pose [4, 4], for a window without an IMU.

        Raises DataError for what is not finite, out of order or not covered by samples; the window is as before.
        """
        span = None
        if self._samples is not None:
            for sample in samples:
                self._samples.add(sample)
            span = self._samples.span(self._t_ns, t_ns) if self._count else None
            if self._count and span is None:
                raise DataError(
                    f"keyframe {self._count}: the samples do not cover {self._t_ns} to {t_ns} ns, the newest is of "
                    f"{self._samples.newest_t_ns}; give those up to the first one after the keyframe"
                )
        no_features = np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8), None
        keyframe = Keyframe(self._count, t_ns, Frame(t_ns, self._count, ()), *no_features)
        unknown = VoMeasurement(t_ns, max(self._count - 1, 0), None, np.eye(6), False, Tracking.LOST, 0)
        self._update = self._window.add(KeyframePacket(keyframe, unknown, tracks, span), T_local_body)
        self._count, self._t_ns = self._count + 1, t_ns
        return self._update
