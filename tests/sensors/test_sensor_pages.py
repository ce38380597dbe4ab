"""What the pages about sensors show works, and no kind, column or setting is missing there."""

import dataclasses
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from vislam.sensors import BodyState, linearised
from vislam.sensors.gnss import GnssSettings
from vislam.sensors.kinds import _BUILT_IN, kind_class
from vislam.sensors.simulated import drawn_readings
from vislam.sensors.ticks import TicksSettings
from vislam.sensors.toml import sensor_setup

DOCS = Path(__file__).resolve().parent.parent.parent / "docs"
PAGE = (DOCS / "more-sensors.md").read_text(encoding="utf-8")
OF_KINDS = {path.stem: path.read_text(encoding="utf-8") for path in sorted((DOCS / "sensors").glob("*.md"))}
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def test_the_files_of_sensors_on_the_page_are_such() -> None:
    texts = [block for language, block in BLOCK.findall(PAGE) if language == "toml"]
    suites = [sensor_setup(tomllib.loads(text), "page", DOCS).suite.names for text in texts]
    assert suites[0] == ("gnss", "uwb", "wheels", "baro")


@pytest.mark.parametrize("page", ["more-sensors.md", "extend.md"])
def test_the_code_on_a_page_runs(page: str) -> None:
    blocks = [block for language, block in BLOCK.findall((DOCS / page).read_text("utf-8")) if language == "python"]
    assert blocks
    for block in blocks:
        exec(compile(block, page, "exec"), {})


@pytest.mark.parametrize("page", OF_KINDS)
def test_the_files_of_sensors_on_the_page_of_a_kind_are_such(page: str) -> None:
    """And each shows the kind that it is about."""
    texts = [tomllib.loads(block) for language, block in BLOCK.findall(OF_KINDS[page]) if language == "toml"]
    setups = [sensor_setup(text, page, DOCS) for text in texts]
    shown = {table["kind"] for text in texts for table in text["sensors"].values()}
    assert setups
    assert shown == {"position" if page == "gnss" else page}


def test_every_kind_has_a_page() -> None:
    assert set(OF_KINDS) == {*_BUILT_IN, "gnss"}
    assert [name for name in OF_KINDS if f"(sensors/{name}.md)" not in PAGE] == []


@pytest.mark.parametrize("kind", sorted(_BUILT_IN))
def test_a_kind_is_on_its_page_with_columns_variables_and_settings(kind: str) -> None:
    """Or on a page whose equation it shares, to which its own leads."""
    page = OF_KINDS[kind] + "".join(text for other, text in OF_KINDS.items() if f"({other}.md)" in OF_KINDS[kind])
    cls = kind_class(kind)
    settings = {"anchors": {"1": (0.0, 0.0, 0.0)}} if kind == "range" else {}
    variables = [variable.name for variable in cls(cls.Settings(**settings)).variables]
    names = [*cls.columns, *cls.sigma_columns, *variables, *(field.name for field in dataclasses.fields(cls.Settings))]
    words = set(re.findall(r"\w+", page))
    assert [name for name in names if name not in words] == []


@pytest.mark.parametrize("kind", sorted(_BUILT_IN))
def test_a_kind_can_be_simulated_as_its_page_says(kind: str) -> None:
    """The first table of the page, with `simulated_hz` instead of its file, draws readings that it takes itself."""
    text = next(block for language, block in BLOCK.findall(OF_KINDS[kind]) if language == "toml")
    setup = sensor_setup(tomllib.loads(text), kind, DOCS)
    [(name, sensor)] = setup.sensors.items()
    own = np.array([variable.start for variable in sensor.variables])
    body = BodyState(0, np.eye(3), np.array([1.0, 2.0, 0.3]), np.array([1.0, 0.0, 0.0]), *[np.zeros(3)] * 3)
    [reading] = drawn_readings(name, sensor, [body], own, seed=1)
    assert setup.suite.why_unusable(reading) == ""
    linear = linearised(sensor, reading, body, own)
    assert linear.residual @ np.linalg.solve(linear.noise, linear.residual) < 30.0


def test_settings_of_receivers_and_counters_are_on_their_pages() -> None:
    for cls, page, shown in ((GnssSettings, "gnss", []), (TicksSettings, "wheels", ["radius_m", "right_sign"])):
        names = [field.name for field in dataclasses.fields(cls)]
        assert [name for name in names if f"`{name}" not in OF_KINDS[page]] == shown, "the TOML shows the last ones"
