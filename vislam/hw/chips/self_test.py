"""What a chip's self-test found."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SelfTest:
    """The answer of one chip to its own stimulus."""

    chip: str
    passed: bool | None  # None: the chip has no self-test, or it could not be judged
    what: str  # measured against allowed, in words
    measured: tuple[float, ...] = ()  # per axis, in LSB
    next_step: str = ""
