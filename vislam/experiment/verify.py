"""Whether the numbers of a comparison come out again: jobs are run again and held against its manifest."""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vislam.core.errors import DataError, UsageError
from vislam.core.reading import parse_toml, read_json
from vislam.experiment.identity import environment
from vislam.experiment.jobs import Job, source_identities
from vislam.experiment.plan import Plan
from vislam.experiment.trials import Trial, trials

Outcome = Literal["identical", "within the spread", "differs"]
Rerun = Callable[[Sequence[Job]], dict[str, dict[str, Any]]]  # from jobs to results by key, without the store

_FLOOR_M = 1e-6  # ensembles may agree to the last bit; a micrometre makes no difference


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
