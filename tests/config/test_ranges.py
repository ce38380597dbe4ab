"""Numbers among the settings have ranges: defaults lie inside, what lies outside is refused in one line."""

import math
from dataclasses import replace
from importlib import import_module
from typing import Any

import pytest

from vislam.cli import run_verb
from vislam.cli.verbs import VERBS
from vislam.config import (
    BatchConfig,
    Config,
    GraphWorldConfig,
    LoopTruthConfig,
    PoseGraphConfig,
    RecordConfig,
    SensorsConfig,
    from_data,
)
from vislam.config.ranges import Range, Setting, check_ranges, settings_of
from vislam.core.errors import UsageError

TREES = (Config, SensorsConfig, RecordConfig, PoseGraphConfig, GraphWorldConfig, LoopTruthConfig, BatchConfig)
NUMBERS = [(tree, setting) for tree in TREES for setting in settings_of(tree) if setting.range is not None]


def outside(allowed: Range) -> list[float]:
    """Return numbers just below and above an interval, and those that are none."""
    ends = ((allowed.low, allowed.without_low, -math.inf), (allowed.high, allowed.without_high, math.inf))
    return [math.nan, -math.inf, math.inf] + [
        end if without else math.nextafter(end, far) for end, without, far in ends if math.isfinite(end)
    ]


def changed(tree: Any, path: tuple[str, ...], value: Any) -> Any:
    """Return a tree of settings with one of them changed."""
    name, *rest = path
    return replace(tree, **{name: changed(getattr(tree, name), tuple(rest), value) if rest else value})


def wrong(setting: Setting, number: float) -> Any:
    """Return the number as the setting takes it: alone, or first in its tuples."""
    value = setting.value
    if not isinstance(value, tuple):
        return number
    return ((number, *value[0][1:]), *value[1:]) if isinstance(value[0], tuple) else (number, *value[1:])


def is_numeric(hint: Any) -> bool:
    return hint in (int, float) or any(is_numeric(part) for part in getattr(hint, "__args__", ()))


def endless(tree: type) -> list[str]:
    """Return the options of a tree whose numbers have no range, or one that does not end to both sides."""
    numbers = [s for s in settings_of(tree) if is_numeric(s.type)]
    return [s.option for s in numbers if s.range is None or not math.isfinite(s.range.high - s.range.low)]


@pytest.mark.parametrize("tree", TREES)
def test_every_number_has_a_range_with_two_ends_and_its_default_lies_inside(tree: type) -> None:
    assert endless(tree) == []
    check_ranges(tree())


def test_below_and_above_its_range_every_setting_is_refused_by_name() -> None:
    for tree, setting in NUMBERS:
        assert setting.range is not None
        for number in outside(setting.range):
            with pytest.raises(UsageError) as refused:
                check_ranges(changed(tree(), setting.path, wrong(setting, number)))
            assert str(refused.value) == f"{setting.option} is {number:g}; allowed is {setting.range}"


@pytest.mark.parametrize("verb", VERBS)
def test_every_number_among_the_options_of_a_verb_has_a_range(verb: str) -> None:
    options = import_module(f"vislam.cli.verbs.{verb}").OPTIONS
    assert [option for cls in options for option in endless(cls)] == []


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("run tum:X --out OUT --frontend.max-tracks -5", "--frontend.max-tracks is -5; allowed is 1 or more"),
        ("posegraph X.g2o --iterations -1", "--iterations is -1; allowed is 1 or more"),
        ("optimize X.g2o --iterations -1", "--iterations is -1; allowed is 1 or more"),
        ("optimize X --rounds -1", "--rounds is -1; allowed is 1 or more"),
        ("run tum:X --out OUT --ekf.gate-probability 2", "is 2; allowed is more than 0 and less than 1"),
        (
            "run tum:X --out OUT --machine.gravity-m-s2 nan",
            "is nan; allowed is 0.1 or more and 100 at most",
        ),
        ("live --out OUT --sensors.webcam.width-px 0", "--sensors.webcam.width-px is 0; allowed is 1 or more"),
        ("calibrate camera X --rows -2", "--rows is -2; allowed is 1 or more"),
        (
            "run tum:X --out OUT --window.keyframes 1000000000",
            "is 1e+09; allowed is 1 or more and 100 at most",
        ),
        ("run tum:X --out OUT --map.drive.slope-window-m 99", "is 99; allowed is 0 or more and 10 at most"),
        ("simulate loop --out OUT --image-width-px 20000", "is 20000; allowed is 1 or more and 16384 at most"),
        ("map X --query nan 0 0", "--query is nan; allowed is -1e+09 or more and 1e+09 at most"),
    ],
)
def test_a_number_out_of_range_is_a_wrong_usage_of_one_line(
    command: str, complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_verb(command.split()) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1


def test_a_number_out_of_range_in_a_file_is_refused_with_the_file() -> None:
    with pytest.raises(UsageError, match=r"cart\.toml: window\.keyframes is 0; allowed is 1 or more"):
        from_data({"window": {"keyframes": 0}}, "cart.toml")
