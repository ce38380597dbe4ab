"""A comparison from plan to report: what is missing runs, all is kept, tables and pictures are written."""

import random
import threading
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from vislam.core.cluster import dask_client
from vislam.core.errors import DataError, TrackingLostError, UsageError
from vislam.core.files import storage, write_json, write_text
from vislam.core.progress import Progress, silent
from vislam.core.reading import parse_toml, read_json
from vislam.core.revision import code_revision
from vislam.experiment import winners
from vislam.experiment.identity import environment
from vislam.experiment.isolated import run_isolated
from vislam.experiment.jobs import Job, expand, source_identities, unique
from vislam.experiment.options import CompareOptions
from vislam.experiment.plan import Plan, load_plan, plan_text
from vislam.experiment.report.exports import latex, runs_csv, summary_csv, tests_csv, winners_csv
from vislam.experiment.report.page import comparison_page
from vislam.experiment.slurm import run_on_slurm
from vislam.experiment.statistics import compare, groups
from vislam.experiment.store import ResultStore
from vislam.experiment.trials import Trial, table_sha256, trials

TESTED = ("ate_m", "rpe_5m_percent")
Outcome = Literal["identical", "within the spread", "differs"]
Rerun = Callable[[Sequence[Job]], dict[str, dict[str, Any]]]  # from jobs to results by key, without the store

_FLOOR_M = 1e-6  # ensembles may agree to the last bit; a micrometre makes no difference
Spec = dict[str, Any]
Result = dict[str, Any]
Finished = Generator[tuple[Spec, Result], None, None]


@dataclass(frozen=True, slots=True)
class Answer:
    """What a comparison has to say."""

    lines: list[str]
    data: dict[str, Any] = field(default_factory=dict)
    exit_code: int = 0  # 4: `verify` found numbers that do not come out again


def run_comparison(options: CompareOptions, command: list[str], progress: Progress = silent) -> Answer:
    """Do what `vislam compare` was asked to.

    Raises:
        UsageError: the plan is wrong, Dask is missing, or code changed while jobs ran.
        DataError, StorageError: recordings, store or output cannot be used.
    """
    _check(options)
    plan = load_plan(options.plan, programs=options.estimator, known=options.peer)
    jobs = expand(plan)
    if options.verify is not None:
        return _verify(options, plan, jobs, progress)
    with ResultStore(options.store) as store:
        if options.dry_run:
            return _listing(jobs, store)
        if options.retry_failed:
            store.forget_failures(job.key for job in jobs)
        new = run_missing(jobs, store, options, progress)
        results = {job.key: result for job in unique(jobs) if (result := store.get(job.key)) is not None}
    out = options.out or Path("results") / plan.name
    return write_results(
        plan, plan_text(options.plan, options.estimator, options.peer), jobs, results, out, command, new
    )


def run_missing(jobs: Sequence[Job], store: ResultStore, options: CompareOptions, progress: Progress = silent) -> int:
    """Run the jobs that have no result yet and keep each as it comes; return how many ran.

    An interrupt loses only what was running. Raises UsageError when a worker had other code or packages.
    """
    wanted = {job.key: job for job in unique(list(jobs))}
    missing = [job for job in wanted.values() if store.status(job.key) is None]
    done, mismatch = len(wanted) - len(missing), ""
    progress(done, len(wanted), "")
    added = 0
    with closing(_engine(missing, options)) as finished:
        for spec, result in finished:
            if result["status"] == "mismatch":
                mismatch = result["reason"]
            elif result["status"] != "stopped":
                added += store.add(spec["key"], wanted[spec["key"]].label, spec, result)
            done += 1
            progress(done, len(wanted), result["status"])
    if mismatch:
        raise UsageError(f"a worker has other code or packages than this process: {mismatch}; results so far are kept")
    return added


def write_results(
    plan: Plan,
    text: str,
    jobs: Sequence[Job],
    results: dict[str, dict[str, Any]],
    out: Path,
    command: list[str],
    new: int,
) -> Answer:
    """Write report.html, the tables and manifest.json into a folder. Raises StorageError."""
    with storage(out):
        out.mkdir(parents=True, exist_ok=True)
    found = trials(plan, jobs, results)
    grouped = groups(found)
    by_metric = {metric: compare(found, metric, plan.pairs == "seed") for metric in TESTED}
    tests = [comparison for comparisons in by_metric.values() for comparison in comparisons]
    overall = [winner for comparisons in by_metric.values() for winner in winners.of_plan(comparisons)]
    ranked = overall + winners.of_sequences(grouped, TESTED[0])
    manifest = _manifest(text, jobs, found, command)
    write_json(out / "manifest.json", manifest)
    write_text(out / "runs.csv", runs_csv(plan, found))
    write_text(out / "summary.csv", summary_csv(plan, grouped))
    write_text(out / "tests.csv", tests_csv(tests))
    write_text(out / "winners.csv", winners_csv(plan, ranked))
    write_text(out / "table.tex", latex(plan, grouped))
    write_text(out / "report.html", comparison_page(plan, grouped, found, tests, ranked, manifest))
    failed = [job for job in unique(list(jobs)) if results.get(job.key, {}).get("status") == "failed"]
    lines = [f"{len(results)} results, {new} of them new, {len(failed)} failed"]
    lines += [f"failed: {job.label}: {results[job.key]['reason'].splitlines()[0]}" for job in failed[:10]]
    lines += [winners.outcome(winner) for winner in overall]
    table = manifest["table_sha256"]
    lines += [f"table: {table}", f"report: {out / 'report.html'}"]
    data = {"out": str(out), "results": len(results), "new": new, "failed": len(failed), "table_sha256": table}
    return Answer(lines, data)


