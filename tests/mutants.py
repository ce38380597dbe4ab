"""Seeded mutants: does the suite notice a wrong sign, gate, unit or index, or a term that is dropped?

`python tests/mutants.py` applies each change to a copy of `vislam/`, runs the tests that must fail, and reports whether
one does; `--only TEXT ...` takes those whose file or tests hold a text. The exit code is 1 where a mutant survives.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
DATA = REPOSITORY.parent / "shared" / "data"  # as conftest has it, whose folder is linked
HUNG_S = 1800.0  # tests that never end have noticed


@dataclass(frozen=True)
class Mutant:
    """One change, a line of `mutants.tsv`: `old`, which stands once in `vislam/` + `file`, becomes `new`."""

    file: str
    old: str
    new: str
    tests: str  # that must fail: paths below `tests/`, and what `-k` chooses of them

    @property
    def name(self) -> str:
        return f"{self.file}: {self.old}  ->  {self.new}"


def table() -> list[Mutant]:
    """Return the mutants of `mutants.tsv`."""
    lines = (REPOSITORY / "tests" / "mutants.tsv").read_text(encoding="utf-8").splitlines()[1:]
    return [Mutant(*line.split("\t")) for line in lines]


def linked(source: str, target: str) -> None:
    """Link a file, or copy it where that cannot be: what a mutant changes is written anew and touches no original."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def caught_by(mutant: Mutant, folder: Path) -> str:
    """Apply a mutant to a copy of the package in an empty folder; return the test that fails, or an empty string."""
    shutil.copytree(REPOSITORY / "vislam", folder / "vislam", copy_function=linked)
    for beside in ("tests", "benchmarks", "experiments", "examples", "docs", "pyproject.toml"):
        (folder / beside).symlink_to(REPOSITORY / beside)
    path = folder / "vislam" / mutant.file
    text = path.read_text(encoding="utf-8")
    path.unlink()
    path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
    paths, _, chosen = mutant.tests.partition(" -k ")
    arguments = [*(f"tests/{path}" for path in paths.split()), *(["-k", chosen] if chosen else [])]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n0", *arguments]
    environment = os.environ | {"PYTHONPATH": str(folder), "VISLAM_DATA": os.environ.get("VISLAM_DATA", str(DATA))}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=HUNG_S, check=False)
    except subprocess.TimeoutExpired:
        return "a test that never ends"
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{mutant.name}: pytest ended with {done.returncode}\n{done.stdout.decode()[-2000:]}")
    failed = [line for line in done.stdout.decode().splitlines() if line.startswith(("FAILED", "ERROR"))]
    return " ".join(failed[0].split()[:2]) if done.returncode else ""


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="mutants whose file or tests hold it")
    only = parser.parse_args(arguments).only
    asked = [mutant for mutant in table() if any(text in f"{mutant.file} {mutant.tests}" for text in only)]
    survivors = []
    for mutant in asked:
        with tempfile.TemporaryDirectory(prefix="vislam-mutant-") as folder:
            test = caught_by(mutant, Path(folder))
        print(f"{mutant.name}\n    {test or 'SURVIVES ' + mutant.tests}", flush=True)
        survivors += [] if test else [mutant]
    print(f"{len(asked) - len(survivors)} of {len(asked)} are caught")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
