"""The fast path: an error-state Kalman filter over inertial samples, corrected by what the camera sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.config import EkfConfig, MachineConfig
from vislam.ekf.correction import Correction, Hint
from vislam.ekf.loose.filter import Ekf
from vislam.ekf.tight import CameraCalibration, MsckfEkf
from vislam.ekf.timeline import UpdateResult
from vislam.imu import ImuNoise
from vislam.sensors import Suite

if TYPE_CHECKING:  # the fast path must not load OpenCV
    from vislam.core.camera import Rig

__all__ = ["CameraCalibration", "Correction", "Ekf", "Hint", "MsckfEkf", "UpdateResult", "make_ekf"]


def make_ekf(
    config: EkfConfig, noise: ImuNoise, machine: MachineConfig, rig: Rig, suite: Suite | None = None
) -> Ekf | MsckfEkf:
    """Return the filter that `config.coupling` asks for: loose takes motions of visual odometry, tight takes tracks.

    Both take readings of the sensors of `suite`, if there are any.
    """
    if config.coupling == "tight":
        return MsckfEkf(config, noise, machine, rig, suite)
    return Ekf(config, noise, machine, rig.T_body_cam0, suite)
