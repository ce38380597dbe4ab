"""What vislam advises can be typed: every option in its messages exists, and takes what is written after it."""

import ast
import re
from functools import cache
from pathlib import Path

from vislam.cli.verbs import VERBS
from vislam.cli.verbs.completion import known_options

PACKAGE = Path(__file__).resolve().parents[2] / "vislam"
TAKEN_BY_ALL = {"--help", "--help-all", "--version", "--log-level"}
BEGUN = {"--calibration"}  # the rest of its name is put in
OPTION = re.compile(r"(?<![\w-])(--[a-z][a-z0-9_-]*(?:\.[a-z0-9_-]+)*)(?:[ =]([A-Za-z0-9_.*-]+))?")


@cache
def advice() -> tuple[tuple[str, str, str], ...]:
    """Return file and line, option and the word after it, of every string in the package."""
    found = []
    # colours of a page, and options of another program
    others = {PACKAGE / "runs/report/style.py", PACKAGE / "runs/report/drawing.py", PACKAGE / "experiment/slurm.py"}
    for path in sorted({*PACKAGE.rglob("*.py")} - others):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in docstrings:
                where = f"{path.relative_to(PACKAGE)}:{node.lineno}"
                found += [(where, option.replace("_", "-"), word) for option, word in OPTION.findall(node.value)]
    return tuple(found)


def test_every_option_in_a_message_exists() -> None:
    known = {*(option for verb in VERBS for option in known_options(verb)[0]), *TAKEN_BY_ALL, *BEGUN}
    assert [(where, option) for where, option, _ in advice() if option not in known] == []


def test_no_message_answers_an_option_of_yes_and_no_with_a_word() -> None:
    assert [(where, option) for where, option, word in advice() if word in ("True", "False")] == []


def test_there_is_advice_to_test() -> None:
    assert len({option for _, option, _ in advice() if "." in option}) > 10
