"""The report's section about loops: what became of each candidate, and how good they were against the truth."""

import math
import re
from collections import Counter

from vislam.loop import LoopRow, caption
from vislam.runs.report.html import Cell, card, drawn, escape, folded, grid, note, number, picture, section, table
from vislam.runs.report.loop_plots import loop_quality
from vislam.runs.report.run_files import RunFiles, as_dict
from vislam.runs.report.scene import Scene

_SHOWN_LOOPS = 10  # rows that are always seen
_MAX_LOOPS = 300  # rows that can be unfolded; the rest is in loops.csv
_DECISIONS = ("accepted", "pending", "rejected")


def loops_section(run: RunFiles, scene: Scene) -> str:
    """Return the section about loops; empty where the run reports nothing of them."""
    counts = as_dict(run.metrics, "loops")
    if not run.loops:
        return section("Loops", note("No candidates.")) if counts and run.has_camera else ""
    by_decision = Counter(loop.decision for loop in run.loops)
    summary = ", ".join(f"{by_decision[d]} {d}" for d in _DECISIONS if by_decision[d])
    order = sorted(run.loops, key=lambda loop: (_rank(loop.decision), -_moved(loop), loop.to_id, loop.from_id))
    head = [
        "from", "to", "at [s]", "decision", "reason", "source", "score", "inliers", "σ [m]", "in a row", "χ²", "weight",
        "moved [m]",
    ]  # fmt: skip
    rows = [_loop_row(loop, scene.zero_ns) for loop in order[:_MAX_LOOPS]]
    text = f"{len(run.loops)} candidates: {summary}."
    shown = table(head, rows[:_SHOWN_LOOPS], text_columns=(3, 4, 5))
    rest = rows[_SHOWN_LOOPS:]
    hidden = len(order) - len(rows)
    title = f"{len(rest)} more candidates" + (f"; another {hidden} are in loops.csv" if hidden else "")
    more = folded(title, table(head, rest, text_columns=(3, 4, 5))) if rest else ""
    words = note(
        f"{text} “Moved” is a loop's own share of what the update that took it in moved. With scripts a click on a "
        "heading sorts."
    )
    listed = f'<div class="sortable">{card(shown)}{more}</div>'
    return section("Loops", words, _loop_quality(run), _loop_pictures(run), _reasons(run.loops), listed)


def _loop_quality(run: RunFiles) -> str:
    """Return how good the loops are, where `vislam eval RUN --loops` has compared them with the truth."""
    if not run.loops_eval:
        return ""
    answer, edges, rule = run.loops_eval, as_dict(run.loops_eval, "edges"), as_dict(run.loops_eval, "rule")
    try:
        drawings = loop_quality(answer)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        return card(note(f"loops_eval.json cannot be drawn: {type(error).__name__} {error}"))
    rows: list[list[str | Cell]] = []
    for name, stage in as_dict(answer, "stages").items():
        low, high = stage["interval"]
        interval = f"{number(low, 2)} to {number(high, 2)}"
        shares = [number(stage[key]) for key in ("precision", "recall", "recall_at_full_precision")]
        rows.append([name, number(stage["answers"], 0), number(stage["wrong"], 0), *shares, interval])
    head = ["stage", "answers", "wrong", "precision", "recall", "recall at 100 %", "bootstrap"]
    text = (
        f"{number(answer.get('revisits'), 0)} of {number(answer.get('keyframes'), 0)} keyframes see again, "
        f"{number(rule.get('min_apart_s'), 0)} s or {number(rule.get('min_apart_keyframes'), 0)} keyframes later, what "
        f"an earlier one saw (overlap of the views above {number(rule.get('min_overlap'), 2)} by the true poses). "
        "Retrieved images are judged by that overlap, verified poses by their own error. "
        f"{number(edges.get('gross'), 0)} of {number(edges.get('accepted'), 0)} edges in the graph are off by more "
        f"than {number(rule.get('gross_m'), 1)} m or {number(rule.get('gross_deg'), 0)}°."
    )
    return card(grid(*map(drawn, drawings)), table(head, rows), title="Against the truth") + note(text)


def _loop_pictures(run: RunFiles) -> str:
    """Return the pictures of candidates worth seeing, each with its line, folded but for the first of each kind."""
    decided = {(loop.from_id, loop.to_id, loop.decision): loop for loop in run.loops}
    cards: dict[str, list[str]] = {"accepted": [], "others": []}
    for path in run.loop_pictures:
        match = re.fullmatch(r"\d+_(\d+)_(\d+)_(accepted|pending|rejected)", path.stem)
        loop = decided.get((int(match[1]), int(match[2]), match[3])) if match else None
        if loop is None:
            continue
        try:
            shown = picture(path, "")
        except OSError as error:
            shown = card(note(f"{path.name} cannot be read: {error.strerror or error}"))
        cards["accepted" if loop.decision == "accepted" else "others"].append(shown + note(caption(loop)))
    parts = []
    for kind, title in (("accepted", "Accepted ones that moved the map most"), ("others", "Others that came close")):
        if cards[kind]:
            pairs = [f"<div>{shown}</div>" for shown in cards[kind]]
            parts.append(f"<h3>{escape(title)}</h3>" + grid(*pairs[:2]))
            parts.append(folded(f"{len(pairs) - 2} more", grid(*pairs[2:])) if len(pairs) > 2 else "")
    return "".join(parts)


def _reasons(loops: list[LoopRow]) -> str:
    """Return how often each reason occurred, and between which images; the last word on it, without its numbers."""
    pairs: dict[str, list[str]] = {}
    for loop in loops:
        if loop.decision != "accepted":
            reason = re.sub(r"\d+(\.\d+)?", "…", loop.reason.rpartition("; ")[2].partition(":")[0])
            pairs.setdefault(reason, []).append(f"{loop.from_id} and {loop.to_id}")
    if len(pairs) < 2:
        return ""
    often = sorted(pairs.items(), key=lambda item: -len(item[1]))[:8]
    rows: list[list[str | Cell]] = [
        [Cell(reason, kind="text long"), str(len(some)), Cell(_few(some), kind="text")] for reason, some in often
    ]
    return card(table(["why not accepted", "candidates", "of keyframes"], rows))


def _few(pairs: list[str], most: int = 4) -> str:
    return "; ".join(pairs[:most]) + ("; …" if len(pairs) > most else "")


def _moved(loop: LoopRow) -> float:
    return loop.moved_max_m if math.isfinite(loop.moved_max_m) else 0.0


def _rank(decision: str) -> int:
    return _DECISIONS.index(decision) if decision in _DECISIONS else len(_DECISIONS)


def _loop_row(loop: LoopRow, zero_ns: int) -> list[str | Cell]:
    return [
        str(loop.from_id),
        str(loop.to_id),
        number((loop.to_t_ns - zero_ns) * 1e-9, 1) if loop.to_t_ns >= 0 else "–",
        Cell(loop.decision, mark=loop.decision),
        Cell(loop.reason, kind="text long"),
        loop.source,
        number(loop.score),
        number(loop.inliers, 0),
        number(loop.sigma_m),
        number(loop.consistency, 0),
        number(loop.chi2, 1),
        number(loop.weight, 2),
        number(loop.moved_max_m),
    ]
