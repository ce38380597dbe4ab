"""The plan of a comparison: sequences, estimators, variants and seeds, from a TOML file."""

import dataclasses
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from vislam.config import validated
from vislam.core.errors import UsageError
from vislam.core.reading import parse_toml, read_text
from vislam.experiment import commands, peers
from vislam.experiment.recordings import is_on_disk
from vislam.runs.sources import is_world, split_source

Scalar = bool | int | float | str
Settings = dict[str, Scalar]  # dotted names of the configuration, as {"graph.coupling": "tight"}
Output = Literal["ekf", "live", "graph", "batch", "causal", "final"]

_OF_PIPELINE: tuple[Output, ...] = ("ekf", "live", "graph", "batch")
_OF_PROGRAM: tuple[Output, ...] = ("causal", "final")

_VARIABLE = re.compile(r"\$\{?(\w+)\}?")
_NAME = re.compile(r"[\w.,+ \[\]%-]{1,60}")


@dataclass(frozen=True, slots=True)
class Sequence:
    """One recording, or a simulated world."""

    source: str  # as for `vislam run`; $VARIABLES are replaced, relative paths begin at the plan
    name: str = ""  # empty: the last part of the source
    options: dict[str, Scalar] = field(default_factory=dict)  # of the source: appended as ,option=value
    config: Settings = field(default_factory=dict)  # for this sequence only


@dataclass(frozen=True, slots=True)
class Estimator:
    """One configuration of the pipeline, or a program by others, and which of its trajectories are compared.

    A program is a class (`program`, see `programs`) or a command line (`command`, see `commands`), which is known of
    some systems (`peer`, see `peers`).
    """

    name: str
    config: Settings = field(default_factory=dict)
    outputs: tuple[Output, ...] | None = None  # None: filter and graph as they went, graph in the end; see `compared`
    sequences: tuple[str, ...] = ()  # names of those that it can be run on; empty: all
    program: str = ""  # FILE.py, FILE.py:CLASS or MODULE:CLASS
    options: dict[str, Scalar] = field(default_factory=dict)  # of the program: by name to its class
    command: tuple[str, ...] = ()  # words, with places such as {recording} and {causal}; $VARIABLES are replaced
    peer: str = ""  # NAME or NAME=PYTHON: the command of a system that vislam knows; empty: none

    @property
    def compared(self) -> tuple[Output, ...]:
        """The trajectories that are compared."""
        if self.outputs is not None:
            return self.outputs
        return _possible(self) if self.program or self.command else ("ekf", "live", "graph")


@dataclass(frozen=True, slots=True)
class Axis:
    """A condition that is varied: either a setting of the configuration or an option of the source."""

    name: str
    values: tuple[Scalar, ...]
    setting: str = ""  # dotted name
    option: str = ""  # name
    sequences: tuple[str, ...] = ()  # names of those for which it is varied; empty: all


@dataclass(frozen=True, slots=True)
class Plan:
    """What is compared on what: every sequence x variant x estimator x seed x member is a job."""

    name: str
    sequences: tuple[Sequence, ...]
    estimators: tuple[Estimator, ...]
    title: str = ""
    config: Settings = field(default_factory=dict)  # for every job
    axes: tuple[Axis, ...] = ()  # the variants are their product
    seeds: tuple[int, ...] = (0,)  # of the simulation and of the pipeline
    members: int = 6  # of each ensemble: gravity differs by 1e-9 between neighbours, which shows chaos
    timeout_s: float = 1800.0  # a job that takes longer is stopped and counts as failed
    # what a paired test takes as one pair: seeds of one sequence say nothing about other sequences
    pairs: Literal["seed", "sequence"] = "seed"
    map: bool = False  # mapping does not change trajectories and takes time

    def axes_of(self, sequence: str) -> tuple[Axis, ...]:
        """Return what is varied for a sequence."""
        return tuple(axis for axis in self.axes if not axis.sequences or sequence in axis.sequences)

    @property
    def axis_names(self) -> list[str]:
        """Names of what is varied, each once."""
        return list(dict.fromkeys(axis.name for axis in self.axes))


def plan_text(path: Path, programs: Iterable[str] = (), known: Iterable[str] = ()) -> str:
    """Return the text of a plan with more estimators: programs, and known systems by name.

    Raises UsageError when it cannot be read.
    """
    try:
        text = read_text(path)
    except (OSError, ValueError) as error:
        raise UsageError(_unreadable(path, error)) from error
    for program in programs:
        place, colon, cls = program.partition(":")
        where = str(Path(place).resolve()) if place.endswith(".py") else place
        name = f"{Path(place).stem} {cls}".strip()
        text += f"\n[[estimators]]\nname = {json.dumps(name)}\nprogram = {json.dumps(where + colon + cls)}\n"
    for asked in known:
        name, equals, python = asked.partition("=")
        place = os.path.abspath(python) if "/" in python else python  # links stay: an environment is known by them
        text += f"\n[[estimators]]\nname = {json.dumps(name)}\npeer = {json.dumps(name + equals + place)}\n"
    return text


