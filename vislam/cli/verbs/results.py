"""The metrics of a run on the terminal."""

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from vislam.cli.verbs.terminal import number, print_table
from vislam.core.errors import printable


def print_metrics(metrics: dict[str, Any], out: Path, as_json: bool) -> None:
    """Print what a run in `out` measured: as JSON, or as a table with its warnings and where its files are."""
    from vislam.core.files import plain

    if as_json:
        print(json.dumps(plain(metrics)))
        return
    console, loops = Console(), metrics["loops"]
    _print_verdict(console, metrics.get("verdict", {}))
    if metrics["accuracy"]:
        _print_accuracy(metrics)
    console.print(
        f"{metrics['frames']} frames, {metrics['keyframes']} keyframes, {loops['accepted']} loops of "
        f"{loops['candidates']} candidates, {number(metrics['realtime_factor'], 1)} x real time"
    )
    if metrics.get("up"):
        from vislam.runs.levelled import up_sentence

        console.print(f"{printable(up_sentence(metrics['up']))}.", soft_wrap=True, markup=False, highlight=False)
    _print_cost(console, metrics["cost"])
    for warning in metrics["warnings"]:
        console.print(f"warning: {printable(warning)}", style="yellow", markup=False)
    for name, title in (("report.html", "report"), ("run.rrd", "Rerun recording"), ("map", "map")):
        if (out / name).exists():
            console.print(f"{title}: {out / name}", soft_wrap=True)


def _print_cost(console: Console, cost: dict[str, Any]) -> None:
    """Print what the run cost; `number` shows a dash for what is not known."""
    compiled = f", after {cost['compile_cpu_s']:.0f} s of compilation" if cost["compile_cpu_s"] >= 1.0 else ""
    console.print(
        f"{number(cost['cpu_ms_per_frame'], 0)} ms of CPU per frame{compiled}, {number(cost['peak_memory_mb'], 0)} MB, "
        f"first pose after {number(cost['first_pose_s'], 2)} s of the recording",
        highlight=False,
    )


def print_evaluation(results: dict[str, dict[str, Any]]) -> None:
    """Print the errors of trajectories, as `evaluate` returns them, by name, and what they mean; in 80 columns."""
    columns = {
        "ATE\nrmse m": "ate_rmse_m", "ATE\nmedian": "ate_median_m", "ATE\nmax m": "ate_max_m",
        "RPE\n1 s m": "rpe_1s_m", "RPE\n1 s deg": "rpe_1s_deg", "best\nscale": "scale",
    }  # fmt: skip
    rows = []
    for name, entry in results.items():
        numbers = [_short(entry[key]) for key in columns.values()]
        rows.append((name, *numbers, f"{entry['matched']}/{entry['total']}", f"{entry['coverage']:.0%}"))
    print_table(("trajectory", *columns, "matched", "covered"), rows, margin=0)
    for words in dict.fromkeys(_meaning(entry) for entry in results.values()):
        Console().print(words, highlight=False)


_ALIGNED = {
    "se3": "aligned by SE(3), scale kept", "sim3": "aligned by Sim(3), scale too", "none": "not aligned",
    "yaw": "aligned by yaw and position, scale kept", "first": "aligned at the first pose, scale kept",
}  # fmt: skip


def _meaning(entry: dict[str, Any]) -> str:
    """Return alignment, units and association of an entry in words."""
    gap_s, own = f"{entry['max_gap_s']:.3g} s", entry["at"] == "estimate"
    paired = (
        f"reference interpolated at the estimate's times{'' if own else ' next to its own'}, across {gap_s} at most"
    )
    if entry["association"] == "nearest":
        paired = f"paired with the nearest pose within {gap_s}"
    unknown = "" if entry["rotation_rmse_deg"] is not None else "; positions only: no rotation and no relative errors"
    return f"Metres and degrees, {_ALIGNED[entry['alignment']]}; {paired}{unknown}."


def _short(value: float | None) -> str:
    """Write a number in seven places: four digits behind the point, fewer of a large one."""
    return "-" if value is None else number(value, max(0, 4 - max(0, len(f"{abs(value):.0f}") - 1)))


def _print_verdict(console: Console, verdict: dict[str, Any]) -> None:
    """Print what the run is worth, and under it what its calibration found."""
    if verdict:
        from vislam.runs.verdict import verdict_sentence

        style = "green" if verdict["state"] == "trusted" else "red"
        console.print(f"{printable(verdict_sentence(verdict))}.", style=style, soft_wrap=True, markup=False)
    for moved in verdict.get("moved", []):
        console.print(f"found out: {printable(moved)}", soft_wrap=True, markup=False)


def _print_accuracy(metrics: dict[str, Any]) -> None:
    odometry = "EKF alone, causal" if metrics["has_imu"] else "odometry, causal"
    titles = {"ekf": odometry, "live": "graph, causal", "graph": "graph, final"}
    columns = {
        "ATE rmse [m]": "ate_rmse_m", "ATE max [m]": "ate_max_m", "RPE 1 s [m]": "rpe_1s_m",
        "RPE 1 s [deg]": "rpe_1s_deg",
    }  # fmt: skip
    rows = [
        (titles.get(name, name), *(number(entry[key], 3) for key in columns.values()), f"{entry['coverage']:.0%}")
        for name, entry in metrics["accuracy"].items()
    ]
    title = f"{metrics['name']} ({metrics['mode']}{', inertial' if metrics['has_imu'] else ''})"
    print_table(("trajectory", *columns, "covered"), rows, title)
    print_truth(metrics)


def print_truth(metrics: dict[str, Any]) -> None:
    """Print how good the truth of a run is, where its metrics say it."""
    truth = metrics.get("truth")
    if isinstance(truth, dict) and truth.get("summary"):
        Console().print(f"by the IMU, {printable(truth['summary'])}", soft_wrap=True, markup=False, highlight=False)
