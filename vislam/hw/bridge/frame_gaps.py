"""How many frames are missing between two that came over the serial bridge."""

from vislam.hw.bridge.protocol import Hello, RawSample

_SEQUENCES, _WRAP_US = 2**16, 2**32
_STALE_NS = 2_000_000_000  # a shorter pause is no reason to drop what a port has kept
_MOST_STALL_US = 60e6  # for which the host may be put aside while frames are dropped


class FrameGaps:
    """Owns the last frame with a sequence, and when it arrived."""

    def __init__(self) -> None:
        self._last: RawSample | Hello | None = None
        self._last_ns = 0
        self._heard_ns = 0

    def are_stale(self, now_ns: int, seen_ns: int) -> bool:
        """Return whether bytes that are read now cannot be stamped: none were read for longer than a clock was seen.

        Its rate is not known well enough then to compute how long they lay in the port.
        """
        heard_ns, self._heard_ns = self._heard_ns, now_ns
        return self._last is not None and 0 < heard_ns < now_ns - max(_STALE_NS, seen_ns)

    def before(self, frame: RawSample | Hello, arrival_ns: int) -> int | None:
        """Return how many frames are missing before this one; None where the device began again.

        Its first samples come before the hello that states so: its time goes back, or on by far more than the host's.
        """
        last, last_ns = self._last, self._last_ns
        self._last, self._last_ns = frame, arrival_ns
        if last is None:
            return 0
        on_us = (frame.t_us - last.t_us) % _WRAP_US
        if on_us > (arrival_ns - last_ns) / 1000.0 + _MOST_STALL_US:
            return None
        return (frame.sequence - last.sequence - 1) % _SEQUENCES
