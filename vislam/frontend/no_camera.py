"""The front end of a body without a camera: it sees nothing, and places nothing."""

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import Learned
from vislam.core.messages import Array, Frame, ImuSpan, no_observations
from vislam.frontend.result import CommonErrors, TrackResult, lost_motion


class NoFrontEnd:
    """Answers for every frame that nothing was seen; keyframes come by time alone."""

    mode = "none"
    knows_scale = True  # further sensors and the IMU measure in metres
    keyframe_spacing = 1.0

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int) -> None:
        """Take a rig without cameras; raises UsageError for one with some."""
        if not rig.is_blind:
            raise UsageError("--frontend.mode none is for recordings without a camera; leave it away")
        self.learned = Learned(0)
        self.calibration: dict[str, float] = {}
        self._keyframe_id = -1

    @classmethod
    def errors(cls, config: FrontEndConfig, rig: Rig, noise: ImuNoise | None) -> CommonErrors:
        """Return that there are no motions to err."""
        return CommonErrors()

    def track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float = np.inf, T_last_now: Array | None = None
    ) -> TrackResult:
        """Return that the frame shows nothing."""
        lost = lost_motion(frame.t_ns, self._keyframe_id, True)
        return TrackResult(lost, no_observations(), None, 0.0, "there is no camera")

    def begin_at(self, keyframe_id: int, learned: Learned, seeks_place: bool = False) -> None:
        """Take the number that a keyframe would have."""
        self._keyframe_id = keyframe_id - 1
