"""A GY-85 without hardware: virtual chips under the real smbus2, byte for byte, driven by a motion that is known."""

from vislam.hw.emulator.board import emulated_gy85
from vislam.hw.emulator.bus import EmulatedBus, emulated_bus
from vislam.hw.emulator.chips import VirtualAdxl345, VirtualItg3205
from vislam.hw.emulator.magnetometers import VirtualHmc5883l, VirtualQmc5883
from vislam.hw.emulator.sensing import SensorError, Truth
from vislam.hw.emulator.stepped_clock import SteppedClock

__all__ = [
    "EmulatedBus",
    "SensorError",
    "SteppedClock",
    "Truth",
    "VirtualAdxl345",
    "VirtualHmc5883l",
    "VirtualItg3205",
    "VirtualQmc5883",
    "emulated_bus",
    "emulated_gy85",
]
