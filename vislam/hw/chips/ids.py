"""Which chips answer on a bus, by address and id."""

from contextlib import suppress
from dataclasses import dataclass

from vislam.hw.chips import adxl345, akm, hmc5883l, itg3205, lis3mdl
from vislam.hw.chips.bus import BusError, I2cBus
from vislam.hw.chips.imus import KNOWN_IMUS, KnownImu
from vislam.hw.chips.qmc5883 import QMC5883L, QMC5883P


@dataclass(frozen=True, slots=True)
class FoundChip:
    """A chip that said who it is."""

    name: str
    address: int
    is_elsewhere: bool = False  # at the address that it has with its address pin tied the other way
    clone: str = ""  # the name with which a command line takes it, if it is a likely clone


_ASKED_TIMES = 3  # a chip that does not answer may have been disturbed


@dataclass(frozen=True, slots=True)
class _Candidate:
    """What may sit at an address, and how it identifies itself."""

    address: int
    register: int
    names: dict[bytes, str]  # by what is in the register
    is_elsewhere: bool = False
    imu: KnownImu | None = None


_ITG3205 = {b"\x68": "ITG3205", b"\x69": "ITG3205"}
_LIS3MDL = {bytes([lis3mdl.ID]): "LIS3MDL"}
_KNOWN = (
    _Candidate(adxl345.ADDRESS, 0x00, {b"\xe5": "ADXL345"}),
    _Candidate(0x1D, 0x00, {b"\xe5": "ADXL345"}, True),
    _Candidate(itg3205.ADDRESS, 0x00, _ITG3205),
    _Candidate(0x69, 0x00, _ITG3205, True),
    _Candidate(hmc5883l.ADDRESS, hmc5883l.ID_REGISTER, {hmc5883l.IDS: "HMC5883L or DA5883"}),
    *(_Candidate(v.address, v.id_register, {bytes([v.id_value]): v.name}) for v in (QMC5883L, QMC5883P)),
    *(
        _Candidate(address, known.id_register, {bytes([value]): name for value, name in known.ids.items()}, imu=known)
        for known in KNOWN_IMUS
        for address in known.addresses
    ),
    *(_Candidate(address, lis3mdl.ID_REGISTER, _LIS3MDL) for address in lis3mdl.ADDRESSES),
    *(_Candidate(akm.ADDRESS, v.id_register, {bytes([v.id_value]): v.name}) for v in (akm.AK09916, akm.AK8963)),
)
IMU_NAMES = frozenset(name for known in KNOWN_IMUS for name in known.ids.values())


def identify(bus: I2cBus) -> list[FoundChip]:
    """Return the known chips of a bus and, as unknown, others at their addresses; only reads ids. Raises BusError."""
    found = []
    for address in dict.fromkeys(candidate.address for candidate in _KNOWN):
        candidates = [candidate for candidate in _KNOWN if candidate.address == address]
        if bus.answers(address, candidates[0].register, _ASKED_TIMES):
            found.append(_named(bus, candidates))
    return found


def _named(bus: I2cBus, candidates: list[_Candidate]) -> FoundChip:
    """Return the first candidate that the chip at their address is; unknown: what it answered to each of them."""
    answers = [(candidate, _asked(bus, candidate)) for candidate in candidates]
    for candidate, answer in answers:
        if answer in candidate.names:
            return FoundChip(candidate.names[answer], candidate.address, candidate.is_elsewhere)
    for candidate, answer in answers:
        if candidate.imu is not None and candidate.imu.cloned(answer[0]):
            return FoundChip(candidate.imu.cloned(answer[0]), candidate.address, clone=candidate.imu.clone)
    said: dict[str, list[str]] = {}
    for candidate, answer in answers:
        read = f"0x{answer.hex()} in register 0x{candidate.register:02x}"
        said.setdefault(read, []).extend(dict.fromkeys(candidate.names.values()))
    words = "; ".join(f"{read}: no {' or '.join(names)}" for read, names in said.items())
    return FoundChip(f"unknown chip ({words})", candidates[0].address)


def _asked(bus: I2cBus, candidate: _Candidate) -> bytes:
    """Return what a chip has in a register of its id; a wire may be disturbed just then."""
    length = len(next(iter(candidate.names)))
    for _ in range(_ASKED_TIMES - 1):
        with suppress(BusError):
            return bus.read(candidate.address, candidate.register, length)
    return bus.read(candidate.address, candidate.register, length)
