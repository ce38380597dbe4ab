"""Sensors described by a TOML file, and kinds that somebody else brings."""

import contextlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.config.ranges import Positive
from vislam.core.errors import UsageError, VislamError
from vislam.core.messages import Array
from vislam.sensors import BodyState, Configured, kind_class, load_sensor_setup, register
from vislam.sensors.kinds import _BUILT_IN, KINDS, AnchorRange, Wheels
from vislam.sensors.toml import sensor_setup

GOOD = """
[sensors.gnss]
kind = "position"
file = "gnss.nmea"
offset_s = -0.05
lever_m = [0.1, 0.0, 0.5]
gnss = {least_fix = "float", datum = [48.1, 11.6, 520.0]}

[sensors.uwb]
kind = "range"
file = "uwb.csv"
sigma_m = 0.12
gate_probability = 0.99
anchors = {1 = [0.0, 0.0, 2.0], 0x2A = [5, 0, 2]}

[sensors.wheels]
kind = "wheels"
file = "encoders.csv"
track_width_m = 0.4
ticks = {ticks_per_turn = 1024, radius_m = 0.08, bits = 16}

[sensors.baro]
kind = "height"
"""


def load(tmp_path: Path, text: str):
    path = tmp_path / "sensors.toml"
    path.write_text(text, encoding="utf-8")
    return load_sensor_setup(path)


@pytest.fixture
def kinds():
    """What a test registers is forgotten again."""
    yield
    for name in set(KINDS) - set(_BUILT_IN):
        KINDS.forget(name)


def test_a_file_makes_a_suite(tmp_path: Path) -> None:
    setup = load(tmp_path, GOOD)
    assert setup.suite.names == ("gnss", "uwb", "wheels", "baro")
    assert isinstance(setup.suite["uwb"], AnchorRange)
    assert setup.suite["uwb"].gate_probability == 0.99 and setup.suite["gnss"].gate_probability == 0.999
    assert isinstance(setup.sensors["wheels"], Wheels) and setup.sensors["wheels"].settings.track_width_m == 0.4
    assert set(setup.files) == {"gnss", "uwb", "wheels"}
    gnss = setup.files["gnss"]
    assert (gnss.path, gnss.format, gnss.offset_s) == (tmp_path / "gnss.nmea", "nmea", -0.05)
    assert gnss.gnss.least_fix == "float" and gnss.gnss.datum == (48.1, 11.6, 520.0)
    assert setup.files["wheels"].ticks is not None and setup.files["wheels"].ticks.bits == 16


WRONG = {
    "": "1 to 64 tables",
    "[sensor.a]\nkind='height'": "no table [sensor]",
    "sensors = 3": "1 to 64 tables",
    "[sensors]\na = 3": "[sensors.a]: a table is asked",
    "[sensors.a]\nfile='x.csv'": 'option kind: a name is asked, as kind = "position", got None',
    "[sensors.a]\nkind='hight'": "option kind: no kind of sensor is called 'hight'; there are: ackermann,",
    "[sensors.'a b']\nkind='height'": "[sensors.a b]: a name of letters",
    "[sensors.a]\nkind='height'\nsigma=1.0": "[sensors.a]: no option 'sigma'; there are: baud, correlated_sigma,",
    "[sensors.a]\nkind='height'\nsigma_m='x'": "[sensors.a]: option sigma_m: Input should be a valid number",
    "[sensors.a]\nkind='height'\nsigma_m=0.0": "[sensors.a]: sigma_m is 0; allowed is 1e-09 or more and 100000 at most",
    "[sensors.a]\nkind='height'\nsigma_m=nan": "[sensors.a]: sigma_m is nan",
    "[sensors.a]\nkind='height'\nlever_m=[1.0,2.0]": "[sensors.a]: option lever_m",
    "[sensors.a]\nkind='height'\noffset_s='now'": "[sensors.a]: option offset_s",
    "[sensors.a]\nkind='height'\ngate_probability=1.0": "gate_probability is 1",
    "[sensors.a]\nkind='height'\nfile='x.nmea'": "option format: nmea holds fixes",
    "[sensors.a]\nkind='height'\nfile='x'\nformat='xml'": (
        "option format: Input should be 'csv', 'nmea', 'ubx', 'bag' or 'gpmf'"
    ),
    "[sensors.a]\nkind='twist'\nfile='x'\nticks={ticks_per_turn=1,radius_m=1}": "option ticks: counts are those of",
    "[sensors.a]\nkind='wheels'\nfile='x'\nticks={radius_m=1}": "option ticks.ticks_per_turn: Field required",
    "[sensors.a]\nkind='wheels'\nfile='x'\nticks={ticks_per_turn=1,radius_m=1,bits=12}": "option ticks.bits",
    "[sensors.a]\nkind='position'\nfile='x'\ngnss={datum=[95.0,0,0]}": "option gnss.datum: latitude 95 deg",
    "[sensors.a]\nkind='position'\nfile='x'\ngnss={least_fix='good'}": "option gnss.least_fix",
    "[sensors.a]\nkind='range'": "0 anchors",
    "[sensors.a]\nkind='range'\nanchors={x=[0,0,0]}": "anchor 'x' has to be a number",
    "[sensors.a]\nkind='range'\nanchors={1=[0,0]}": "option anchors.1",
    "[sensors.a]\nkind='range'\nanchors={1=[0,0,inf]}": "anchor '1' is at [0.0, 0.0, inf]",
    "[sensors.a]\nkind='range'\nanchors={1=[0,0,0],0x1=[0,0,1]}": "anchor '0x1' is given twice",
    "[sensors.a]\nkind='pose'\ntarget_quaternion_xyzw=[0,0,0,0]": "target_quaternion_xyzw: a quaternion of norm 0",
    "[sensors.a": "cannot be read",
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(UsageError) as caught:
        load(tmp_path, text)
    assert WRONG[text] in str(caught.value)
    assert str(tmp_path / "sensors.toml") in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_that_is_not_there_or_too_large_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        load_sensor_setup(tmp_path / "none.toml")
    with pytest.raises(UsageError, match="larger than the 0"):
        load(tmp_path, "#" * (2**20 + 1))


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)
KEYS = st.sampled_from(
    ["kind", "file", "format", "offset_s", "ticks", "gnss", "anchors", "sigma_m", "lever_m", "frame"]
)


