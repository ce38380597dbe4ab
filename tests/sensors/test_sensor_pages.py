"""What the pages about sensors show works, and no kind, column or setting is missing there."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from vislam.sensors.gnss import GnssSettings
from vislam.sensors.registry import _BUILT_IN, kind_class
from vislam.sensors.ticks import TicksSettings
from vislam.sensors.toml import sensor_setup

DOCS = Path(__file__).resolve().parent.parent.parent / "docs"
PAGE = (DOCS / "more-sensors.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def test_the_files_of_sensors_on_the_page_are_such() -> None:
    texts = [block for language, block in BLOCK.findall(PAGE) if language == "toml"]
    suites = [sensor_setup(tomllib.loads(text), "page", DOCS).suite.names for text in texts]
    assert suites[0] == ("gnss", "uwb", "wheels", "baro")
    assert len(suites) > 1


@pytest.mark.parametrize("page", ["more-sensors.md", "your-sensor.md"])
def test_the_code_on_a_page_runs(page: str) -> None:
    blocks = [block for language, block in BLOCK.findall((DOCS / page).read_text("utf-8")) if language == "python"]
    assert blocks
    for block in blocks:
        exec(compile(block, page, "exec"), {})


@pytest.mark.parametrize("kind", sorted(_BUILT_IN))
def test_a_kind_is_on_the_page_with_its_columns_and_settings(kind: str) -> None:
    rows: dict[str, str] = {}
    for line in PAGE.splitlines():
        if line.startswith("| `"):
            rows.setdefault(line.split("|")[1].strip(" `"), line)  # the table of kinds is the first one
    row = rows[kind]
    for other in re.findall(r"as `(\w+)`", row):
        row += rows[other]
    cls = kind_class(kind)
    names = [*cls.columns, *(field.name for field in dataclasses.fields(cls.Settings))]
    assert [name for name in names if f"`{name}`" not in row] == []


def test_settings_of_receivers_and_counters_are_on_the_page() -> None:
    names = [field.name for cls in (GnssSettings, TicksSettings) for field in dataclasses.fields(cls)]
    assert [name for name in names if f"`{name}" not in PAGE] == ["radius_m", "right_sign"], "which the TOML shows"
