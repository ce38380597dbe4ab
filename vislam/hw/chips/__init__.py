"""The chips of an inertial board and the bus they sit on."""

from vislam.hw.chips.adxl345 import Adxl345
from vislam.hw.chips.bus import BusError, I2cBus, SettingsLostError, kernel_driver, unbind_command
from vislam.hw.chips.field import Magnetometer
from vislam.hw.chips.fifo_imu import FifoImu, ImuSetup
from vislam.hw.chips.hmc5883l import Hmc5883l
from vislam.hw.chips.itg3205 import Itg3205
from vislam.hw.chips.known import (
    IMU_NAMES,
    find_any_magnetometer,
    find_imu,
    find_magnetometer,
    identify,
    use_clone,
)
from vislam.hw.chips.self_test import SelfTest

__all__ = [
    "IMU_NAMES",
    "Adxl345",
    "BusError",
    "FifoImu",
    "Hmc5883l",
    "I2cBus",
    "ImuSetup",
    "Itg3205",
    "Magnetometer",
    "SelfTest",
    "SettingsLostError",
    "find_any_magnetometer",
    "find_imu",
    "find_magnetometer",
    "identify",
    "kernel_driver",
    "unbind_command",
    "use_clone",
]
