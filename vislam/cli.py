"""The command line: one verb per job. The only place that prints and sets exit codes.

Exit codes: 0 done, 2 usage, 3 input or data, 4 tracking lost or a quality gate failed, 5 hardware, 130 interrupted.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from vislam.errors import DataError, HardwareError, TrackingLostError, UsageError, VislamError

if TYPE_CHECKING:
    from vislam.config import Config
    from vislam.datasets.inspect import Inspection
    from vislam.findings import Finding
    from vislam.hw.doctor import HardwareReport
    from vislam.options import DoctorOptions, EvalOptions, MapOptions
    from vislam.runfolder import MapChoice

# the matrices here are small: threads cost more than they bring, and replay must not depend on them
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_INTERRUPTED = 130
_DEMO_CAMERA_HZ = 10  # rendering takes most of the demo's time

Options = TypeVar("Options")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a verb and leave the process with its exit code."""
    sys.exit(run_verb(list(sys.argv[1:] if arguments is None else arguments)))


def run_verb(arguments: list[str]) -> int:
    """Run a verb; return the exit code. Expected failures become one line on stderr, bugs keep their traceback."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else 2
    verb = _VERBS.get(arguments[0])
    if verb is None:
        _complain(f"no verb '{arguments[0]}'; there are: {', '.join(_VERBS)}")
        return UsageError.exit_code
    try:
        return verb.function(arguments[1:])
    except VislamError as error:
        _complain(str(error))
        return error.exit_code
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        _complain("interrupted; what was computed is in the run folder")
        return _INTERRUPTED


@dataclass(frozen=True, slots=True)
class _Verb:
    function: Callable[[list[str]], int]
    summary: str
    example: str


def _help() -> str:
    lines = ["usage: vislam VERB ...", "", "SLAM from a camera and a cheap IMU.", ""]
    lines += [f"  {name:<12}{verb.summary}" for name, verb in _VERBS.items()]
    lines += ["", "examples:"] + [f"  {verb.example}" for verb in _VERBS.values()]
    lines += [
        "",
        "vislam VERB --help tells the rest. Exit codes: 0 done, 2 usage, 3 data, 4 tracking lost, 5 hardware.",
    ]
    return "\n".join(lines)


def _complain(message: str) -> None:
    print(f"vislam: {message}", file=sys.stderr)


def _parse(options: type[Options], arguments: list[str], verb: str, default: Options | None = None) -> Options:
    """Parse the arguments of a verb into its options; wrong ones leave with exit code 2, --help with 0."""
    import tyro

    start = tyro.MISSING_NONPROP if default is None else default
    return tyro.cli(options, prog=f"vislam {verb}", description=_VERBS[verb].summary, args=arguments, default=start)


def _take_option(arguments: list[str], name: str) -> str | None:
    """Remove `--name VALUE` or `--name=VALUE` from the arguments and return the value."""
    for i, argument in enumerate(arguments):
        if argument == name:
            if i + 1 == len(arguments):
                raise UsageError(f"{name} needs a value")
            value = arguments[i + 1]
            del arguments[i : i + 2]
            return value
        if argument.startswith(f"{name}="):
            del arguments[i]
            return argument.partition("=")[2]
    return None


def _run(arguments: list[str]) -> int:
    from vislam.config import dump, load
    from vislam.options import RunOptions, run_options
    from vislam.runfolder import MapChoice

    command = ["vislam", "run", *arguments]
    resumed = _take_option(arguments, "--resume")
    if resumed is not None:
        return _resume(Path(resumed), arguments, command)
    config_path = _take_option(arguments, "--config")
    base = load(Path(config_path) if config_path else None)
    options = _parse(RunOptions, arguments, "run", run_options(base))
    if options.dry_run:
        print(json.dumps({"source": options.source, "out": str(options.out), "config": dump(options.settings)}))
        return 0
    if options.localize_only and options.map is None:
        raise UsageError("--localize-only needs a map; give --map OLD/session.db")
    begun_in = None if options.map is None else MapChoice(options.map, options.localize_only)
    metrics = _run_source(options.source, options.settings, options.out, options.overwrite, command, begun_in)
    _show(metrics, options.out, options.json)
    return 0


def _resume(out: Path, arguments: list[str], command: list[str]) -> int:
    """Go on with the run in a folder, whatever ended it."""
    from vislam.options import ResumeOptions
    from vislam.run import resume
    from vislam.runfolder import read_setup
    from vislam.sources import open_source

    options = _parse(ResumeOptions, arguments, "run")
    source, config, base = read_setup(out)
    recording = open_source(source, config.seed, config.calibration)
    with _written_up(out), _progress(recording.name) as progress:
        metrics = resume(recording, config, out, source, command, progress, base)
    _show(metrics, out, options.json)
    return 0


def _show(metrics: dict[str, Any], out: Path, as_json: bool) -> None:
    from vislam.runfolder import plain

    if as_json:
        print(json.dumps(plain(metrics)))
    else:
        _print_summary(metrics, out)


def _run_source(
    source: str, settings: Config, out: Path, overwrite: bool, command: list[str], base: MapChoice | None = None
) -> dict[str, Any]:
    """Run a source into a folder and write its report, whatever happened on the way."""
    from vislam.datasets.calibrated import with_clock
    from vislam.run import execute
    from vislam.runfolder import prepare
    from vislam.sources import open_source

    settings = with_clock(settings)
    recording = open_source(source, settings.seed, settings.calibration)
    prepare(out, overwrite)
    with _written_up(out), _progress(recording.name) as progress:
        return execute(recording, settings, out, source=source, command=command, progress=progress, base=base)


@contextmanager
def _written_up(out: Path) -> Iterator[None]:
    """Write the report of a run afterwards, whatever happened on the way."""
    from vislam.report import write_report

    try:
        yield
    except BaseException:
        with suppress(VislamError):  # what went wrong first is what is told
            if (out / "metrics.json").is_file():
                write_report(out)
        raise
    write_report(out)


@contextmanager
def _progress(name: str, unit: str = "frames") -> Iterator[Callable[[int, int, str], None] | None]:
    """Show a progress bar on stderr when that is a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn(name),
        BarColumn(),
        TextColumn(f"{{task.completed}}/{{task.total}} {unit}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, note="")
        yield lambda done, total, note: bar.update(task, completed=done, total=total, note=note)


def _print_summary(metrics: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    titles = {"ekf": "EKF alone, causal" if metrics["has_imu"] else "odometry, causal", "live": "graph, causal"}
    titles["graph"] = "graph, final"
    if metrics["accuracy"]:
        table = Table(title=f"{metrics['name']} ({metrics['mode']}{', inertial' if metrics['has_imu'] else ''})")
        for column in ("trajectory", "ATE rmse [m]", "ATE max [m]", "RPE 1 s [m]", "RPE 1 s [deg]", "covered"):
            table.add_column(column, justify="left" if column == "trajectory" else "right")
        for name, entry in metrics["accuracy"].items():
            values = [_number(entry[key], 3) for key in ("ate_rmse_m", "ate_max_m", "rpe_1s_m", "rpe_1s_deg")]
            table.add_row(titles.get(name, name), *values, f"{entry['coverage']:.0%}")
        console.print(table)
    loops = metrics["loops"]
    console.print(
        f"{metrics['frames']} frames, {metrics['keyframes']} keyframes, {loops['accepted']} loops of "
        f"{loops['candidates']} candidates, {_number(metrics['realtime_factor'], 1)} x real time"
    )
    for warning in metrics["warnings"]:
        console.print(f"warning: {warning}", style="yellow")
    for name, title in (("report.html", "report"), ("run.rrd", "Rerun recording"), ("map", "map")):
        if (out / name).exists():
            console.print(f"{title}: {out / name}", soft_wrap=True)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _demo(arguments: list[str]) -> int:
    from vislam.config import Config
    from vislam.options import DemoOptions

    options = _parse(DemoOptions, arguments, "demo")
    _complain(f"simulating '{options.world}' and running the pipeline on it; about two minutes ...")
    source = f"sim:{options.world},camera_hz={_DEMO_CAMERA_HZ}"
    metrics = _run_source(source, Config(seed=options.seed), options.out, True, ["vislam", "demo", *arguments])
    _print_summary(metrics, options.out)
    return 0


def _simulate_graph(arguments: list[str]) -> int:
    from vislam.batch.graph_worlds import simulate_graph, write_simulated
    from vislam.options import SimulateGraphOptions

    options = _parse(SimulateGraphOptions, arguments, "simulate")
    graph = simulate_graph(options.graph, options.settings)
    write_simulated(graph, options.out, options.truth, options.outliers)
    edges, false = len(graph.problem.edges), int(graph.outlier.sum())
    print(f"{len(graph.truth)} poses and {edges} edges ({false} false loops) in {options.out}")
    print(f"next: vislam optimize {options.out}")
    return 0


def _simulate(arguments: list[str]) -> int:
    if any(argument.partition("=")[0] == "--graph" for argument in arguments):
        return _simulate_graph(arguments)
    from vislam.datasets.recorder import record
    from vislam.options import SimulateOptions
    from vislam.sim import open_world

    options = _parse(SimulateOptions, arguments, "simulate")
    choices = {name: value for name, value in asdict(options).items() if name not in ("world", "out")}
    world = open_world(options.world, **choices)
    with _progress(options.world) as progress:

        def on_frame(done: int) -> None:
            if progress is not None:
                progress(done, world.frame_count, "")

        recorder = record(world, options.out, on_frame=on_frame)
    frames = recorder.counts["frames"]
    print(f"{frames} frames in {options.out}; next: vislam run {options.out} --out RUN")
    return 0


def _eval(arguments: list[str]) -> int:
    from vislam.options import EvalOptions

    options = _parse(EvalOptions, arguments, "eval")
    if options.loops:
        return _eval_loops(options)
    results = _evaluate(options.estimate, options.reference, options.align, options.association)
    if options.json:
        print(json.dumps(results))
    else:
        _print_evaluation(results)
    covered = min(entry["coverage"] for entry in results.values())
    if covered < options.min_coverage:
        raise TrackingLostError(
            f"the estimate covers {covered:.0%} of the reference, {options.min_coverage:.0%} asked; "
            "check that both use the same clock, or lower --min-coverage"
        )
    return 0


def _eval_loops(options: EvalOptions) -> int:
    from vislam.loop_evaluation import evaluate_loops
    from vislam.report import write_loop_plot, write_report

    answer = evaluate_loops(options.estimate, options.truth, options.reference)
    write_loop_plot(options.estimate / "loops_eval.png", {options.estimate.resolve().name: answer})
    write_report(options.estimate)
    if options.json:
        print(json.dumps(answer))
    else:
        _print_loops(answer)
    return 0


def _print_loops(answer: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{answer['revisits']} of {answer['keyframes']} keyframes revisit a place")
    for title in ("stage", "answers", "wrong", "precision", "recall", "recall at full precision", "interval"):
        table.add_column(title, justify="left" if title == "stage" else "right")
    for name, stage in answer["stages"].items():
        numbers = [_number(stage[key], 3) for key in ("precision", "recall", "recall_at_full_precision")]
        low, high = stage["interval"]
        interval = f"{_number(low, 2)} to {_number(high, 2)}" if answer["revisits"] else "-"
        table.add_row(name, str(stage["answers"]), str(stage["wrong"]), *numbers, interval)
    edges, rule = answer["edges"], answer["rule"]
    errors = [_number(edges[part][key], 3) for part in ("error_m", "error_deg") for key in ("median", "max")]
    console = Console()
    console.print(table)
    console.print(
        f"{edges['accepted']} edges in the graph, {edges['apart']} of them loops; off by {errors[0]} m and "
        f"{errors[2]} deg in the median, {errors[1]} m and {errors[3]} deg at most; {edges['gross']} gross "
        f"(over {rule['gross_m']:g} m or {rule['gross_deg']:g} deg)"
    )


def _evaluate(estimate: Path, reference: Path | None, align: str, association: Any) -> dict[str, dict[str, Any]]:
    from vislam.trajectory import evaluate, read_trajectory

    names = {estimate.name: estimate}
    if estimate.is_dir():
        names = {p.stem.removeprefix("trajectory_"): p for p in sorted(estimate.glob("trajectory_*.tum"))}
        truth = names.pop("truth", None)
        reference = reference or truth
    if reference is None:
        raise UsageError("no reference to evaluate against; give --reference FILE")
    if not names:
        raise DataError(f"{estimate} holds no trajectory_*.tum; give a run folder or a trajectory file")
    truth_trajectory = read_trajectory(reference)
    return {
        name: evaluate(read_trajectory(path), truth_trajectory, align, association=association)
        for name, path in names.items()
    }


def _print_evaluation(results: dict[str, dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    columns = {
        "ATE rmse [m]": "ate_rmse_m", "median": "ate_median_m", "max": "ate_max_m", "RPE 1 s [m]": "rpe_1s_m",
        "RPE 1 s [deg]": "rpe_1s_deg", "scale": "scale",
    }  # fmt: skip
    table = Table()
    for title in ("trajectory", *columns, "matched", "covered"):
        table.add_column(title, justify="left" if title == "trajectory" else "right")
    for name, entry in results.items():
        numbers = [_number(entry[key], 4) for key in columns.values()]
        table.add_row(name, *numbers, f"{entry['matched']}/{entry['total']}", f"{entry['coverage']:.0%}")
    Console().print(table)


def _doctor(arguments: list[str]) -> int:
    from vislam.options import DoctorOptions

    options = _parse(DoctorOptions, arguments, "doctor")
    if not options.source:
        return _doctor_hardware(options)
    if options.i2c or options.serial or options.camera:
        raise UsageError(f"doctor examines {options.source} or the sensors of this machine, not both; leave one out")
    from vislam.datasets.inspect import inspect

    inspection = inspect(options.source)
    if options.json:
        print(json.dumps(asdict(inspection)))
    else:
        _print_inspection(inspection)
    return DataError.exit_code if inspection.worst == "error" else 0


def _doctor_hardware(options: DoctorOptions) -> int:
    """Examine the sensors of this machine."""
    if not 0.5 <= options.seconds <= 60.0:
        raise UsageError(f"--seconds must be 0.5 to 60, got {options.seconds:g}")
    from vislam.hw.doctor import Wanted, examine

    report = examine(Wanted(options.i2c, options.serial, options.camera), options.seconds)
    if options.json:
        print(json.dumps(asdict(report)))
    else:
        _print_hardware(report)
    return HardwareError.exit_code if report.worst == "error" else 0


def _print_hardware(report: HardwareReport) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for title, columns, rows in (
        ("found", ("what", "where", "name"), [(d.kind, d.path, d.name) for d in report.devices]),
        (
            "measured",
            ("stream", "samples", "rate [Hz]", "jitter [ms]", "longest gap [ms]"),
            [
                (t.name, str(t.count), _number(t.rate_hz, 1), _number(t.jitter_ms, 2), _number(t.longest_gap_ms, 1))
                for t in report.timings
            ],
        ),
    ):
        if rows:
            table = Table(title=title)
            for k, column in enumerate(columns):
                table.add_column(column, justify="right" if title == "measured" and k else "left")
            for row in rows:
                table.add_row(*row)
            console.print(table)
    _print_findings(report.findings)


def _print_findings(findings: Sequence[Finding]) -> None:
    from rich.console import Console

    console = Console()
    styles = {"ok": "green", "warning": "yellow", "error": "red"}
    for finding in findings:
        console.print(f"{finding.severity:<8}", style=styles[finding.severity], end="")
        console.print(f"{finding.what} ({finding.where})", soft_wrap=True, highlight=False, markup=False)
        if finding.next_step:
            console.print(f"        -> {finding.next_step}", soft_wrap=True, highlight=False, markup=False)


def _print_inspection(inspection: Inspection) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    size = f"{inspection.duration_s:.1f} s, {inspection.size_bytes / 1e6:.1f} MB"
    console.print(f"{inspection.source}: {inspection.format}, {size}", soft_wrap=True)
    table = Table()
    for title in ("stream", "count", "rate [Hz]", "longest gap [s]"):
        table.add_column(title, justify="left" if title == "stream" else "right")
    for stream in inspection.streams:
        table.add_row(stream.name, str(stream.count), f"{stream.rate_hz:.1f}", f"{stream.longest_gap_s:.3f}")
    console.print(table)
    _print_findings(inspection.findings)


def _compare(arguments: list[str]) -> int:
    from vislam.experiment.compare import run_comparison
    from vislam.options import CompareOptions

    options = _parse(CompareOptions, arguments, "compare")
    with _progress(options.plan.stem, "jobs") as progress:
        answer = run_comparison(options, ["vislam", "compare", *arguments], progress)
    print(json.dumps(answer.data) if options.json else "\n".join(answer.lines))
    return answer.exit_code


def _optimize(arguments: list[str]) -> int:
    sessions = [a for a in arguments if (Path(a) / "session.db").is_file() or Path(a).name == "session.db"]
    if len(sessions) > 1 or (sessions and any(a.partition("=")[0] == "--out" for a in arguments)):
        return _join_sessions(arguments)
    if any(Path(argument).is_file() or argument.endswith(".g2o") for argument in arguments):
        return _optimize_graph(arguments)
    from vislam.optimize import optimize
    from vislam.options import OptimizeOptions
    from vislam.report import write_report

    options = _parse(OptimizeOptions, arguments, "optimize")
    entry = optimize(options.run, options.settings, options.out_name)
    write_report(options.run)
    if options.json:
        print(json.dumps(entry))
        return 0
    loops = entry["loops"]
    print(
        f"{entry['keyframes']} keyframes, {entry['landmarks']} landmarks, {entry['observations']} observations "
        f"({entry['rejected_observations']} refused), {loops['kept']} of {loops['offered']} loops; "
        f"cost {entry['cost_before']:.6g} -> {entry['cost_after']:.6g} in {entry['iterations']} steps, "
        f"{entry['wall_s']:.1f} s"
    )
    for warning in entry["warnings"]:
        print(f"warning: {warning}")
    if entry["accuracy"]:
        _print_evaluation({f"{options.out_name} ({mode})": entry["accuracy"][mode] for mode in entry["accuracy"]})
    print(f"trajectory: {options.run / f'trajectory_{options.out_name}.tum'}")
    return 0


def _join_sessions(arguments: list[str]) -> int:
    from vislam.join_sessions import join_sessions, write_joined
    from vislam.options import JoinOptions
    from vislam.report.graph_page import write_graph_report

    options = _parse(JoinOptions, arguments, "optimize")
    with _progress("loops between sessions", "keyframes") as bar:
        joined = join_sessions(options.sessions, progress=bar)
    write_joined(joined, options.out)
    if options.report:
        write_graph_report(joined.problem, joined.solution, " + ".join(joined.names), options.out / "report.html")
    summary = joined.summary
    if options.json:
        print(json.dumps(summary))
    else:
        print(
            f"{len(joined.names)} sessions, {summary['poses']} keyframes; {summary['loops_kept']} of "
            f"{summary['loops_between']} loops between them kept; chi2 {summary['chi2_after']:.6g}"
        )
        for warning in summary["warnings"]:
            print(f"warning: {warning}")
        print(f"results: {options.out}")
    return 0 if summary["converged"] else TrackingLostError.exit_code


def _optimize_graph(arguments: list[str]) -> int:
    from vislam.optimize_graph import optimize_graph_file
    from vislam.options import OptimizeGraphOptions
    from vislam.report.graph_page import write_graph_report

    options = _parse(OptimizeGraphOptions, arguments, "optimize")
    out = options.out or Path(f"{options.file.stem}_optimized")
    limit = options.settings.iterations
    with _progress(options.file.stem, "iterations") as bar:
        show = None if bar is None else (lambda done, chi2: bar(done, limit, f"chi2 {chi2:.6g}"))
        result = optimize_graph_file(options.file, out, options.settings, show)
    if options.report:
        write_graph_report(result.problem, result.solution, options.file.stem, out / "report.html", result.certificate)
    summary = result.summary
    if options.json:
        print(json.dumps(summary))
    else:
        print(
            f"{summary['poses']} poses, {summary['edges']} edges ({len(summary['rejected'])} found false); chi2 "
            f"{summary['chi2_before']:.9g} ({summary['start']} start) -> {summary['chi2_after']:.9g} in "
            f"{summary['iterations']} iterations, {summary['solve_s']:.3f} s"
        )
        if result.certificate is not None:
            print(result.certificate.text)
        for warning in summary["warnings"]:
            print(f"warning: {warning}")
        print(f"results: {out}")
    return 0 if summary["converged"] else TrackingLostError.exit_code


def _map(arguments: list[str]) -> int:
    from vislam.config import MapConfig
    from vislam.mapping.describe import describe_octree, describe_place
    from vislam.mapping.octomap_io import read_octree
    from vislam.options import MapOptions, map_options
    from vislam.rebuild import map_settings

    run = next((Path(argument) for argument in arguments if Path(argument).is_dir()), None)
    base = MapConfig() if run is None or "--help" in arguments else map_settings(run).map
    options = _parse(MapOptions, arguments, "map", map_options(base))
    if options.source.is_dir():
        return _rebuild(options)
    octree = read_octree(options.source)
    answer: dict[str, Any] = {}
    if options.info or options.query is None:
        answer |= describe_octree(octree)
    if options.query is not None:
        answer |= describe_place(octree, options.query, options.level, options.window_m)
    print(json.dumps(answer) if options.json else "\n".join(f"{name}: {value}" for name, value in answer.items()))
    return 0


def _loops(arguments: list[str]) -> int:
    from vislam.loop_undo import change_loops, list_loops
    from vislam.options import LoopsOptions
    from vislam.report import write_report

    options = _parse(LoopsOptions, arguments, "loops")
    if not (options.undo or options.redo):
        loops = list_loops(options.run)
        if options.json:
            print(json.dumps(loops))
        else:
            _print_edges(loops)
        return 0
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


def _print_edges(loops: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for title in ("id", "from", "to", "decision", "chi2", "weight", "reason"):
        table.add_column(title, justify="left" if title in ("decision", "reason") else "right")
    for loop in loops:
        ends = [str(loop[name]) for name in ("id", "from", "to")]
        table.add_row(*ends, loop["decision"], _number(loop["chi2"], 1), _number(loop["weight"], 2), loop["reason"])
    Console().print(table)


def _rebuild(options: MapOptions) -> int:
    """Make the maps of a run again."""
    from vislam.rebuild import rebuild
    from vislam.report import write_report

    with _progress(options.source.name, "steps") as progress:
        answer = rebuild(options.source, options.settings, options.out, options.poses, progress)
    if options.out is None:
        write_report(options.source)
    if options.json:
        print(json.dumps(answer))
        return 0
    print(f"{answer['keyframes']} keyframes, depth from the {answer['depth']}, poses of {answer['poses']}")
    for name, path in answer["written"].items():
        print(f"{name}: {path}")
    for name, reason in answer["left_out"].items():
        print(f"warning: no {name}: {reason}")
    return 0


def _vocabulary(arguments: list[str]) -> int:
    from vislam.loop.orbslam import read_orbslam
    from vislam.options import VocabularyOptions
    from vislam.train_vocabulary import train_vocabulary

    options = _parse(VocabularyOptions, arguments, "vocabulary")
    if (options.from_orbslam is None) != bool(options.sources):
        raise UsageError("give either SOURCE... to train on, or --from-orbslam FILE to convert")
    if options.from_orbslam is not None:
        vocabulary, origin = read_orbslam(options.from_orbslam), str(options.from_orbslam)
    else:
        left_out = ("sources", "out", "from_orbslam")
        choices = {name: value for name, value in asdict(options).items() if name not in left_out}
        vocabulary, images, unreadable = train_vocabulary(options.sources, **choices)
        origin = f"{images} images" + (f" ({unreadable} could not be read)" if unreadable else "")
    vocabulary.save(options.out)
    print(f"{vocabulary.word_count} words from {origin}; next: vislam run ... --loop.vocabulary {options.out}")
    return 0


def _calibrate(arguments: list[str]) -> int:
    import tyro

    from vislam.calibration.kinds import KINDS
    from vislam.runfolder import plain

    if not arguments or arguments[0] in ("-h", "--help"):
        lines = [f"  {name:<12}{kind.summary}" for name, kind in KINDS.items()]
        usage = "usage: vislam calibrate WHAT ...; vislam calibrate WHAT --help tells more"
        print("\n".join([usage, "", *lines]))
        return 0 if arguments else UsageError.exit_code
    kind = KINDS.get(arguments[0])
    if kind is None:
        raise UsageError(f"nothing called '{arguments[0]}' to calibrate; there are: {', '.join(KINDS)}")
    prog = f"vislam calibrate {arguments[0]}"
    options = tyro.cli(kind.options, prog=prog, description=kind.summary, args=arguments[1:])
    outcome = kind.calibrate(options)
    print(json.dumps(plain(outcome.report)) if options.json else "\n".join([*outcome.lines, *map(str, outcome.files)]))
    return 0


def _record(arguments: list[str]) -> int:
    from vislam.config import load_sensors
    from vislam.options import RecordOptions, record_options
    from vislam.record import Recorded, record

    config_path = _take_option(arguments, "--config")
    base = load_sensors(Path(config_path) if config_path else None)
    options = _parse(RecordOptions, arguments, "record", record_options(base))

    def progress(recorded: Recorded) -> None:
        if sys.stderr.isatty():
            print(f"\r{recorded.line()}\033[K", end="", file=sys.stderr)

    with _stopped_by_signals() as stop:
        recorded = record(
            options.out, options.imu, options.camera, options.sensors, options.settings, options.seconds,
            not options.full_speed, stop, progress,
        )  # fmt: skip
    if sys.stderr.isatty():
        print(file=sys.stderr)
    if options.json:
        print((options.out / "recording.json").read_text(encoding="utf-8"), end="")
        return 0
    print(recorded.line())
    for note in (*recorded.notes, recorded.ended):
        print(note)
    print(f"next: vislam doctor {options.out}")
    return 0


@contextmanager
def _stopped_by_signals() -> Iterator[threading.Event]:
    """Give an event that Ctrl-C and SIGTERM set; a second Ctrl-C interrupts as usual."""
    stop = threading.Event()

    def ask(number: int, frame: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _live(arguments: list[str]) -> int:
    from vislam.config import load, load_sensors
    from vislam.live.run_live import LiveRun
    from vislam.live.sensors import open_live
    from vislam.live.status import status_line
    from vislam.options import LiveOptions, live_options
    from vislam.runfolder import prepare

    command = ["vislam", "live", *arguments]
    config_path, sensors_path = (_take_option(arguments, name) for name in ("--config", "--sensors"))
    base = load(Path(config_path) if config_path else None)
    sensors = load_sensors(Path(sensors_path) if sensors_path else None)
    options = _parse(LiveOptions, arguments, "live", live_options(base, sensors))
    source, settings = open_live(options.source, options.settings, options.sensors)
    prepare(options.out, options.overwrite)

    def show(run: LiveRun) -> None:
        if sys.stderr.isatty():
            print(f"\r{status_line(run)}\033[K", end="", file=sys.stderr)

    with _written_up(options.out):
        live = LiveRun(source, settings, options.out, options.source, command)
        try:
            metrics = live.execute(show, source.duration_s if options.seconds is None else options.seconds)
        finally:
            if sys.stderr.isatty():
                print(file=sys.stderr)
    _show(metrics, options.out, options.json)
    return 0


def _report(arguments: list[str]) -> int:
    from vislam.options import ReportOptions
    from vislam.report import write_report

    options = _parse(ReportOptions, arguments, "report")
    print(write_report(options.run))
    return 0


_VERBS = {
    "demo": _Verb(_demo, "simulate a cart in a workshop and run everything on it", "vislam demo"),
    "run": _Verb(
        _run, "run the pipeline on a recording; --resume RUN goes on with one", "vislam run tum:PATH --out runs/desk"
    ),
    "simulate": _Verb(
        _simulate,
        "record a simulated world, or with --graph make a pose graph",
        "vislam simulate corridor-loop --out recordings/corridor",
    ),
    "eval": _Verb(_eval, "compare a trajectory with the truth", "vislam eval runs/desk"),
    "compare": _Verb(_compare, "compare estimators as a plan says", "vislam compare experiments/ekf_vs_graph.toml"),
    "doctor": _Verb(
        _doctor,
        "say what is wrong with a recording, or with the sensors of this machine",
        "vislam doctor euroc:PATH; vislam doctor --i2c /dev/i2c-1 --camera 0",
    ),
    "optimize": _Verb(
        _optimize,
        "estimate a run again in batch, optimise a pose-graph file, or join sessions",
        "vislam optimize runs/desk",
    ),
    "map": _Verb(
        _map,
        "make the maps of a run again, or say what an OctoMap file holds",
        "vislam map runs/desk --resolution-m 0.02 --products cloud octomap mesh",
    ),
    "loops": _Verb(_loops, "list the loop edges of a run, or undo some", "vislam loops runs/desk --undo 7"),
    "vocabulary": _Verb(
        _vocabulary,
        "train the words of loop closing on images, or convert ORB-SLAM's",
        "vislam vocabulary images/ tum:PATH --out words.npz",
    ),
    "calibrate": _Verb(
        _calibrate,
        "find what camera, IMU, magnetometer and floor are like; each WHAT has its --help",
        "vislam calibrate noise recordings/still --out calibration",
    ),
    "record": _Verb(
        _record,
        "record the cart's IMU and camera",
        "vislam record --out recordings/ride --imu serial:/dev/ttyUSB0 --camera 0",
    ),
    "live": _Verb(
        _live,
        "run the pipeline on live sensors and publish the pose",
        "vislam live --source virtual-cart --out runs/cart",
    ),
    "report": _Verb(_report, "write report.html of a run again", "vislam report runs/desk"),
}
