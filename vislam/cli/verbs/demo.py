"""`vislam demo`: everything at once, without a recording."""

import sys
from dataclasses import dataclass
from pathlib import Path

from vislam.cli.verbs import VERBS
from vislam.cli.verbs.ahead import compile_ahead
from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.results import print_metrics
from vislam.cli.verbs.run import RunOptions, run_options
from vislam.config import Config
from vislam.config.ranges import Seed

_CAMERA_HZ = 10  # rendering takes most of the demo's time


@dataclass(frozen=True)
class DemoOptions:
    """Options of `vislam demo`."""

    out: Path = Path("demo")
    """Folder for the run; a run that it holds is replaced"""
    world: str = "workshop-cart"
    """Simulated world"""
    seed: Seed = 0
    """Of the world and of the pipeline"""


OPTIONS = (DemoOptions,)


def main(arguments: list[str]) -> int:
    """Simulate a world and run the pipeline on it."""
    options = parse(DemoOptions, arguments, "demo")
    compile_ahead(VERBS["demo"].compiles)
    print(f"vislam: simulating '{options.world}' and running the pipeline on it; about a minute ...", file=sys.stderr)
    source = f"sim:{options.world},camera_hz={_CAMERA_HZ},workers=2"
    run = RunOptions(source, options.out, Config(seed=options.seed), overwrite=True)
    print_metrics(run_options(run, ["vislam", "demo", *arguments]), run.out, as_json=False)
    return 0
