"""`python -m vislam.cli.precompile`, of which `./run setup` consists: compiles what verbs need by `verbs.ahead`.

Given a job's name, it is one of the processes that do so.
"""

import os
import sys
import tempfile

from vislam.cli import run_verb
from vislam.cli.verbs.ahead import JOBS, WITHIN, Job, compile_changed
from vislam.core.compiling import on_each_kernel


def main(arguments: list[str]) -> int:
    """Compile what is not compiled yet, with a bar; or, given a job's name, do that one. Return the exit code."""
    if arguments:
        return _do(JOBS[arguments[0]])
    compile_changed()
    return 0


def _do(job: Job) -> int:
    """Run the verbs of a job; a line on stdout for each kernel that is compiled, and nothing else."""
    os.environ[WITHIN] = "a job"
    out = os.fdopen(os.dup(1), "w", buffering=1)
    with tempfile.TemporaryDirectory(prefix="vislam-precompile-") as folder:
        os.chdir(folder)
        with open(os.devnull, "w", encoding="utf-8") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
        on_each_kernel(lambda name: print(name, file=out))
        return max(run_verb(list(verb)) for verb in job.verbs)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