@given(st.sampled_from(sorted(_BUILT_IN)), st.dictionaries(KEYS, PLAIN, max_size=5))
def test_no_table_raises_anything_but_an_expected_error(kind: str, table: dict) -> None:
    with contextlib.suppress(VislamError):
        sensor_setup({"sensors": {"it": {"kind": kind, **table}}}, "it.toml", Path("."))


@dataclass(frozen=True, slots=True)
class TiltSettings:
    sigma_rad: Positive = 0.1


class Tilt(Configured):
    """Somebody's own."""

    Settings = TiltSettings
    columns = ("tilt_rad",)

    def __init__(self, settings: TiltSettings | None = None) -> None:
        self.settings = settings or TiltSettings()

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        return values - body.R_world_body[2, :1]

    def noise(self, values: Array) -> Array:
        return np.array([[self.settings.sigma_rad**2]])


@pytest.mark.usefixtures("kinds")
def test_a_kind_that_a_program_registers_is_known_to_files(tmp_path: Path) -> None:
    register("tilt", Tilt)
    setup = load(tmp_path, "[sensors.it]\nkind = 'tilt'\nsigma_rad = 0.2")
    assert setup.suite["it"].noise(np.zeros(1))[0, 0] == pytest.approx(0.04)
    with pytest.raises(UsageError, match="cannot draw"):
        setup.sensors["it"].draw(BodyState(0, np.eye(3), *[np.zeros(3)] * 5), np.zeros(0), np.random.default_rng(1))


@pytest.mark.parametrize(
    ("kind", "cls", "message"),
    [("height", Tilt, "built in"), ("My Kind", Tilt, "small letters"), ("other", dict, "no subclass")],
)
def test_what_cannot_be_a_kind_is_refused(kind: str, cls: type, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        register(kind, cls)


def installed(monkeypatch: pytest.MonkeyPatch, folder: Path, *values: str) -> None:
    """Install packages, one for each value, that bring a kind `tilt`."""
    for n, value in enumerate(values):
        package = folder / f"sensors_{n}-1.0.dist-info"
        package.mkdir()
        (package / "METADATA").write_text(f"Metadata-Version: 2.1\nName: sensors-{n}\nVersion: 1.0\n")
        (package / "entry_points.txt").write_text(f"[vislam.sensors]\ntilt = {value}\n")
    monkeypatch.syspath_prepend(str(folder))


@pytest.mark.usefixtures("kinds")
def test_an_installed_package_brings_a_kind(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    installed(monkeypatch, tmp_path, f"{__name__}:Tilt")
    assert kind_class("tilt").__name__ == "Tilt"


@pytest.mark.usefixtures("kinds")
@pytest.mark.parametrize(
    ("values", "message"),
    [
        (["no_such_module:Tilt"], "package sensors-0 cannot be loaded from 'no_such_module:Tilt'"),
        ([f"{__name__}:GOOD"], "of package sensors-0: .* is no subclass"),
        (["a:b", "c:d"], "several packages: sensors-., sensors-"),
    ],
)
def test_a_broken_package_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, values: list[str], message: str
) -> None:
    installed(monkeypatch, tmp_path, *values)
    with pytest.raises(UsageError, match=message):
        kind_class("tilt")