def _check(options: CompareOptions) -> None:
    if options.workers < 1 or options.sample < 0:
        raise UsageError("--workers must be at least 1, --sample at least 0")
    if (options.engine == "dask") != (options.scheduler is not None):
        raise UsageError("--engine dask and --scheduler ADDRESS belong together, as tcp://127.0.0.1:8786")
    if options.sbatch and options.engine != "slurm":
        raise UsageError("--sbatch is for --engine slurm")


def _engine(jobs: Sequence[Job], options: CompareOptions) -> Finished:
    specs = [job.spec() for job in jobs]
    cache, keep = options.cache.resolve(), None if options.keep_runs is None else options.keep_runs.resolve()
    if not specs:
        return
    if options.engine == "slurm":
        yield from run_on_slurm(specs, options.sbatch, cache, keep, options.store.resolve().parent / "slurm")
    elif options.scheduler is not None:
        yield from run_on_dask(specs, options.scheduler, cache, keep)
    else:
        yield from run_locally(specs, options.workers, cache, keep)


def _listing(jobs: Sequence[Job], store: ResultStore) -> Answer:
    states = {job.key: store.status(job.key) or "to do" for job in unique(list(jobs))}
    counts = Counter(states.values())
    lines = [f"{states[job.key]:<7}{job.key[:12]}  {job.label}" for job in jobs]
    lines.append(
        f"{len(jobs)} jobs, {len(states)} different: " + ", ".join(f"{n} {what}" for what, n in counts.items())
    )
    listed = [{"key": job.key, "label": job.label, "state": states[job.key], "source": job.source} for job in jobs]
    return Answer(lines, {"jobs": listed})


def _manifest(text: str, jobs: Sequence[Job], found: Sequence[Trial], command: list[str]) -> dict[str, Any]:
    return {
        "command": command,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "code_revision": code_revision(),
        "environment": environment(),
        "plan_text": text,
        "table_sha256": table_sha256(found),
        "sources": source_identities(jobs),
        "results": [
            {
                "label": trial.job.label,
                "unit": [trial.job.sequence, trial.job.variant, trial.job.estimator, trial.job.seed],
                "output": trial.output,
                "key": trial.job.key,
                "failure": trial.failure,
                "sha256": trial.sha256,
                **trial.values,
            }
            for trial in found
        ],
    }


