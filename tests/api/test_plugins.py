"""Packages that bring kinds: the template is installed and used; a broken package is named and left out."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vislam.core.errors import UsageError
from vislam.core.kinds import Kinds, lacking

TEMPLATE = Path(__file__).resolve().parents[2] / "examples" / "plugin_template"
USE = """
import numpy as np, tempfile, pathlib
from types import SimpleNamespace
import vislam
from vislam.config import load
from vislam.loop.candidates import proposer
from vislam.mapping.products import PRODUCTS
from vislam.sensors import kind_class
assert kind_class("sonar").columns == ("height_m",)
assert proposer("first")(None, None)(None, {7: 0, 3: 0}) == [3]
tree = vislam.Octree(0.1)
tree.insert(np.array([[1.0, 0, 0]]), np.zeros(3))
file = pathlib.Path(tempfile.mkdtemp()) / PRODUCTS["volume"].FILE
assert PRODUCTS["volume"].write(file, SimpleNamespace(occupancy=tree)) is None
assert float(file.read_text()) == 0.001
assert load(None, {"map.products": ["cloud", "volume"]}).map.products == ("cloud", "volume")
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a program for which the template is installed."""
    target = tmp_path_factory.mktemp("packages")
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--target", str(target), str(TEMPLATE)], check=True)
    return {**os.environ, "PYTHONPATH": str(target)}


def test_the_template_is_found_by_each_of_its_groups(installed):
    subprocess.run([sys.executable, "-c", USE], check=True, env=installed)


def test_a_verb_of_a_package_is_run_and_shown(installed):
    run = [sys.executable, "-c", "from vislam.cli import main; main()"]
    done = subprocess.run([*run, "hello"], check=True, env=installed, capture_output=True, text=True)
    assert done.stdout == "hello from a package\n"
    shown = subprocess.run([*run, "--help"], check=True, env=installed, capture_output=True, text=True).stdout
    assert "  hello       say what a run left" in shown


def test_the_template_is_short():
    lines = (line.strip() for line in (TEMPLATE / "plugin_template.py").read_text().splitlines())
    assert sum(not line.startswith('"""') for line in lines if line) <= 40


def package(folder: Path, name: str, value: str) -> None:
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[vislam.things]\n{name} = {value}\n")


def test_a_broken_package_is_named_in_one_line_and_left_out(tmp_path, monkeypatch, caplog):
    (tmp_path / "bad_module.py").write_text("raise RuntimeError('two\\nlines')\n")
    package(tmp_path, "broken", "bad_module:Thing")
    package(tmp_path, "wrong", "pathlib:Path")
    package(tmp_path, "good", "pathlib:PurePath")
    monkeypatch.syspath_prepend(str(tmp_path))
    kinds = Kinds("vislam.things", {"own": Path("own")}, lacking("parts"))
    assert "broken" in kinds and "nothing" not in kinds
    assert sorted(kinds) == ["good", "own", "wrong"]
    assert [record.getMessage() for record in caplog.records] == [
        "left out: vislam.things 'broken' of package broken cannot be loaded from 'bad_module:Thing': RuntimeError: "
        "two lines; repair or uninstall it"
    ]
    assert len(kinds) == 3 and len(caplog.records) == 1
    with pytest.raises(UsageError, match="of package broken cannot be loaded"):
        _ = kinds["broken"]
    with pytest.raises(KeyError):
        _ = kinds["nothing"]
    with pytest.raises(UsageError, match="has no parts"):
        kinds.add("dictionary", {})
