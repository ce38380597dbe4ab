"""What the names above a table of poses say of its columns: which they are, and their units."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from vislam.core.errors import DataError

STAMP_UNITS = {"ns": 1.0, "nsec": 1.0, "nanosec": 1.0, "nanoseconds": 1.0, "us": 1e3, "usec": 1e3, "ms": 1e6,
               "msec": 1e6, "millis": 1e6, "milliseconds": 1e6, "s": 1e9, "sec": 1e9, "secs": 1e9,
               "seconds": 1e9}  # fmt: skip
_TIMES = {"t", "ts", "time", "timestamp", "timestamps", "stamp", "sec", "secs", "seconds", "utime"}
_TURNS = {"q", "quat", "quaternion", "orientation", "rotation", "rot", "ori", "o"}
_PLACES = {"p", "pos", "position", "t", "translation", "trans", "location"}
_RATES = {"v", "vel", "velocity", "twist", "linear", "angular", "b", "bias", "cov", "covariance", "sigma", "std", "acc",
          "rate", "speed", "err", "error"}  # fmt: skip
_WHOLE = {"q": ["qx", "qy", "qz", "qw"], "p": ["px", "py", "pz"]}
_DEGREES = {"lat", "latitude", "lon", "lng", "longitude"}
_COUNTED = {"frame", "frames", "index", "idx", "id", "seq", "image", "keyframe", "kf"}
_LENGTHS = {"m": 1.0, "metres": 1.0, "meters": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.0, "feet": 0.0}
_ANGLES = ("roll", "pitch", "yaw")
_ANGLE_UNITS = {"rad": False, "radians": False, "deg": True, "degree": True, "degrees": True, "°": True}
# what turns without saying how: their order, axes or unit are anybody's guess
_UNCLEAR = {*_ANGLES, *_TURNS, "r", "rx", "ry", "rz", "theta", "phi", "psi", "heading", "azimuth", "bearing", "course",
            "euler", "angle", "angles", "axis", "rotvec", "rodrigues"} - {"o"}  # fmt: skip


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Where a pose stands by a table's header."""

    stamp: int
    position: tuple[int, ...]  # x y z
    turn: tuple[int, ...] = ()  # of a quaternion x y z w, or of roll pitch yaw; none: positions only
    unit_ns: float | None = None  # of the stamps, None where it is not named
    nanos: int | None = None  # column of the nanoseconds behind whole seconds
    unit_m: float = 1.0  # of the position
    in_degrees: bool = False


def named_columns(path: Path, names: list[str]) -> NamedColumns | None:
    """Return where a pose stands by the names of all columns; None where they do not name all that is needed.

    Raises DataError for names of what is no pose in metres, or of a rotation whose convention they do not settle.
    """
    _refuse_others(path, names)
    roles = [_role(name) for name in names]
    position, turn = (
        tuple(roles.index(kind + axis) for axis in axes if kind + axis in roles)
        for kind, axes in (("p", "xyz"), ("q", "xyzw"))
    )
    stamps = [k for k, role in enumerate(roles) if role == "t"]
    if not stamps or not position:
        return None
    twice = [role for role, count in Counter(roles).items() if count > 1 and role not in ("", "t")]
    if len(position) != 3 or twice:
        which = [name for name, role in zip(names, roles, strict=True) if role[:1] == "p" or role in twice]
        raise DataError(f"{path}: one column of each x, y, z is wanted; it names {', '.join(which)[:120]}")
    stamp = next((k for k in stamps if "stamp" in names[k].lower()), stamps[0])
    nanos, unit_ns = (
        _nanos_of(names, stamp),
        next((STAMP_UNITS[w] for w in _words(names[stamp])[1:] if w in STAMP_UNITS), None),
    )
    if nanos is not None:
        unit_ns = 1e9
    in_degrees = False
    if len(turn) != 4:
        turn, in_degrees = _angles(path, names)
    units = {_LENGTHS[word] for k in position for word in _words(names[k])[1:] if word in _LENGTHS} or {1.0}
    if len(units) > 1 or not min(units):
        raise DataError(f"{path}: {', '.join(names[k] for k in position)[:120]} are not all metres; convert them")
    return NamedColumns(stamp, position, turn, unit_ns, nanos, units.pop(), in_degrees)


