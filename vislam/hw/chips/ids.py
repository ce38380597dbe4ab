"""Which chips answer on a bus, by address and id."""

from __future__ import annotations

from dataclasses import dataclass

from vislam.hw.chips import adxl345, hmc5883l, itg3205
from vislam.hw.chips.bus import I2cBus
from vislam.hw.chips.qmc5883 import QMC5883L, QMC5883P


@dataclass(frozen=True, slots=True)
class FoundChip:
    """A chip that said who it is."""

    name: str
    address: int
    is_elsewhere: bool  # at the address that it has with its address pin tied the other way


_ASKED_TIMES = 3  # a chip that does not answer may have been disturbed

# name, address, id register, ids allowed, whether the address is not a GY-85's
_KNOWN = (
    ("ADXL345", adxl345.ADDRESS, 0x00, (b"\xe5",), False),
    ("ADXL345", 0x1D, 0x00, (b"\xe5",), True),
    ("ITG3205", itg3205.ADDRESS, 0x00, (b"\x68", b"\x69"), False),
    ("ITG3205", 0x69, 0x00, (b"\x68", b"\x69"), True),
    ("HMC5883L or DA5883", hmc5883l.ADDRESS, hmc5883l.ID_REGISTER, (hmc5883l.IDS,), False),
    *(
        (variant.name, variant.address, variant.id_register, (bytes([variant.id_value]),), False)
        for variant in (QMC5883L, QMC5883P)
    ),
)


def identify(bus: I2cBus) -> list[FoundChip]:
    """Return the known chips of a bus and, as unknown, others at their addresses; only reads ids. Raises BusError."""
    found = []
    for name, address, register, ids, is_elsewhere in _KNOWN:
        if not bus.answers(address, register, _ASKED_TIMES):
            continue
        answer = bus.read(address, register, len(ids[0]))
        if answer in ids:
            found.append(FoundChip(name, address, is_elsewhere))
        else:
            found.append(FoundChip(f"unknown chip (id {answer.hex()}, not a {name})", address, False))
    return found
