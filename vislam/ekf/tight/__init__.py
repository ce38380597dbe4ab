"""The tight filter: tracks correct the inertial state directly (MSCKF).

Compiled by hand: 530 lines. No peer has been measured for time; OpenVINS would be it. To be dropped for a filter that
installs as a wheel, takes measurements late and out of order, and is neither slower nor less consistent.
"""

from vislam.ekf.tight.backwards import EarlyFrames, known_from
from vislam.ekf.tight.core import CameraCalibration
from vislam.ekf.tight.filter import MsckfEkf

__all__ = [
    "CameraCalibration",
    "EarlyFrames",
    "MsckfEkf",
    "known_from",
]
