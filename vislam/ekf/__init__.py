"""The fast path: an error-state Kalman filter over inertial samples, corrected by what the camera sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.config import EkfConfig
from vislam.ekf.correction import Correction, Hint
from vislam.ekf.loose.filter import Ekf
from vislam.ekf.tight import CameraCalibration, MsckfEkf
from vislam.ekf.timeline import UpdateResult
from vislam.imu import ImuNoise

if TYPE_CHECKING:  # the fast path must not load OpenCV
    from vislam.core.camera import Rig

__all__ = ["CameraCalibration", "Correction", "Ekf", "Hint", "MsckfEkf", "UpdateResult", "make_ekf"]


def make_ekf(config: EkfConfig, noise: ImuNoise, gravity_m_s2: float, rig: Rig) -> Ekf | MsckfEkf:
    """Return the filter that `config.coupling` asks for: loose takes motions of visual odometry, tight takes tracks."""
    if config.coupling == "tight":
        return MsckfEkf(config, noise, gravity_m_s2, rig)
    return Ekf(config, noise, gravity_m_s2, rig.T_body_cams[0])
