"""The errors a user of vislam can meet. Each message says what happened, where, asked versus got, and the next step."""


class VislamError(Exception):
    """Root of every expected failure; the command line turns it into one line and `exit_code`."""

    exit_code = 3


class UsageError(VislamError):
    """The caller asked for something that does not exist or does not fit together (exit code 2)."""

    exit_code = 2


class DataError(VislamError):
    """A recording, file or calibration cannot be used as it is (exit code 3)."""


class TrackingLostError(VislamError):
    """A run ended without a usable trajectory, or a quality gate failed (exit code 4)."""

    exit_code = 4


class HardwareError(VislamError):
    """A sensor, bus or port does not answer as its datasheet says (exit code 5)."""

    exit_code = 5


class StorageError(VislamError):
    """Something could not be written: full disk, missing permission (exit code 3)."""
