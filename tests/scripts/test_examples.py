"""Every example runs as a reader would run it, prints something, and its own assertions hold."""

import importlib.util
import json
import os
import runpy
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import pytest

from experiment.tiny import jobs_here
from vislam.sensors import kinds
from vislam.sensors.toml import sensor_setup

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(script, tmp_path, monkeypatch, capsys):
    """In this process, where what they share is imported once; the first is started as its reader does."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script)])
    if script is EXAMPLES[0]:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        environment.pop("OPENBLAS_NUM_THREADS")  # which the tests set, and a reader does not
        answer = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=False)
        assert answer.returncode == 0 and answer.stdout.strip(), answer.stderr
    else:
        with jobs_here():
            runpy.run_path(str(script), run_name="__main__")
        assert capsys.readouterr().out.strip()
    assert not list(tmp_path.iterdir()), "an example leaves nothing behind"


def test_every_example_is_in_the_readme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(EXAMPLES) == 15
    assert [path.name for path in EXAMPLES if f"](examples/{path.name})" not in readme] == []


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_stays_a_page(script):
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 80


def test_every_kind_of_sensor_has_its_example_and_its_page_names_it():
    spec = importlib.util.spec_from_file_location("further_sensors", ROOT / "examples" / "11_further_sensors.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    assert set(example.KINDS) == set(kinds._BUILT_IN)
    for kind, (lines, rate_hz) in example.KINDS.items():
        table = tomllib.loads(f'[sensors.it]\nkind = "{kind}"\nsimulated_hz = {rate_hz}\n{lines}\n')
        assert sensor_setup(table, kind, ROOT).simulated_hz == {"it": rate_hz}
        page = (ROOT / "docs" / "sensors" / f"{kind}.md").read_text(encoding="utf-8")
        assert f"examples/11_further_sensors.py {kind}`" in page


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom_and_keeps_no_outputs(tmp_path, monkeypatch):
    cells = json.loads((ROOT / "examples" / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    names: dict = {}
    for cell in code:  # as a notebook does: one namespace, in order
        exec(compile("".join(cell["source"]), "notebook.ipynb", "exec"), names)
    assert "<img" in names["run"]._repr_html_()
