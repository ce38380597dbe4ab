"""`vislam loops`: the loop edges of a run, and the run without some of them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.terminal import number, print_table
from vislam.config.ranges import Whole
from vislam.core.log import log_in_run


@dataclass(frozen=True)
class LoopsOptions:
    """Options of `vislam loops`."""

    run: Positional[Path]
    """Run folder"""
    undo: tyro.conf.UseAppendAction[tuple[Whole, ...]] = ()
    """Id of an edge to optimise the run again without; may be given several times"""
    redo: tyro.conf.UseAppendAction[tuple[Whole, ...]] = ()
    """Id of an edge that was undone and is to come back; may be given several times"""
    json: bool = False
    """Print JSON instead of lines"""


OPTIONS = (LoopsOptions,)


def main(arguments: list[str]) -> int:
    """List loop edges, or undo and redo some."""
    options = parse(LoopsOptions, arguments, "loops")
    if not (options.undo or options.redo):
        return _list(options)
    with log_in_run(options.run, ["vislam", "loops", *arguments]):
        return _change(options)


def _list(options: LoopsOptions) -> int:
    from vislam.runs.offline.loop_undo import list_loops

    loops = list_loops(options.run)
    if options.json:
        print(json.dumps(loops))
    else:
        _print_edges(loops)
    return 0


def _print_edges(loops: list[dict[str, Any]]) -> None:
    rows = []
    for loop in loops:
        ends = [str(loop[name]) for name in ("id", "from", "to")]
        rows.append((*ends, loop["decision"], number(loop["chi2"], 1), number(loop["weight"], 2), loop["reason"]))
    print_table(("id", "from", "to", "decision", "chi2", "weight", "reason"), rows, words=("decision", "reason"))


def _change(options: LoopsOptions) -> int:
    from vislam.runs.offline.loop_undo import change_loops
    from vislam.runs.report import write_report

    answer = change_loops(options.run, options.undo, options.redo)
    write_report(options.run)
    if options.json:
        print(json.dumps(answer))
        return 0
    undone = ", ".join(map(str, answer["undone"])) or "none"
    print(f"undone: {undone}; keyframes moved {answer['moved_rms_m']:.4f} m rms, {answer['moved_max_m']:.4f} m at most")
    if answer["changed_besides"]:
        print(f"the review of all loops then decided otherwise about {', '.join(map(str, answer['changed_besides']))}")
    print(f"written again: {', '.join(answer['written'])}, report.html; the trajectory with which the run itself ended")
    print(f"is in trajectory_graph_first.tum. Causal trajectories and map/ are as they were: vislam map {options.run}")
    return 0
