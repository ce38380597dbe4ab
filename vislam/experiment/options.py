"""The options of `vislam compare`; their comments are its --help."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from vislam.config.ranges import Few, Whole


@dataclass(frozen=True)
class CompareOptions:
    """Options of `vislam compare`."""

    plan: Positional[Path]
    """TOML file of what to compare on what; docs/experiments.md"""
    estimator: tuple[str, ...] = ()
    """More estimators for the plan: FILE.py, FILE.py:CLASS or MODULE:CLASS; docs/experiments.md, examples/09"""
    peer: tuple[str, ...] = ()
    """More estimators that are programs of their own: orbslam3 (GPL-3.0) or basalt (BSD-3), or NAME=PYTHON with the
    interpreter that has pyorbslam3 or depthai; vislam installs neither; docs/experiments.md"""
    out: Path | None = None
    """Folder for report, tables and manifest; None: results/NAME of the plan"""
    workers: Few = 2
    """Jobs at the same time on this machine; 1 for undisturbed timings"""
    engine: Literal["local", "dask", "slurm"] = "local"
    """Processes of this machine, the workers of a Dask cluster, or an array of Slurm's"""
    scheduler: str | None = None
    """Address of the Dask scheduler"""
    sbatch: str = ""
    """Options for sbatch, as "--partition=cpu --mem=4G"; tasks have the plan's timeout_s and five minutes"""
    store: Path = Path("results/results.db")
    """Keeps every result by the hash of all it depends on; nothing in it runs again"""
    cache: Path = Path("results/recordings")
    """Keeps the recordings of simulated worlds"""
    keep_runs: Path | None = None
    """Keep the run folder of every job in here"""
    retry_failed: bool = False
    """Run the jobs again that failed before"""
    verify: Path | None = None
    """Run jobs of this comparison (folder or manifest) again: do the numbers come out? Exit code 4 if not"""
    sample: Whole = 3
    """How many jobs --verify runs; 0: all"""
    dry_run: bool = False
    """Only list the jobs and which of them are done"""
    json: bool = False
    """Print JSON instead of lines"""
