"""The report's section about further sensors: what became of their readings, and what their own variables are."""

from vislam.runs.report.html import Cell, card, note, number, section, table
from vislam.runs.report.run_files import RunFiles, as_dict, as_list

_ESTIMATORS = ("filter", "graph")
_IN_GRAPH = ["sensor", "used", "in window", "outliers", "failed", "beginning", "not there"]
_NOT_THERE = ("late", "unplaced", "at_submap", "after", "too_early", "early", "dropped", "crowded", "queued")


def sensors_section(run: RunFiles) -> str:
    """Return the section about further sensors; empty for a run without any."""
    sensors = as_dict(run.metrics, "sensors")
    if not sensors:
        return ""
    readings: list[list[str | Cell]] = []
    own: list[list[str | Cell]] = []
    for name in sensors:
        readings.append(_readings(run, name))
        own += _own_variables(name, as_dict(sensors, name))
    head = ["sensor", "readings", "accepted", "gated", "refused", "unusable", "NIS per degree", "note"]
    text = (
        "Accepted, gated and refused by the filter; before a sensor has begun its readings find its own variables. "
        "A filter that knows its own uncertainty has a NIS of 1 per degree of freedom."
    )
    in_graph = [row for name in sensors if (row := _in_graph(name, as_dict(sensors, name, "readings", "graph")))]
    graph_text = (
        "Used: in factors; in window: while the camera was blind; outliers, of those used, fail the sensor's gate at "
        "the final estimate. Beginning: in the prior of own variables instead. Not there: late, without inertial data, "
        "at the start of a submap, after the last keyframe, or from before the graph."
    )
    variables = table(["sensor", "variable", "filter", "± σ", "graph", "± σ"], own, text_columns=(0, 1))
    return section(
        "Further sensors",
        card(table(head, readings, text_columns=(0, 7))),
        note(text),
        card(table(_IN_GRAPH, in_graph, text_columns=(0,)), title="Readings in the graph") if in_graph else "",
        note(graph_text) if in_graph else "",
        card(variables, title="Own variables") if own else "",
    )


def _readings(run: RunFiles, name: str) -> list[str | Cell]:
    counted, filtered = as_dict(run.metrics, "counters", f"sensor {name}"), as_dict(run.metrics, "counters", "ekf")
    by_filter = [number(filtered.get(f"{name}_{what}"), 0) for what in ("accepted", "gated", "refused")]
    entry = as_dict(run.metrics, "sensors", name)
    said = str(entry.get("note", "" if entry.get("begun") else "has not begun"))
    said = "; ".join(filter(None, (said, _slipped(as_dict(entry, "slip")))))
    nis = number(_nis_per_degree(as_list(as_dict(run.metrics, "nis").get(name))), 2)
    return [
        name, number(counted.get("readings"), 0), *by_filter, number(counted.get("unusable"), 0), nis,
        Cell(said, kind="text long"),
    ]  # fmt: skip


def _slipped(slip: dict[str, object]) -> str:
    """Return in words how often wheels slipped; empty: never."""
    times, seconds = slip.get("times"), slip.get("seconds")
    if not isinstance(times, int) or not isinstance(seconds, int | float):
        return ""
    still = ", at the end as well" if slip.get("slips") else ""
    doubt = "; contradicted the other sensors for longer than a slip lasts" if slip.get("contradicts") else ""
    return f"slipped {times} time{'s' if times != 1 else ''}, {seconds:.1f} s{still}; not used meanwhile{doubt}"


def _in_graph(name: str, counted: dict[str, object]) -> list[str | Cell]:
    """Return a row about a sensor; empty where nothing was counted."""
    if not counted:
        return []
    missing = sum(value for key in _NOT_THERE if isinstance(value := counted.get(key), int))
    shown = [counted.get(key) for key in ("used", "in_window", "outliers", "failed", "beginning")]
    return [name, *(number(value, 0) for value in (*shown, missing))]


def _nis_per_degree(statistics: list[object]) -> float | None:
    """Return the mean of count, sum of NIS and sum of degrees of freedom."""
    if len(statistics) != 3 or not all(isinstance(value, int | float) for value in statistics):
        return None
    _, nis, degrees = (float(value) for value in statistics if isinstance(value, int | float))
    return nis / degrees if degrees > 0.0 else None


def _own_variables(name: str, entry: dict[str, object]) -> list[list[str | Cell]]:
    rows: list[list[str | Cell]] = []
    for k, variable in enumerate(as_list(entry.get("variables"))):
        row: list[str | Cell] = [name, Cell(str(variable), kind="text")]
        for estimator in _ESTIMATORS:
            found = as_dict(entry, estimator)
            for key in ("values", "sigmas"):
                values = as_list(found.get(key))
                row.append(number(values[k] if k < len(values) else None, 4))
        rows.append(row)
    return rows
