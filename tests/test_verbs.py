"""Every verb of the command line is there, explains itself, and is not imported before it is asked for."""

import subprocess
import sys

import pytest

from vislam.cli import run_verb
from vislam.verbs import VERBS


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = run_verb([verb, "--help"])
    except SystemExit as end:
        code = end.code
    assert code == 0
    assert f"vislam {verb}" in capsys.readouterr().out


def test_help_lists_every_verb_and_imports_nothing_heavy() -> None:
    script = "import sys; from vislam.cli import run_verb; run_verb(['--help']); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert all(f"  {name} " in done.stdout for name in VERBS)
    assert not {"numpy", "tyro", "rich", "cv2", "numba", "gtsam", "vislam.config"} & set(done.stderr.split())


def test_an_unknown_verb_is_a_wrong_usage_that_names_the_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(["fly"]) == 2
    assert "no verb 'fly'; there are: demo, run" in capsys.readouterr().err
