"""The short --help of verbs with hundreds of settings: examples, the verb's own options, what people change."""

import inspect
import re
import shutil
import textwrap
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from vislam.cli.verbs import VERBS
from vislam.config.ranges import Setting, settings_of

COMMON = (
    "frontend.mode", "frontend.max_tracks", "frontend.readout_s", "frontend.planar.height_m", "calibration.camera",
    "calibration.imu", "calibration.imu_noise", "imu.enabled", "imu.gyroscope_noise_density",
    "imu.accelerometer_noise_density", "ekf.coupling", "window.keyframes", "loop.enabled", "loop.vocabulary",
    "loop.tag_size_m", "map.enabled", "map.resolution_m", "map.max_range_m", "map.products", "map.mono_depth.enabled",
    "view.enabled", "up", "seed",
)  # fmt: skip
_COLUMN = 40
_WIDEST = 120
_NARROWEST = 80


@dataclass(frozen=True, slots=True)
class Brief:
    """Contents of a verb's short help.

    Attributes:
        usage: after `vislam VERB`.
        examples: whole commands.
        often: dotted names of the settings that people change.
        taken: options that the verb takes before the others, and what they are for.
    """

    usage: str
    examples: tuple[str, ...]
    often: tuple[str, ...]
    taken: dict[str, str]


def brief_help(verb: str, options: type, brief: Brief) -> str:
    """Return the short help of a verb, as wide as the terminal."""
    width = min(max(shutil.get_terminal_size().columns, _NARROWEST), _WIDEST)
    settings = {".".join(setting.path): setting for setting in settings_of(options)}
    own = [setting for setting in settings.values() if setting.owner.__module__.startswith("vislam.cli.")]
    rest = len(settings) - len(own)
    lines = [f"usage: vislam {verb} {brief.usage}", "", VERBS[verb].summary, "", "examples:"]
    lines += [f"  {example}" for example in brief.examples]
    lines += ["", "options:", *(line for s in own for line in _lines(_left(s), said_of(s), width))]
    lines += [line for name, text in brief.taken.items() for line in _lines(name, text, width)]
    lines += ["", f"settings that people change, of {rest}; --help-all has the others, docs/config.md files of them:"]
    lines += [line for name in brief.often for line in _setting(settings[name], width)]
    return "\n".join(lines)


def said_of(setting: Setting) -> str:
    """Return a setting's description in the source: behind it, in the lines above it, or in the string below it."""
    name = re.escape(setting.path[-1])
    owner = next(cls for cls in setting.owner.__mro__ if setting.path[-1] in vars(cls).get("__annotations__", {}))
    source = inspect.getsource(owner)
    behind = re.search(rf"^    {name}: [^\n]*?  # (.+)$", source, re.MULTILINE)
    below = re.search(rf'^    {name}: [^\n]*\n    """(.+?)"""', source, re.MULTILINE | re.DOTALL)
    above = re.search(rf"((?:^    # [^\n]+\n)+)    {name}: ", source, re.MULTILINE)
    if behind:
        return behind[1]
    if below:
        return " ".join(below[1].split())
    return " ".join(re.findall(r"# (.+)", above[1])) if above else ""


def flags_of(setting: Setting) -> tuple[str, ...]:
    """Return the options that set it: for yes and no two, nothing for an argument without a name."""
    extras = getattr(setting.type, "__metadata__", ())
    if any(repr(extra) == "Positional" for extra in extras):
        return ()
    head, _, last = setting.option[2:].rpartition(".")
    last = next((extra.name for extra in extras if getattr(extra, "name", None)), last)
    dot = "." if head else ""
    option = f"--{head}{dot}{last}"
    return (option, f"--{head}{dot}no-{last}") if _plain(setting.type) is bool else (option,)


def choices_of(hint: Any) -> tuple[str, ...]:
    """Return the words that a type allows; empty where it is no choice."""
    plain = _plain(hint)
    if get_origin(plain) is Literal:
        return tuple(map(str, get_args(plain)))
    return choices_of(get_args(plain)[0]) if get_origin(plain) is tuple else ()


def _setting(setting: Setting, width: int) -> list[str]:
    """Return the lines of a setting: what it is up to the first semicolon, and its default."""
    default = setting.value
    if isinstance(default, tuple):
        default = " ".join(map(str, default))
    shown = "" if default is None or isinstance(default, bool) else f" [{default}]"
    return _lines(_left(setting), said_of(setting).split(";")[0] + shown, width)


def _left(setting: Setting) -> str:
    """Return the option of a setting and what follows it; of yes and no the one that changes something."""
    flags = flags_of(setting)
    if not flags:
        return setting.path[-1].upper()
    if _plain(setting.type) is bool:
        return flags[1] if setting.value is True else flags[0]
    for extra in getattr(setting.type, "__metadata__", ()):
        if getattr(extra, "metavar", None):
            return f"{flags[0]} {extra.metavar}"
    choices = choices_of(setting.type)
    many = " ..." if get_origin(_plain(setting.type)) is tuple else ""
    if choices and sum(map(len, choices)) < 36:
        return f"{flags[0]} {{{','.join(choices)}}}{many}"
    return f"{flags[0]} {_kind(setting.type)}{many}"


def _kind(hint: Any) -> str:
    plain = _plain(hint)
    if get_origin(plain) is tuple:
        return _kind(get_args(plain)[0])
    return {int: "N", float: "X", Path: "PATH", str: "TEXT"}.get(plain, "WORD")


def _plain(hint: Any) -> Any:
    """Return a type without its ranges and without None."""
    if hasattr(hint, "__metadata__"):
        return _plain(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        return _plain(next(part for part in get_args(hint) if part is not type(None)))
    return hint


def _lines(left: str, text: str, width: int) -> list[str]:
    """Return text beside what it is about, below it where that is too long."""
    wrapped = textwrap.wrap(text, width - _COLUMN) or [""]
    first = f"  {left}"
    if len(first) >= _COLUMN:
        return [first, *(" " * _COLUMN + line for line in wrapped)]
    return [f"{first:<{_COLUMN}}{wrapped[0]}", *(" " * _COLUMN + line for line in wrapped[1:])]
