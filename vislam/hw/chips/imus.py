"""The inertial chips with a FIFO: what they are called, where they sit, how they say who they are."""

from collections.abc import Callable
from dataclasses import dataclass

from vislam.core.errors import HardwareError
from vislam.hw.chips import bmi270, icm20948, lsm6dsox, mpu6050
from vislam.hw.chips.bus import I2cBus
from vislam.hw.chips.fifo_imu import FifoImu, ImuSetup

_ASKED_TIMES = 3  # a chip that does not answer may have been disturbed


@dataclass(frozen=True, slots=True)
class KnownImu:
    """A family of chips with one register map."""

    chip: str  # as the settings call it
    addresses: tuple[int, ...]
    id_register: int
    ids: dict[int, str]  # value of that register -> name of the chip
    make: Callable[[I2cBus, ImuSetup, int], FifoImu]
    clone: str = ""  # the name with which a command line takes a clone
    clone_ids: frozenset[int] = frozenset()  # seen on boards that are sold as the first of `ids`

    def cloned(self, found: int) -> str:
        """Return what a chip of this id is likely to be, in words; empty: no clone."""
        if found not in self.clone_ids:
            return ""
        likely = next(iter(self.ids.values()))
        return f"likely a clone of the {likely} (0x{found:02x} in register 0x{self.id_register:02x})"


# fmt: off
KNOWN_IMUS = (
    KnownImu("lsm6dsox", lsm6dsox.ADDRESSES, lsm6dsox.ID_REGISTER, lsm6dsox.IDS, lsm6dsox.Lsm6dsox),
    KnownImu("icm20948", icm20948.ADDRESSES, icm20948.ID_REGISTER, icm20948.IDS, icm20948.Icm20948),
    KnownImu("bmi270", bmi270.ADDRESSES, bmi270.ID_REGISTER, bmi270.IDS, bmi270.Bmi270),
    KnownImu("mpu6050", mpu6050.ADDRESSES, mpu6050.ID_REGISTER, mpu6050.IDS, mpu6050.Mpu6050,
             mpu6050.CLONE, mpu6050.CLONE_IDS),
)
# fmt: on


def use_clone(clone: str, path: str) -> str:
    """Return how a clone is tried and taken."""
    return f"at rest, `vislam doctor --imu {clone}:{path}` measures whether its scale fits; then use it as {clone}"


def find_imu(bus: I2cBus, setup: ImuSetup, chip: str = "auto", address: int | None = None) -> FifoImu:
    """Return the chip that is one of these by its id, not yet set up.

    Args:
        bus: on which it is.
        setup: for the chip.
        chip: family to look for, `auto`: any.
        address: where to look only; None: wherever such chips can be.

    A clone is one of these that `setup.named` asks for. Raises HardwareError: none is there, and what is in its place;
    BusError.
    """
    others, asked, clone = [], [], ""
    for known in KNOWN_IMUS:
        if chip not in ("auto", known.chip):
            continue
        for place in known.addresses if address is None else (address,):
            asked.append(place)
            if not bus.answers(place, known.id_register, _ASKED_TIMES):
                continue
            found = bus.read(place, known.id_register, 1)[0]
            if found in known.ids or (known.cloned(found) and setup.named == known.clone):
                return known.make(bus, setup, place)
            if known.cloned(found):
                clone = f"the chip at 0x{place:02x} is {known.cloned(found)}; {use_clone(known.clone, bus.path)}"
            others.append(f"0x{place:02x} has 0x{found:02x} in register 0x{known.id_register:02x}")
    if clone:
        raise HardwareError(f"{bus.path}: {clone}")
    places = ", ".join(f"0x{place:02x}" for place in sorted(set(asked)))
    what = "no inertial chip with a FIFO" if chip == "auto" else f"no {chip}"
    strangers = f" ({'; '.join(dict.fromkeys(others))})" if others else ""
    raise HardwareError(
        f"{bus.path}: {what} answers at {places}{strangers}; check power, ground, SDA and SCL, `vislam doctor` lists "
        "what answers"
    )