def whole_names(names: list[str], width: int) -> list[str]:
    """Return the names of the columns of a wider table, of which the first are a pose's; empty where they are not.

    OpenVINS names its states so, and all columns of one quantity at once: timestamp(s) q p v bg ba.
    """
    whole = [axis for name in names[:8] for axis in _WHOLE.get(name, [name])][:8]
    is_pose = width > 8 and sorted(map(_role, whole)) == sorted(["t", *_WHOLE["p"], *_WHOLE["q"]])
    return whole + [""] * (width - 8) if is_pose else []


def _angles(path: Path, names: list[str]) -> tuple[tuple[int, ...], bool]:
    """Return the columns of roll, pitch, yaw and whether they are in degrees; none where nothing is named that turns.

    R = Rz(yaw) Ry(pitch) Rx(roll), as everybody has it who writes these three words. Raises DataError for angles,
    axes and matrices of which order or unit are not named.
    """
    turning = [k for k, name in enumerate(names) if _turns(name)]
    if not turning:
        return (), False
    of = {word: k for k in turning for word in _words(names[k]) if word in _ANGLES}
    units = [next((_ANGLE_UNITS[w] for w in _words(names[k]) if w in _ANGLE_UNITS), None) for k in turning]
    if len(of) == len(turning) == 3 and units[0] is not None and len(set(units)) == 1:
        return tuple(of[angle] for angle in _ANGLES), units[0]
    raise DataError(
        f"{path}: {', '.join(names[k] for k in turning)[:120]}: which rotation these are is not stated; name them "
        "roll_deg, pitch_deg, yaw_deg (or _rad; R = Rz Ry Rx), write qx, qy, qz, qw, or leave them out"
    )


def _turns(name: str) -> bool:
    words, role = set(_words(name)), _role(name)[:1]
    is_matrix = re.fullmatch(r"r_?\d_?\d", name.lower()) is not None
    return role == "q" or (not role and not _RATES & words and (is_matrix or bool(_UNCLEAR & words)))


def _refuse_others(path: Path, names: list[str]) -> None:
    """Raise DataError for columns that are named, but hold neither metres nor times."""
    if _DEGREES & {word for name in names for word in _words(name)}:
        raise DataError(
            f"{path} holds latitude and longitude ({', '.join(names)[:80]}), which are no metres; convert them to "
            "east, north, up"
        )
    if names and not any(_role(name) == "t" for name in names) and _COUNTED & {*_words(names[0])}:
        raise DataError(f"{path}: no column is a time, the first is '{names[0][:40]}'; put the time of each pose there")


def _nanos_of(names: list[str], stamp: int) -> int | None:
    """Return the column of nanoseconds that belongs to one of whole seconds, as ROS's stamps are written apart."""
    *before, last = _words(names[stamp])
    pairs = {"sec": ("nanosec", "nsec"), "secs": ("nsecs",), "s": ("ns",)}
    wanted = [[*before, other] for other in pairs.get(last, ())]
    return next((k for k, name in enumerate(names) if _words(name) in wanted), None)


def _role(name: str) -> str:
    """Return "t", "px" to "pz", "qx" to "qw", or nothing, for what a column holds by its name."""
    words = _words(re.sub(r"[\[(].*", "", name))
    if len(words) > 1 and words[-1] in _LENGTHS:
        words.pop()
    if not words:
        return ""
    *before, last = words
    if "stamp" in words or (words[0] in _TIMES and last not in "xyz") or words[0].endswith(("time", "timestamp")):
        return "t"
    if _RATES & set(words):
        return ""
    if len(last) == 2 and last[1] in "xyzw" and last[0] in "ptqo":  # tx, qw
        return ("q" if last[0] in "qo" else "p") + last[1]
    if last == "w" or (last in "xyz" and _TURNS & set(before)):
        return "q" + last
    return "p" + last if last in ("x", "y", "z") and (not before or _PLACES & set(before)) else ""


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+|°", name.lower())
