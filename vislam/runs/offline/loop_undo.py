"""The loop edges of a finished run: what became of each, and the run optimised again without some of them."""

import math
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import Config
from vislam.core.errors import DataError, UsageError, VislamError
from vislam.core.files import write_json
from vislam.core.memory import GraphRecord, LoopPlace, LoopState, OfferedLoop, SlamMemory
from vislam.core.messages import GraphUpdate, LoopDecision
from vislam.factors import rig_from
from vislam.graph import PoseGraph
from vislam.loop import read_loops
from vislam.runs.folder import RunLog, read_metrics, recorded_alignment
from vislam.runs.further_sensors import suite_of
from vislam.runs.geodetic_outputs import LINES, TABLES, GeodeticOutputs
from vislam.runs.levelled import Levelled, stored_level
from vislam.runs.metrics import with_own_of_graph
from vislam.runs.session import Session, SessionWriter, recall
from vislam.trajectory import evaluate, read_tum, write_states_csv, write_tum

_HELD = (LoopPlace.GRAPH, LoopPlace.SPARE)
_FIRST = "trajectory_graph_first.tum"  # as the run itself ended


def list_loops(run: Path) -> list[dict[str, Any]]:
    """Return every loop edge that was offered to the graph of a run, in that order.

    Keys: id, from, to, decision, chi2, weight, reason; numbers that are not known are None. Raises DataError for what
    is no run or is damaged.
    """
    with Session(_session(run)) as session:
        loops = session.loops()
    rows = read_loops(run / "loops.csv") if (run / "loops.csv").is_file() else []  # a run that was killed has none
    weights = {(row.from_id, row.to_id): row.weight for row in rows if row.was_offered}
    return [_line(loop, weights.get((loop.edge.from_id, loop.edge.to_id), math.nan)) for loop in loops]


def _line(loop: OfferedLoop, weight: float) -> dict[str, Any]:
    edge, state = loop.edge, loop.state
    decision = "undone" if state.place is LoopPlace.UNDONE else str(state.decision)
    return {
        "id": edge.id, "from": edge.from_id, "to": edge.to_id, "decision": decision,
        "chi2": state.chi2 if math.isfinite(state.chi2) else None, "weight": weight if math.isfinite(weight) else None,
        "reason": state.reason,
    }  # fmt: skip


def change_loops(run: Path, undo: Sequence[int], redo: Sequence[int]) -> dict[str, Any]:
    """Optimise a run again without the edges `undo`, and with the edges `redo` that were undone before.

    The measurements of the session go through the same pose graph as in the run, with every other decision as it
    stands, and are optimised to convergence; loops may then be let in or taken out by the review of all of them.
    The session remembers: neither a run that is resumed nor one that uses the map gets an undone edge back.
    Everything is computed before anything is written. Returns what moved and what was written. Raises UsageError for
    edges that cannot be changed so, DataError for what is no run or is damaged.
    """
    with Session(_session(run)) as session:
        info, config, memory = session.info(), session.config(), recall(session)
        if memory is None:
            raise DataError(f"{run} has no keyframe with gravity yet; there is nothing to optimise")
        if (info.get("map") or {}).get("localize_only"):
            raise UsageError(f"{run} was only localised in a map, which it does not change; undo it there")
        changed = _changed(run, memory.graph.loops, undo, redo)
        memory = replace(memory, graph=replace(memory.graph, loops=changed))
        log = RunLog()
        log.restore(session, memory)
    redone = _optimise(config, info, memory)
    asked = {*undo, *redo}
    states = {state.id: state for state in redone.record.loops}
    states |= {loop.state.id: loop.state for loop in changed if loop.state.id in asked and loop.state.id not in states}
    before = {loop.state.id: loop.state.decision for loop in changed}
    others = [n for n, state in states.items() if n not in asked and state.decision != before[n]]
    SessionWriter.amend(run / "session.db", redone.update, replace(redone.record, loops=tuple(states.values())))
    moved_m = np.linalg.norm((redone.update.T_map_body - memory.graph.T_map_body)[:, :3, 3], axis=1)
    answer = {
        "undone": sorted(loop.state.id for loop in changed if loop.state.place is LoopPlace.UNDONE),
        "changed_besides": others,
        "moved_rms_m": float(np.sqrt(np.mean(moved_m**2))),
        "moved_max_m": float(moved_m.max()),
        "note": redone.update.note,
    }
    return answer | {"written": ["session.db", *_write(run, log, redone, answer, stored_level(info))]}


