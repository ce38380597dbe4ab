"""What is heavy is not imported before it is needed."""

import subprocess
import sys
from functools import cache

from vislam.cli.verbs import VERBS

HEAVY = {"numpy", "scipy", "numba", "cv2", "gtsam", "matplotlib", "open3d", "rerun"}


@cache
def modules_after(script: str) -> set[str]:
    """Return the modules that a fresh interpreter has loaded when the script has run."""
    tail = "import sys; print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", f"{script}\n{tail}"], capture_output=True, text=True, check=True)
    return set(done.stderr.splitlines()[-1].split())


def test_the_pipeline_loads_no_statistics_pictures_or_viewers() -> None:
    loaded = modules_after("import vislam.slam")
    assert "gtsam" in loaded
    strangers = {"scipy.stats", "scipy.interpolate", "matplotlib", "rerun", "open3d", "pydantic", "tyro", "rich"}
    assert not strangers & loaded


def test_the_package_itself_loads_nothing_heavy() -> None:
    assert not HEAVY & modules_after("import vislam")


def test_no_kernel_is_compiled_or_read_from_its_cache_by_an_import() -> None:
    """A signature on a decorator does that, and brings the whole of numba's registry along: half a second."""
    assert "numba.typed.typeddict" not in modules_after("import vislam.slam")


def test_verbs_answer_for_help_before_they_load_anything_heavy() -> None:
    """One process asks all of them, and writes down the first that loads what."""
    script = f"""
import sys
from contextlib import redirect_stdout, suppress
from io import StringIO
from vislam.cli import run_verb
for verb in {list(VERBS)}:
    with redirect_stdout(StringIO()), suppress(SystemExit):
        run_verb([verb, "--help"])
    if heavy := {HEAVY} & set(sys.modules):
        print(verb, heavy)
        break
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == ""


def test_a_pose_graph_file_loads_neither_the_pipeline_nor_what_draws() -> None:
    loaded = modules_after("import vislam.runs.offline.optimize_graph, vislam.runs.report.graph_page")
    assert not (HEAVY - {"numpy", "scipy", "numba"}) & loaded
    assert "vislam.slam" not in loaded
