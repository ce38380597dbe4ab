"""How much tracks scatter in this run, as the distances from their epipolar lines show it.

Depth errs along the epipolar line, so across it nothing is left but the noise of the pixels themselves, whatever is
known of the landmarks; and the same holds with one camera. Tracks that went astray are trimmed by the spread of the
others, not by the stated noise. Frames are averaged in the logarithm, over some seconds, so that one blurred frame does
not make the run noisy.
"""

from dataclasses import dataclass

import numpy as np

from vislam.core.camera import Camera
from vislam.core.messages import Array, Observations
from vislam.core.quantiles import median

_MEDIAN_ABS = 0.6745  # of a normal distribution, in standard deviations
_TRIM = 2.0  # standard deviations
_TRIMMED_RMS = 0.8796  # of a standard normal distribution within the trim
_STEPS = 4
_MIN_TRACKS = 30  # of a frame that is used
_MIN_FRAMES = 10  # before the measured noise takes the place of the stated one
_MEMORY_FRAMES = 200  # over which is averaged: blur and light change within seconds
_MIN_PX = 0.02  # of a frame: simulated pixels without any noise
_PARAMETERS = 5  # of the motion that the same tracks were fitted with
_USUAL_PX = 0.4  # of keyframes in sharp images (EuRoC MH_01), for which estimators' stated noise was found to hold


def _spread_px(lengths: Array) -> float:
    """Return the standard deviation behind absolute distances [N] of which some are gross errors.

    It starts from the median, which outliers of one share in ten raise by an eighth, and goes on with what lies within
    the trim, corrected for the tails that a normal distribution loses there.
    """
    sigma = median(lengths) / _MEDIAN_ABS
    for _ in range(_STEPS):
        within = lengths[lengths <= _TRIM * sigma]
        if len(within) == 0:
            break
        sigma = float(np.sqrt(np.mean(within**2))) / _TRIMMED_RMS
    return sigma


class PixelNoise:
    """Learns the standard deviation of a track's pixel, in x and in y, from frame to frame."""

    def __init__(self, stated_px: float) -> None:
        """Start from the `stated_px` of the configuration."""
        self._stated_px = stated_px
        self._log_px = 0.0
        self._frames = 0
        self._frame_px: float | None = None

    @property
    def memory(self) -> list[float]:
        """What was learned [2], as `start_at` takes it."""
        return [self._log_px, self._frames]

    def start_at(self, memory: Array) -> None:
        """Take what an earlier run had learned, to be learned further."""
        self._log_px, self._frames = float(memory[0]), int(memory[1])

    @property
    def is_learnt(self) -> bool:
        """Whether enough frames were measured."""
        return self._frames >= _MIN_FRAMES

    @property
    def sigma_px(self) -> float:
        """The standard deviation: measured, or as stated while too little was seen."""
        return float(np.exp(self._log_px)) if self.is_learnt else self._stated_px

    @property
    def over_usual(self) -> float:
        """By how much tracks of the newest frame scatter more than usual, at least 1.

        It grows with blur and with the way since the keyframe, and what causes it spoils depth alike. Less scatter is
        no promise: what neighbouring tracks have in common leaves no residual.
        """
        known = self._frame_px is not None or self.is_learnt
        return max(1.0, float(self.frame_px) / _USUAL_PX) if known else 1.0

    @property
    def frame_px(self) -> float:
        """The standard deviation in the newest frame alone; where it shows too few tracks, that of the run."""
        return self.sigma_px if self._frame_px is None else self._frame_px

    def learn(self, distances: Array, camera: Camera, xy: Array, ends: float = 1.0) -> None:
        """Take a frame's distances [N] of tracks at `xy` [N, 2] from their epipolar lines; NaN where there is none.

        Distances and places are on z = 1; the camera's lens converts them to pixels there. `ends` is the variance of
        such a distance in units of one pixel's variance: 1 where the place in the keyframe is the track by definition,
        2 where it is as noisy as the one in the frame.
        """
        self._frame_px = None
        seen = np.isfinite(distances)
        if seen.sum() < _MIN_TRACKS:
            return
        J = camera.project_jacobian(np.column_stack([xy[seen], np.ones(int(seen.sum()))]))[:, :, :2]
        px = np.sqrt(np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]))
        scaled = np.abs(distances[seen]) * px / np.sqrt(ends)
        freedom = len(scaled) / (len(scaled) - _PARAMETERS)
        measured_px = max(_spread_px(scaled) * np.sqrt(freedom), _MIN_PX)
        self._frame_px = measured_px
        self._frames += 1
        self._log_px += (np.log(measured_px) - self._log_px) / min(self._frames, _MEMORY_FRAMES)


@dataclass(slots=True)
class NoiseUsed:
    """The noise of a run's tracks as measured, and the factor on the stated noise that estimators were to use."""

    measured_px: float = float("nan")  # scatter, as the newest frame knows it
    factors: float = 0.0  # sum over frames, see `Observations.noise`
    frames: int = 0  # that saw something

    def add(self, measured_px: float, seen: Observations) -> None:
        """Take what a front end said with a frame."""
        if len(seen.track_ids) and np.isfinite(measured_px):
            self.measured_px = measured_px
            self.factors += seen.noise
            self.frames += 1

    def summary(self, told_px: dict[str, float]) -> dict[str, float | dict[str, float]]:
        """Return the scatter and, by estimator, the noise `told_px` and used, a mean over frames; {}: not measured."""
        if not self.frames:
            return {}
        factor = self.factors / self.frames
        used = {name: {"told_px": told, "used_px": factor * told} for name, told in told_px.items()}
        return {"measured_px": self.measured_px, **used}