def load_plan(
    path: Path,
    variables: Mapping[str, str] | None = None,
    programs: Iterable[str] = (),
    known: Iterable[str] = (),
) -> Plan:
    """Read a plan; sources and programs come back with variables and paths resolved.

    Args:
        path: TOML file, see docs/experiments.md.
        variables: values of $NAMES in sources; None: the environment.
        programs: more estimators, see `plan_text`.
        known: and more of them, which are peers.

    Raises:
        UsageError: naming the file, the field, what was asked and what is allowed.
    """
    try:
        data = parse_toml(plan_text(path, programs, known))
    except ValueError as error:
        raise UsageError(_unreadable(path, error)) from error
    return plan_from_data(data, str(path), path.resolve().parent, os.environ if variables is None else variables)


def plan_from_data(data: dict[str, Any], where: str, folder: Path, variables: Mapping[str, str]) -> Plan:
    """Build a plan from plain data; relative paths begin at `folder`. Raises UsageError with `where`."""
    _refuse_unknown(data, Plan, where)
    plan = validated(Plan, data, where)
    sequences = tuple(_resolved(sequence, where, folder, variables) for sequence in plan.sequences)
    estimators = tuple(_placed(estimator, where, folder, variables) for estimator in plan.estimators)
    estimators = tuple(_fitting(estimator, sequences, where) for estimator in estimators)
    plan = dataclasses.replace(plan, sequences=sequences, estimators=estimators)
    _check(plan, where)
    return plan


def _unreadable(path: Path, error: Exception) -> str:
    return f"plan {path} cannot be read: {error}; see docs/experiments.md for an example"


def _placed(estimator: Estimator, where: str, folder: Path, variables: Mapping[str, str]) -> Estimator:
    """Return an estimator whose program's file has an absolute path, and whose command its variables."""
    command = tuple(_replaced(word, where, variables) for word in estimator.command)
    if estimator.peer:
        if command or estimator.program:
            raise UsageError(f"{where}: estimator '{estimator.name}' is either a peer, a program or a command")
        name, equals, python = _replaced(estimator.peer, where, variables).partition("=")
        if "/" in python:
            python = str(folder / python)
        try:
            command = peers.command_of(f"{name}{equals}{python}", variables)
        except UsageError as error:
            raise UsageError(f"{where}: estimator '{estimator.name}': {error}") from error
    place, colon, name = estimator.program.partition(":")
    program = f"{folder / place}{colon}{name}" if place.endswith(".py") else estimator.program
    return dataclasses.replace(estimator, program=program, command=command)


def _fitting(estimator: Estimator, sequences: Iterable[Sequence], where: str) -> Estimator:
    """Return a peer with the sequences that it can read, unless the plan lists its own; another estimator as it is."""
    if not estimator.peer or estimator.sequences:
        return estimator
    modes = ("auto", *peers.PEERS[estimator.peer.partition("=")[0]].modes)
    fitting = tuple(
        s.name for s in sequences if is_on_disk(s.source) and s.config.get("frontend.mode", "auto") in modes
    )
    if not fitting:
        raise UsageError(
            f"{where}: estimator '{estimator.name}' can run on none of the sequences: it needs a recording on disk "
            f"or a rendered world, mode {', '.join(modes)}"
        )
    return dataclasses.replace(estimator, sequences=fitting)


def _replaced(text: str, where: str, variables: Mapping[str, str]) -> str:
    """Return text with its variables replaced."""

    def value(match: re.Match[str]) -> str:
        if match[1] not in variables:
            raise UsageError(f"{where}: {text} needs the environment variable {match[1]}; set it")
        return variables[match[1]]

    return _VARIABLE.sub(value, text)


def _resolved(sequence: Sequence, where: str, folder: Path, variables: Mapping[str, str]) -> Sequence:
    """Return a sequence with its variables replaced, its path absolute and a name."""
    source = _replaced(sequence.source, where, variables)
    config = {
        name: _replaced(value, where, variables) if isinstance(value, str) else value
        for name, value in sequence.config.items()
    }
    scheme, name, options = split_source(source)
    if not is_world(scheme, name):
        source = f"{scheme}{folder / name}{options}"
    return dataclasses.replace(sequence, source=source, config=config, name=sequence.name or Path(name).name)


def _check(plan: Plan, where: str) -> None:
    """Refuse what the types alone allow. Every combination of settings is tried, so that no job fails on a typo."""
    for what, names in (
        ("sequence", [s.name for s in plan.sequences]),
        ("estimator", [e.name for e in plan.estimators]),
        ("seed", [str(s) for s in plan.seeds]),
    ):
        if not names:
            raise UsageError(f"{where}: a plan needs at least one {what}")
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise UsageError(f"{where}: two of kind {what} are called '{twice[0]}'; give each its own name")
        if what != "seed":
            _check_names(names, what, where)
    if not _NAME.fullmatch(plan.name) or "/" in plan.name:
        raise UsageError(f"{where}: '{plan.name}' is no name of a plan: letters, digits, space and . , _ + - % [ ]")
    if plan.members < 1 or plan.timeout_s <= 0.0:
        raise UsageError(f"{where}: members must be at least 1 and timeout_s positive")
    settings = [plan.config, *(s.config for s in plan.sequences), *(e.config for e in plan.estimators)]
    if any("seed" in config for config in settings) or any(axis.setting == "seed" for axis in plan.axes):
        raise UsageError(
            f"{where}: seeds are a list of the plan itself, as seeds = [0, 1]; take 'seed' out of the settings"
        )
    _check_axes(plan, where)
    _check_estimators(plan, where)


