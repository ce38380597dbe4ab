"""How cameras and inertial unit sit to each other, in space and time."""

from vislam.calibration.extrinsics.hand_eye import HandEye, solve_hand_eye
from vislam.calibration.extrinsics.visual_rotation import RotationPair

__all__ = ["HandEye", "RotationPair", "solve_hand_eye"]
