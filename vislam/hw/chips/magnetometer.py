"""Which magnetometer is on a board, by address and id."""

from vislam.hw.chips import akm, hmc5883l, lis3mdl
from vislam.hw.chips.bus import I2cBus
from vislam.hw.chips.field import Magnetometer
from vislam.hw.chips.qmc5883 import QMC5883L, QMC5883P, Qmc5883


def find_magnetometer(bus: I2cBus, range_ga: float) -> Magnetometer | None:
    """Return the magnetometer of a GY-85 that answers by address and id, not yet set up; None if none does.

    A DA5883 identifies as an HMC5883L and shows itself by its status only; see `Hmc5883l.name`. Raises BusError.
    """
    address = hmc5883l.ADDRESS
    if bus.answers(address, hmc5883l.ID_REGISTER) and bus.read(address, hmc5883l.ID_REGISTER, 3) == hmc5883l.IDS:
        return hmc5883l.Hmc5883l(bus, range_ga)
    for variant in (QMC5883L, QMC5883P):
        if (
            bus.answers(variant.address, variant.id_register)
            and bus.read(variant.address, variant.id_register, 1)[0] == variant.id_value
        ):
            return Qmc5883(bus, range_ga, variant)
    return None


def find_any_magnetometer(bus: I2cBus, range_ga: float) -> Magnetometer | None:
    """Return any magnetometer that answers by its address and its id, not yet set up; None if none does.

    One that is inside the inertial chip answers only once that is set up. Raises BusError.
    """
    for variant in (akm.AK09916, akm.AK8963):
        if _has(bus, akm.ADDRESS, variant.id_register, variant.id_value):
            return akm.Akm(bus, variant)
    for address in lis3mdl.ADDRESSES:
        if _has(bus, address, lis3mdl.ID_REGISTER, lis3mdl.ID):
            return lis3mdl.Lis3mdl(bus, range_ga, address)
    return find_magnetometer(bus, range_ga)


def _has(bus: I2cBus, address: int, register: int, value: int) -> bool:
    return bus.answers(address, register) and bus.read(address, register, 1)[0] == value
