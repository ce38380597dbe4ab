"""Boards without hardware: virtual chips under the real smbus2, byte for byte, driven by a motion that is known."""

from vislam.hw.emulator.bmi270 import VirtualBmi270
from vislam.hw.emulator.board import emulated_board, emulated_gy85, gy85_errors
from vislam.hw.emulator.bridge import BridgeEmulator, LineFaults
from vislam.hw.emulator.bus import EmulatedBus, emulated_bus
from vislam.hw.emulator.chips import VirtualAdxl345, VirtualItg3205
from vislam.hw.emulator.fifo_chip import FifoChip
from vislam.hw.emulator.icm20948 import VirtualIcm20948
from vislam.hw.emulator.lsm6dsox import VirtualLsm6dsox
from vislam.hw.emulator.magnetometers import VirtualAkm, VirtualHmc5883l, VirtualLis3mdl, VirtualQmc5883
from vislam.hw.emulator.mpu6050 import VirtualMpu6050
from vislam.hw.emulator.sensing import SensorError, Truth
from vislam.hw.emulator.stepped_clock import SteppedClock

__all__ = [
    "BridgeEmulator",
    "EmulatedBus",
    "FifoChip",
    "LineFaults",
    "SensorError",
    "SteppedClock",
    "Truth",
    "VirtualAdxl345",
    "VirtualAkm",
    "VirtualBmi270",
    "VirtualHmc5883l",
    "VirtualIcm20948",
    "VirtualItg3205",
    "VirtualLis3mdl",
    "VirtualLsm6dsox",
    "VirtualMpu6050",
    "VirtualQmc5883",
    "emulated_board",
    "emulated_bus",
    "emulated_gy85",
    "gy85_errors",
]
