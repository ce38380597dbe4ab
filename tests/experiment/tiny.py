"""A plan whose jobs take a second of CPU each, simulated vision on a simulated motion, and jobs without a process."""

import shutil
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from vislam.experiment import compare
from vislam.experiment.worker import run_job

PLAN = """
name = "tiny"
seeds = [0, 1]
members = 1
timeout_s = 1800.0
config = {"loop.enabled" = false}

[[sequences]]
name = "laps"
source = "points:laps"
options = {duration_s = 5.0, tracks = 40, camera_hz = 10.0, descriptors = false}

[[estimators]]
name = "loose"
outputs = ["ekf", "graph"]

[[estimators]]
name = "slow vision"
outputs = ["ekf", "graph"]
config = {"ekf.vision_delay_s" = 0.2}
"""


def write_plan(folder, text=PLAN):
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


@contextmanager
def jobs_here():
    """Run local jobs in this process, one at a time: a process for each takes four times as long and shows no more."""
    one = threading.Lock()

    def run_here(spec, cache, keep=None, stop=None):
        with one, tempfile.TemporaryDirectory() as folder:
            result = run_job(spec, Path(folder), Path(cache))
            if keep is not None:
                shutil.copytree(Path(folder) / "run", Path(keep) / spec["key"][:24])
            return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "run_isolated", run_here)
        yield
