"""The chips of an inertial board and the bus they sit on."""

from vislam.hw.chips.adxl345 import Adxl345
from vislam.hw.chips.bus import BusError, I2cBus, SettingsLostError, kernel_driver, unbind_command
from vislam.hw.chips.field import Magnetometer
from vislam.hw.chips.hmc5883l import Hmc5883l
from vislam.hw.chips.ids import identify
from vislam.hw.chips.itg3205 import Itg3205
from vislam.hw.chips.magnetometer import find_magnetometer
from vislam.hw.chips.self_test import SelfTest

__all__ = [
    "Adxl345",
    "BusError",
    "Hmc5883l",
    "I2cBus",
    "Itg3205",
    "Magnetometer",
    "SelfTest",
    "SettingsLostError",
    "find_magnetometer",
    "identify",
    "kernel_driver",
    "unbind_command",
]
