"""Which chip is which, by address and id: the one table by which drivers find theirs and the doctor names all."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from vislam.core.errors import HardwareError
from vislam.hw.chips import adxl345, akm, bmi270, hmc5883l, icm20948, itg3205, lis3mdl, lsm6dsox, mpu6050
from vislam.hw.chips.bus import BusError, I2cBus
from vislam.hw.chips.field import Magnetometer
from vislam.hw.chips.fifo_imu import FifoImu, ImuSetup
from vislam.hw.chips.qmc5883 import QMC5883L, QMC5883P, Qmc5883

_ASKED_TIMES = 3  # a chip that does not answer may have been disturbed


@dataclass(frozen=True, slots=True)
class Known:
    """A chip, or a family with one register map, and how it identifies itself."""

    addresses: tuple[int, ...]
    register: int
    ids: dict[bytes, str]  # what is in that register -> name
    is_elsewhere: bool = False  # at the address that it has with its address pin tied the other way

    def at(self, bus: I2cBus, address: int) -> bool:
        """Return whether such a chip answers at an address; raises BusError."""
        return bus.answers(address, self.register) and bus.read(address, self.register, self.length) in self.ids

    @property
    def length(self) -> int:
        """How many bytes its id has."""
        return len(next(iter(self.ids)))


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownMagnetometer(Known):
    """A magnetometer."""

    make: Callable[[I2cBus, float, int], Magnetometer]  # of a range in gauss and its address


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownImu(Known):
    """A chip with a FIFO."""

    chip: str  # as the settings call it
    make: Callable[[I2cBus, ImuSetup, int], FifoImu]
    clone: str = ""  # the name with which a command line takes a clone
    clone_ids: frozenset[int] = frozenset()  # seen on boards that are sold as the first of `ids`

    def cloned(self, found: int) -> str:
        """Return what a chip of this id is likely to be, in words; empty: no clone."""
        if found not in self.clone_ids:
            return ""
        likely = next(iter(self.ids.values()))
        return f"likely a clone of the {likely} (0x{found:02x} in register 0x{self.register:02x})"


@dataclass(frozen=True, slots=True)
class FoundChip:
    """A chip that said who it is."""

    name: str
    address: int
    is_elsewhere: bool = False
    clone: str = ""  # the name with which a command line takes it, if it is a likely clone


def _bytes(ids: dict[int, str]) -> dict[bytes, str]:
    return {bytes([value]): name for value, name in ids.items()}


KNOWN_IMUS = (
    KnownImu(lsm6dsox.ADDRESSES, lsm6dsox.ID_REGISTER, _bytes(lsm6dsox.IDS), chip="lsm6dsox", make=lsm6dsox.Lsm6dsox),
    KnownImu(icm20948.ADDRESSES, icm20948.ID_REGISTER, _bytes(icm20948.IDS), chip="icm20948", make=icm20948.Icm20948),
    KnownImu(bmi270.ADDRESSES, bmi270.ID_REGISTER, _bytes(bmi270.IDS), chip="bmi270", make=bmi270.Bmi270),
    KnownImu(
        mpu6050.ADDRESSES, mpu6050.ID_REGISTER, _bytes(mpu6050.IDS), chip="mpu6050", make=mpu6050.Mpu6050,
        clone=mpu6050.CLONE, clone_ids=mpu6050.CLONE_IDS,
    ),
)  # fmt: skip
IMU_NAMES = frozenset(name for known in KNOWN_IMUS for name in known.ids.values())
# a DA5883 identifies as an HMC5883L and shows itself by its status only; see `Hmc5883l.name`
_OF_A_GY85 = (
    KnownMagnetometer(
        (hmc5883l.ADDRESS,), hmc5883l.ID_REGISTER, {hmc5883l.IDS: "HMC5883L or DA5883"}, make=hmc5883l.Hmc5883l
    ),
    *(
        KnownMagnetometer((v.address,), v.id_register, _bytes({v.id_value: v.name}), make=partial(Qmc5883, v))
        for v in (QMC5883L, QMC5883P)
    ),
)
_MAGNETOMETERS = (
    *(
        KnownMagnetometer((akm.ADDRESS,), v.id_register, _bytes({v.id_value: v.name}), make=partial(akm.Akm, v))
        for v in (akm.AK09916, akm.AK8963)
    ),
    KnownMagnetometer(lis3mdl.ADDRESSES, lis3mdl.ID_REGISTER, _bytes({lis3mdl.ID: "LIS3MDL"}), make=lis3mdl.Lis3mdl),
    *_OF_A_GY85,
)
_ADXL345, _ITG3205 = {b"\xe5": "ADXL345"}, {b"\x68": "ITG3205", b"\x69": "ITG3205"}
_KNOWN: tuple[Known, ...] = (
    Known((adxl345.ADDRESS,), 0x00, _ADXL345),
    Known((0x1D,), 0x00, _ADXL345, True),
    Known((itg3205.ADDRESS,), 0x00, _ITG3205),
    Known((0x69,), 0x00, _ITG3205, True),
    *KNOWN_IMUS,
    *_MAGNETOMETERS,
)


def find_magnetometer(
    bus: I2cBus, range_ga: float, known: Iterable[KnownMagnetometer] = _OF_A_GY85
) -> Magnetometer | None:
    """Return the magnetometer of a GY-85 that answers by address and id, not yet set up; None if none does.

    Raises BusError.
    """
    for one in known:
        for address in one.addresses:
            if one.at(bus, address):
                return one.make(bus, range_ga, address)
    return None


def find_any_magnetometer(bus: I2cBus, range_ga: float) -> Magnetometer | None:
    """Return any magnetometer; one that is inside the inertial chip answers only once that is set up."""
    return find_magnetometer(bus, range_ga, _MAGNETOMETERS)


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
            if not bus.answers(place, known.register, _ASKED_TIMES):
                continue
            answer = bus.read(place, known.register, 1)
            found = answer[0]
            if answer in known.ids or (known.cloned(found) and setup.named == known.clone):
                return known.make(bus, setup, place)
            if known.cloned(found):
                clone = f"the chip at 0x{place:02x} is {known.cloned(found)}; {use_clone(known.clone, bus.path)}"
            others.append(f"0x{place:02x} has 0x{found:02x} in register 0x{known.register:02x}")
    if clone:
        raise HardwareError(f"{bus.path}: {clone}")
    places = ", ".join(f"0x{place:02x}" for place in sorted(set(asked)))
    what = "no inertial chip with a FIFO" if chip == "auto" else f"no {chip}"
    strangers = f" ({'; '.join(dict.fromkeys(others))})" if others else ""
    raise HardwareError(
        f"{bus.path}: {what} answers at {places}{strangers}; check power, ground, SDA and SCL, `vislam doctor` lists "
        "what answers"
    )


def identify(bus: I2cBus) -> list[FoundChip]:
    """Return the known chips of a bus and, as unknown, others at their addresses; only reads ids. Raises BusError."""
    found = []
    for address in dict.fromkeys(address for known in _KNOWN for address in known.addresses):
        here = [known for known in _KNOWN if address in known.addresses]
        if bus.answers(address, here[0].register, _ASKED_TIMES):
            found.append(_named(bus, address, here))
    return found


def _named(bus: I2cBus, address: int, here: list[Known]) -> FoundChip:
    """Return the first that a chip is of those at its address; unknown: what it answered to each of them."""
    answers = [(known, _asked(bus, address, known)) for known in here]
    for known, answer in answers:
        if answer in known.ids:
            return FoundChip(known.ids[answer], address, known.is_elsewhere)
    for known, answer in answers:
        if isinstance(known, KnownImu) and known.cloned(answer[0]):
            return FoundChip(known.cloned(answer[0]), address, clone=known.clone)
    said: dict[str, list[str]] = {}
    for known, answer in answers:
        read = f"0x{answer.hex()} in register 0x{known.register:02x}"
        said.setdefault(read, []).extend(dict.fromkeys(known.ids.values()))
    words = "; ".join(f"{read}: no {' or '.join(names)}" for read, names in said.items())
    return FoundChip(f"unknown chip ({words})", address)


def _asked(bus: I2cBus, address: int, known: Known) -> bytes:
    """Return what a chip has in a register of its id; a wire may be disturbed just then."""
    for _ in range(_ASKED_TIMES - 1):
        with suppress(BusError):
            return bus.read(address, known.register, known.length)
    return bus.read(address, known.register, known.length)
