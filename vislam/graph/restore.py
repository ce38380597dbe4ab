"""An earlier run's graph as records again: what a session stored, checked, in the order in which it came."""

from dataclasses import replace

from vislam.config import GraphConfig
from vislam.core.errors import DataError
from vislam.core.memory import GraphMemory, LoopPlace, OfferedLoop
from vislam.factors.journal import KeyframeRecord, LoopRecord, Record, StartRecord, keyframe_records, loop_record
from vislam.factors.loop import LoopModel
from vislam.graph.joining import weak_link


def restored_journal(
    memory: GraphMemory, config: GraphConfig, has_gravity: bool, start: StartRecord
) -> tuple[list[KeyframeRecord], list[Record]]:
    """Return the keyframes and the whole journal; raises DataError when the memory contradicts itself."""
    is_tight = config.coupling == "tight"
    count = len(memory.packets)
    windows = count if is_tight else 0
    if count == 0 or len(memory.T_map_body) != count or len(memory.windows) != windows:
        raise DataError(
            f"{count} keyframes are stored with {len(memory.T_map_body)} poses and {len(memory.windows)} records of a "
            f"window, expected {windows}; run the recording again"
        )
    keyframes: list[KeyframeRecord] = []
    journal: list[Record] = [start]
    loops = iter(memory.loops)
    loop = next(loops, None)
    for k, measured in enumerate(keyframe_records(memory.packets)):
        record = measured
        if record.begins_submap:  # tied to the one before as the map has them
            before, now = memory.T_map_body[k - 1 : k + 1]
            record = weak_link(record, before, before, now, has_gravity, config)
        if is_tight:
            _check_window(memory, k)
            record = replace(record, imu=None)
        keyframes.append(record)
        journal += [record, memory.windows[k]] if is_tight else [record]
        while loop is not None and loop.offered_with <= k:
            taken = _as_taken(loop, k)
            if taken is not None:
                journal.append(taken)
            loop = next(loops, None)
    if loop is not None:
        raise DataError(f"loop {loop.edge.id} was offered with keyframe {loop.offered_with} of {count}")
    return keyframes, journal


def sort_loops(loops: list[OfferedLoop], models: dict[int, LoopModel]) -> dict[LoopPlace, list[LoopModel]]:
    """Return the loops by where the graph kept them, each tied as it was."""
    out: dict[LoopPlace, list[LoopModel]] = {place: [] for place in LoopPlace}
    for loop in loops:
        model = models.get(loop.state.id)
        if model is not None:
            model.tie = loop.state.tie
            out[loop.state.place].append(model)
    return out


def _check_window(memory: GraphMemory, k: int) -> None:
    """Raise DataError unless the window's record of keyframe k fits: each keyframe but the first needs an edge."""
    said = memory.windows[k]
    ends = [edge.to_id for edge in said.edges]
    if said.id != k or said.t_ns != memory.packets[k].keyframe.t_ns or any(not 0 < end <= k for end in ends):
        raise DataError(f"the window's record of keyframe {k} is of keyframe {said.id}, with edges to {ends}")
    if k and k not in ends:
        raise DataError(f"the window's record of keyframe {k} has no edge that ends there")


def _as_taken(loop: OfferedLoop, k: int) -> LoopRecord | None:
    """Return a loop as the graph took it when it was offered; None where it could not, which it never kept."""
    try:
        return loop_record(loop.edge, k)
    except DataError:
        if loop.state.place is not LoopPlace.OUT:
            raise
        return None
