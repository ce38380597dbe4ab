"""The course of a cart over the floor since a keyframe: what is expected of the next frame, and how fast it goes.

Motions [3] are theta, x and y of the level frame.
"""

import numpy as np

from vislam.core.messages import Array
from vislam.frontend.planar.floor import Turn


class Course:
    """Predicts by the velocity seen last and by the gyroscope's yaw.

    Attributes:
        motion: [3] since the keyframe, of the newest frame; predicted while lost.
        rate: [3] per second, in the level frame of the frame it leads to.
        yaw_rad: since the keyframe, by the gyroscope.
        yaw_sigma_rad: of that, by the gyroscope's bias; infinite: not known.
    """

    def __init__(self, patience_s: float) -> None:
        """Start at rest; after `patience_s` without a frame the velocity is forgotten."""
        self._patience_s = patience_s
        self._is_lost = False
        self.rate: Array = np.zeros(3)
        self.begin()

    def begin(self, at_rest: bool = False) -> None:
        """Begin anew at a keyframe; `at_rest` also forgets the velocity."""
        self.motion: Array = np.zeros(3)
        self.yaw_rad, self.yaw_sigma_rad = 0.0, 0.0
        if at_rest:
            self.rate, self._is_lost = np.zeros(3), False

    @property
    def knows_yaw(self) -> bool:
        """Whether the gyroscope has told the whole yaw since the keyframe."""
        return bool(np.isfinite(self.yaw_sigma_rad))

    def predicted(self, turn: Turn, dt_s: float, gyro_sigma_rad_s: float) -> Array:
        """Return the motion [3] expected `dt_s` after the newest frame, and add up what the gyroscope says of yaw."""
        if turn.known:
            self.yaw_rad += turn.yaw_rad
            self.yaw_sigma_rad += gyro_sigma_rad_s * dt_s
        else:
            self.yaw_sigma_rad = np.inf
        rate = self.rate if dt_s <= self._patience_s else np.zeros(3)
        yaw = turn.yaw_rad if turn.known else float(rate[0] * dt_s)
        return _composed(self.motion, np.array([yaw, rate[1] * dt_s, rate[2] * dt_s]))

    def follow(self, found: Array, dt_s: float) -> None:
        """Take note of the velocity that leads to the motion found."""
        step = _between(self.motion, found)
        self.rate = step / dt_s if not self._is_lost else np.zeros(3)
        self.motion, self._is_lost = found.copy(), False

    def lose(self, guess: Array) -> None:
        """Go on where the cart should be by now, for the frame did not tell."""
        self.motion, self._is_lost = guess, True


def _rotated(xy: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * xy[0] - s * xy[1], s * xy[0] + c * xy[1]])


def _composed(motion: Array, step: Array) -> Array:
    """Return a motion [3] followed by a step [3] in the frame it leads to."""
    return np.array([motion[0] + step[0], *(motion[1:] + _rotated(step[1:], motion[0]))])


def _between(a: Array, b: Array) -> Array:
    """Return the step [3] that leads from motion a to motion b, in the frame that a leads to."""
    return np.array([b[0] - a[0], *_rotated(b[1:] - a[1:], -a[0])])