def _verify(options: CompareOptions, plan: Plan, jobs: Sequence[Job], progress: Progress) -> Answer:
    assert options.verify is not None
    manifest = read_manifest(options.verify)

    def rerun(chosen: Sequence[Job]) -> dict[str, dict[str, Any]]:
        wanted = list(unique(list(chosen)))
        results: dict[str, dict[str, Any]] = {}
        with closing(_engine(wanted, options)) as finished:
            for spec, result in finished:
                if result["status"] in ("mismatch", "stopped"):
                    raise UsageError(f"a job could not be run again: {result['reason']}")
                results[spec["key"]] = result
                progress(len(results), len(wanted), result["status"])
        return results

    text = plan_text(options.plan, options.estimator, options.peer)
    verdicts, remarks = verify(plan, text, jobs, manifest, options.sample, rerun)
    counts = Counter(verdict.outcome for verdict in verdicts)
    lines = [f"remark: {remark}" for remark in remarks]
    lines += [f"{v.outcome}: {v.label} {v.output}" + (f" ({v.detail})" if v.detail else "") for v in verdicts]
    lines.append(f"{len(verdicts)} trajectories: " + ", ".join(f"{n} {outcome}" for outcome, n in counts.items()))
    data = {"verdicts": [asdict(verdict) for verdict in verdicts], "remarks": remarks}
    return Answer(lines, data, TrackingLostError.exit_code if counts["differs"] else 0)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one trajectory when its job ran again."""

    label: str
    output: str
    outcome: Outcome
    detail: str


def read_manifest(path: Path) -> dict[str, Any]:
    """Read the manifest of a comparison, given it or its folder. Raises DataError when it is none."""
    file = path / "manifest.json" if path.is_dir() else path
    try:
        data = read_json(file)
    except (OSError, ValueError) as error:
        raise DataError(f"{file} cannot be read: {error}; give what `vislam compare` wrote") from error
    asked = {"results": list, "plan_text": str}
    if not isinstance(data, dict) or not all(isinstance(data.get(key), kind) for key, kind in asked.items()):
        raise DataError(f"{file} is no manifest of a comparison; give what `vislam compare` wrote")
    return data


def verify(
    plan: Plan, plan_text: str, jobs: Sequence[Job], manifest: dict[str, Any], sample: int, rerun: Rerun
) -> tuple[list[Verdict], list[str]]:
    """Run `sample` jobs of a comparison again (0: all) and return a verdict per trajectory, and remarks.

    The trajectory file with the same SHA-256 is "identical". Else the error has to lie within the range of the
    ensemble that the comparison had, widened by that range on either side.

    Raises:
        UsageError: the manifest is of another plan.
        DataError: the recordings are not those of the comparison.
    """
    if parse_toml(manifest["plan_text"]) != parse_toml(plan_text):
        raise UsageError("the manifest is that of another plan, or the plan was changed since; give the plan it is of")
    for name, identity in source_identities(jobs).items():
        if manifest["sources"].get(name) != identity:
            raise DataError(f"{name}: not the data of the comparison; set VISLAM_DATA to the same recordings")
    recorded = {(entry["label"], entry["output"]): entry for entry in manifest["results"]}
    candidates = [job for job in jobs if any(label == job.label for label, _ in recorded)]
    if not candidates:
        raise DataError("the manifest has no result to verify")
    if 0 < sample < len(candidates):
        candidates = random.Random(manifest["plan_text"]).sample(candidates, sample)  # the same ones every time
    results = rerun(candidates)
    again = trials(plan, candidates, results)
    verdicts = [_judge(trial, recorded) for trial in again if (trial.job.label, trial.output) in recorded]
    return verdicts, _remarks(manifest)


def _judge(trial: Trial, recorded: dict[tuple[str, str], dict[str, Any]]) -> Verdict:
    before = recorded[trial.job.label, trial.output]
    name = (trial.job.label, trial.output)
    if bool(trial.failure) != bool(before["failure"]):
        outcome = f"failed now: {trial.failure}" if trial.failure else f"failed then: {before['failure']}"
        return Verdict(*name, "differs", outcome)
    if trial.failure:
        return Verdict(*name, "identical", "failed then and now")
    if trial.sha256 == before["sha256"]:
        return Verdict(*name, "identical", "")
    ensemble = [
        entry["ate_m"]
        for entry in recorded.values()
        if entry["unit"] == before["unit"] and entry["output"] == trial.output and not entry["failure"]
    ]
    now, then = trial.values["ate_m"], before["ate_m"]
    low, high = min(ensemble), max(ensemble)
    slack = high - low + _FLOOR_M
    outcome = f"ATE {now:.6f} m, then {then:.6f} m, ensemble {low:.6f} to {high:.6f} m"
    return Verdict(*name, "within the spread" if low - slack <= now <= high + slack else "differs", outcome)


def _remarks(manifest: dict[str, Any]) -> list[str]:
    """Return what is different here from where the comparison was made."""
    mine, theirs = environment(), manifest["environment"]
    return [
        f"{name} differs: here {value}, there {theirs.get(name)}"
        for name, value in mine.items()
        if theirs.get(name) != value
    ]


def run_locally(specs: Sequence[Spec], workers: int, cache: Path, keep: Path | None) -> Finished:
    """Yield each job with its result as it is done, in any order; closing the iterator stops what still runs.

    The threads only wait: every job is a process of its own.
    """
    stop = threading.Event()
    kept = None if keep is None else str(keep)
    with ThreadPoolExecutor(workers, thread_name_prefix="job") as pool:
        try:
            futures = {pool.submit(run_isolated, spec, str(cache), kept, stop): spec for spec in specs}
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


def run_on_dask(specs: Sequence[Spec], scheduler: str, cache: Path, keep: Path | None) -> Finished:
    """Yield each job with its result as a Dask worker finishes it; Dask gives the jobs of a lost worker to others.

    Workers need this very version of vislam and the same paths to the recordings. A job that took several workers
    down with it is a failed result. Raises UsageError without Dask or without a scheduler at that address.
    """
    with dask_client(scheduler, 0) as client:
        from distributed import as_completed as finished_first

        kept = None if keep is None else str(keep)
        futures = {
            client.submit(run_isolated, spec, str(cache), kept, key=f"vislam-{spec['key']}", pure=False): spec
            for spec in specs
        }
        try:
            for future in finished_first(list(futures), raise_errors=False):
                yield futures[future], _outcome(future)
        finally:
            client.cancel(list(futures))


def _outcome(future: Any) -> Result:
    if future.status == "finished":
        return dict(future.result())
    if future.status == "cancelled":
        return {"status": "stopped", "reason": "cancelled on the scheduler"}
    return {"status": "failed", "reason": f"crash: {future.exception()!r}", "run": {}, "outputs": {}}