@dataclass(frozen=True, slots=True, eq=False)
class _Redone:
    graph: PoseGraph
    update: GraphUpdate
    record: GraphRecord
    config: Config


def _session(run: Path) -> Path:
    if not run.is_dir():
        raise DataError(f"{run} is no run folder; `vislam run SOURCE --out {run}` makes one")
    return run / "session.db"


def _changed(run: Path, loops: list[OfferedLoop], undo: Sequence[int], redo: Sequence[int]) -> list[OfferedLoop]:
    """Return the loops with those in their new places; raises UsageError when one cannot be put there."""
    known = {loop.edge.id: loop for loop in loops}
    out = dict(known)
    if twice := sorted(set(undo) & set(redo)):
        raise UsageError(f"loop {twice[0]} cannot be undone and brought back at once")
    for loop_id, place in [(n, LoopPlace.UNDONE) for n in undo] + [(n, LoopPlace.GRAPH) for n in redo]:
        if loop_id not in known:
            raise UsageError(f"{run} has no loop {loop_id}; `vislam loops {run}` lists the {len(known)} that it has")
        state = known[loop_id].state
        if place is LoopPlace.UNDONE and state.place not in _HELD:
            raise UsageError(f"loop {loop_id} is not in the graph ({state.reason}); there is nothing to undo")
        if place is LoopPlace.GRAPH and state.place is not LoopPlace.UNDONE:
            raise UsageError(f"loop {loop_id} was not undone, it is {state.decision}; there is nothing to bring back")
        out[loop_id] = replace(known[loop_id], state=_put(state, place))
    return list(out.values())


def _put(state: LoopState, place: LoopPlace) -> LoopState:
    """Return the state of a loop that is undone, or brought back."""
    undone = place is LoopPlace.UNDONE
    decision = LoopDecision.REJECTED if undone else LoopDecision.ACCEPTED
    reason = f"{state.reason}; {'undone' if undone else 'brought back'} by the user"
    return replace(state, decision=decision, reason=reason, place=place, tie=None)


def _optimise(config: Config, info: dict[str, Any], memory: SlamMemory) -> _Redone:
    """Build the graph of the run from what the session stored, and optimise it to convergence."""
    start = memory.front.start
    noise, first = (None, None) if start is None else (start.noise, start.first_state)
    suite = suite_of(config.sensors)
    graph = PoseGraph(config.graph, noise, config.machine, rig_from(info["rig"]), config.window, suite)
    graph.initialise(first, memory.T_start)
    graph.restore(memory.graph)
    return _Redone(graph, graph.finish(), graph.take_record(), config)


def _write(run: Path, log: RunLog, redone: _Redone, answer: dict[str, Any], level: Levelled) -> list[str]:
    """Write the trajectory, states, loops and metrics of the run again; return the names of the files."""
    graph, states = redone.graph, redone.graph.states()
    ids = graph.ids.tolist()
    estimated = log.final_trajectory(ids, graph.poses(), states, redone.config.machine)
    final = level.trajectory(estimated)
    if (run / "trajectory_graph.tum").is_file() and not (run / _FIRST).exists():
        shutil.copyfile(run / "trajectory_graph.tum", run / _FIRST)
    write_tum(final, run / "trajectory_graph.tum")
    write_states_csv(run / "states_graph.csv", ids, states)
    counts = log.write_tables(run, log.loop_rows({report.loop_id: report for report in graph.edge_reports()}))
    written = ["trajectory_graph.tum", "states_graph.csv", "loops.csv"]
    metrics = read_metrics(run)
    if metrics:
        metrics |= {"loops": counts, "loops_changed": answer}
        metrics["sensors"] = with_own_of_graph(metrics.get("sensors", {}), graph)
        estimates = {"filter": log.odometry_trajectory(), "graph": estimated}
        if GeodeticOutputs({}).write(run, metrics["sensors"], estimates) is not None:
            written += [TABLES["graph"], LINES]
        truth = run / "trajectory_truth.tum"
        if truth.is_file():
            stamps = log.stamps_ns
            with suppress(VislamError):  # nothing in common to compare: the run's own metrics say so
                accuracy = metrics.setdefault("accuracy", {})
                span = (int(stamps[0]), int(stamps[-1]))
                accuracy["graph"] = evaluate(final, read_tum(truth), recorded_alignment(metrics), span_ns=span)
        write_json(run / "metrics.json", metrics)
        written.append("metrics.json")
    return written
