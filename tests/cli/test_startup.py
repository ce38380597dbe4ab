"""What is heavy is not imported before it is needed."""

import subprocess
import sys

import pytest

from vislam.cli.verbs import VERBS

HEAVY = {"numpy", "scipy", "numba", "cv2", "gtsam", "matplotlib", "open3d", "rerun"}
KERNELS = {"numpy", "scipy", "numba"}


def modules_after(script: str) -> set[str]:
    """Return the modules that a fresh interpreter has loaded when the script has run."""
    tail = "import sys; print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", f"{script}\n{tail}"], capture_output=True, text=True, check=True)
    return set(done.stderr.splitlines()[-1].split())


LOADED = {  # by script: what it uses of HEAVY, and what else it must not load
    "import vislam": (set(), set()),
    # typeddict: a signature on a decorator compiles, and brings the whole of numba's registry: half a second
    "import vislam.slam": (KERNELS | {"cv2", "gtsam"}, {"scipy.stats", "scipy.interpolate", "pydantic",
                           "tyro", "rich", "numba.typed.typeddict"}),
    "import vislam.runs.offline.optimize_graph, vislam.runs.report.graph_page": (KERNELS, {"vislam.slam"}),
    "import vislam.datasets.rgbd": (KERNELS | {"cv2"}, {"scipy.optimize"}),
    "import vislam.runs.folder": (KERNELS | {"cv2"}, {"vislam.mapping.products", "vislam.frontend", "vislam.datasets"}),
}  # fmt: skip


@pytest.mark.parametrize("script", LOADED)
def test_what_is_heavy_and_not_used_is_not_loaded(script: str) -> None:
    loaded, (used, strangers) = modules_after(script), LOADED[script]
    assert (loaded & HEAVY, loaded & strangers) == (used, set())


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
