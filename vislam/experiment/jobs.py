"""A plan as single runs: each with its labels, its whole configuration and the hash of all that it depends on."""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vislam.config import dump, from_data
from vislam.experiment import commands, programs
from vislam.experiment.identity import environment, sha256_of, source_identity
from vislam.experiment.plan import Estimator, Plan, Scalar, Sequence, nested
from vislam.runs.folder import fingerprint

JITTER = 1e-9  # relative, of gravity, from member to member: far below any sensor, far above rounding


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """One run of the pipeline. Estimators whose configurations are equal share a key, and so the run."""

    key: str  # SHA-256 of the configuration, the data, the code, the packages and the harness
    sequence: str
    variant: tuple[tuple[str, Scalar], ...]  # (axis, value)
    estimator: str
    estimator_index: int  # its place in the plan
    seed: int
    member: int  # 0: gravity as configured
    source: str
    config: dict[str, Any]  # resolved, all of it
    batch: bool  # whether the batch solution is wanted too
    program: str  # that is run in the place of the pipeline, see `programs`; empty: none
    options: dict[str, Scalar]  # of the program
    command: tuple[str, ...]  # that is run in the place of the pipeline, see `commands`; empty: none
    timeout_s: float

    @property
    def label(self) -> str:
        """What a person calls this job."""
        variant = "".join(f" {name}={value}" for name, value in self.variant)
        return f"{self.sequence}{variant} {self.estimator} seed {self.seed} member {self.member}"

    def spec(self) -> dict[str, Any]:
        """Return what a worker needs to know, as plain data."""
        return {
            "key": self.key,
            "source": self.source,
            "config": self.config,
            "batch": self.batch,
            "program": self.program,
            "options": self.options,
            "command": list(self.command),
            "timeout_s": self.timeout_s,
            "environment": environment(),
        }


def expand(plan: Plan) -> list[Job]:
    """Return every job of a plan, in its order. Raises UsageError for a configuration or program that is none."""
    identities: dict[str, str] = {}
    others = [_identity(estimator) for estimator in plan.estimators]
    jobs = []
    for sequence, variant in ((s, v) for s in plan.sequences for v in variants(plan, s.name)):
        source, settings = _conditions(plan, sequence, variant)
        if source not in identities:
            identities[source] = source_identity(source)
        for index, estimator in enumerate(plan.estimators):
            if estimator.sequences and sequence.name not in estimator.sequences:
                continue
            where = f"plan '{plan.name}', sequence '{sequence.name}', estimator '{estimator.name}'"
            varied = _varied(plan, sequence, variant)
            resolved = from_data(nested({**settings, **estimator.config, **varied}, where), where)
            for seed, member in itertools.product(plan.seeds, range(plan.members)):
                config = dump(resolved) | {"seed": seed}
                config["machine"]["gravity_m_s2"] *= 1.0 + member * JITTER
                batch = "batch" in estimator.compared
                files = [fingerprint(Path(name)) for name in config["calibration"].values() if name is not None]
                if (shaking := config["imu"]["vibration"]["recording"]) is not None:
                    files.append(identities.setdefault(shaking, source_identity(shaking)))
                jobs.append(
                    Job(
                        sha256_of([identities[source], files, config, batch, environment(), *others[index]]),
                        sequence.name, variant, estimator.name, index, seed, member,
                        source, config, batch, estimator.program, estimator.options, estimator.command,
                        plan.timeout_s,
                    )
                )  # fmt: skip
    return jobs


def _identity(estimator: Estimator) -> list[Any]:
    """Return what an estimator is that is not the pipeline; nothing for one that is."""
    own = [programs.identity(estimator.program), estimator.options] if estimator.program else []
    return own + commands.identity(estimator.command)


def variants(plan: Plan, sequence: str) -> list[tuple[tuple[str, Scalar], ...]]:
    """Return every combination of what is varied for a sequence, as (axis, value) pairs; one empty one without axes."""
    axes = plan.axes_of(sequence)
    return list(itertools.product(*([(axis.name, value) for value in axis.values] for axis in axes)))


def unique(jobs: list[Job]) -> Iterator[Job]:
    """Yield one job per key."""
    seen = set()
    for job in jobs:
        if job.key not in seen:
            seen.add(job.key)
            yield job


def source_identities(jobs: Iterable[Job]) -> dict[str, str]:
    """Return what every source holds, by sequence and condition."""
    sources = {
        " ".join([job.sequence, *(f"{axis}={value}" for axis, value in job.variant)]): job.source for job in jobs
    }
    held = {source: source_identity(source) for source in set(sources.values())}
    return {name: held[source] for name, source in sources.items()}


def _conditions(plan: Plan, sequence: Sequence, variant: tuple[tuple[str, Scalar], ...]) -> tuple[str, dict[str, Any]]:
    """Return the source with its options, and the settings that do not depend on the estimator."""
    options = dict(sequence.options)
    axes = plan.axes_of(sequence.name)
    options |= {axis.option: value for axis, (_, value) in zip(axes, variant, strict=True) if axis.option}
    source = ",".join([sequence.source, *(f"{name}={value}" for name, value in options.items())])
    return source, {"map.enabled": plan.map, "view.enabled": False, **plan.config, **sequence.config}


def _varied(plan: Plan, sequence: Sequence, variant: tuple[tuple[str, Scalar], ...]) -> dict[str, Scalar]:
    axes = plan.axes_of(sequence.name)
    return {axis.setting: value for axis, (_, value) in zip(axes, variant, strict=True) if axis.setting}