def _check_names(names: Iterable[str], what: str, where: str) -> None:
    if odd := [name for name in names if not _NAME.fullmatch(name)]:
        raise UsageError(f"{where}: '{odd[0]}' is no name of a {what}: letters, digits, space and . , _ + - % [ ]")


def _check_axes(plan: Plan, where: str) -> None:
    known = [sequence.name for sequence in plan.sequences]
    _check_names(plan.axis_names, "axis", where)
    for axis in plan.axes:
        if unknown := sorted(set(axis.sequences) - set(known)):
            raise UsageError(f"{where}: axis '{axis.name}': no sequence '{unknown[0]}' in {', '.join(known)}")
        if bool(axis.setting) == bool(axis.option):
            raise UsageError(f"{where}: axis '{axis.name}' needs either a setting or an option to vary")
        if not axis.values or len(set(map(repr, axis.values))) != len(axis.values):
            raise UsageError(f"{where}: axis '{axis.name}' needs values, each one once")
    for sequence in known:
        names = [axis.name for axis in plan.axes_of(sequence)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise UsageError(f"{where}: two of kind axis are called '{twice[0]}'; give each its own name")


def _check_estimators(plan: Plan, where: str) -> None:
    known = [sequence.name for sequence in plan.sequences]
    for estimator in plan.estimators:
        if estimator.command:
            _check_command(plan, estimator, where)
        if not estimator.compared or len(set(estimator.compared)) != len(estimator.compared):
            raise UsageError(f"{where}: estimator '{estimator.name}' needs outputs, each one once")
        allowed = _possible(estimator)
        if wrong := [output for output in estimator.compared if output not in allowed]:
            raise UsageError(
                f"{where}: estimator '{estimator.name}' has no output '{wrong[0]}'; it has {', '.join(allowed)}"
            )
        if estimator.options and not estimator.program:
            raise UsageError(f"{where}: options of estimator '{estimator.name}' are for a program; use config")
        if unknown := sorted(set(estimator.sequences) - set(known)):
            raise UsageError(f"{where}: estimator '{estimator.name}': no sequence '{unknown[0]}' in {', '.join(known)}")


def _possible(estimator: Estimator) -> tuple[Output, ...]:
    """Return the trajectories that an estimator can give."""
    if estimator.command:
        return tuple(output for output in _OF_PROGRAM if output in commands.outputs_of(estimator.command))
    return _OF_PROGRAM if estimator.program else _OF_PIPELINE


def _check_command(plan: Plan, estimator: Estimator, where: str) -> None:
    try:
        commands.check(estimator.command)
    except UsageError as error:
        raise UsageError(f"{where}: estimator '{estimator.name}': {error}") from error
    if estimator.program:
        raise UsageError(f"{where}: estimator '{estimator.name}' is either a program or a command")
    made_up = [s.name for s in plan.sequences if not is_on_disk(s.source)]
    if unfit := [name for name in made_up if name in (estimator.sequences or made_up)]:
        raise UsageError(
            f"{where}: estimator '{estimator.name}' is a command, and '{unfit[0]}' is not on disk, where it could "
            "be read; name the others in its sequences"
        )


def nested(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return dotted settings as nested data; raises UsageError when one name is both a section and a setting."""
    data: dict[str, Any] = {}
    for dotted, value in settings.items():
        *sections, name = dotted.split(".")
        node = data
        for section in sections:
            node = node.setdefault(section, {})
            if not isinstance(node, dict):
                raise UsageError(f"{where}: '{section}' in '{dotted}' is a setting, not a section")
        if isinstance(node.get(name), dict):
            raise UsageError(f"{where}: '{dotted}' is both a section and a setting")
        node[name] = value
    return data


def _refuse_unknown(data: Mapping[str, Any], cls: type, where: str, prefix: str = "") -> None:
    known = get_type_hints(cls)
    for name, value in data.items():
        if name not in known:
            raise UsageError(f"{where}: no field '{prefix}{name}'; there are: {', '.join(known)}")
        inner = _item_type(known[name])
        if inner is None or not isinstance(value, list):
            continue
        for i, item in enumerate(value):
            if isinstance(item, dict):
                _refuse_unknown(item, inner, where, f"{prefix}{name}[{i}].")


def _item_type(hint: Any) -> type | None:
    """Return the dataclass inside of `tuple[dataclass, ...]`, or None."""
    if get_origin(hint) is not tuple:
        return None
    item = get_args(hint)[0]
    return item if dataclasses.is_dataclass(item) and isinstance(item, type) else None
