"""How cameras and inertial unit sit to each other, in space and time."""

from vislam.calibration.extrinsics.hand_eye import HandEye, RotationPair, solve_hand_eye

__all__ = ["HandEye", "RotationPair", "solve_hand_eye"]
