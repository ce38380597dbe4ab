"""Jobs as an array on a Slurm cluster: a folder that all nodes see holds what is asked, and the answers.

python -m vislam.experiment.slurm FOLDER NUMBER      # what a task of the array runs
"""

import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from vislam.core.errors import StorageError, UsageError
from vislam.core.files import write_json, write_text
from vislam.experiment.isolated import run_isolated

_POLL_S = 2.0
_GRACE_S = 30.0  # that a result may take through the cluster's file system once its task is gone
_ANSWER_S = 60.0
_MARGIN_MIN = 5  # of a task's time beyond its job's
_SAID = 400  # characters of what a task last said
_LARGEST = 1000  # array that clusters take, unless they are configured otherwise

Finished = Generator[tuple[dict[str, Any], dict[str, Any]], None, None]


def run_on_slurm(
    specs: Sequence[dict[str, Any]], options: str, cache: Path, keep: Path | None, folder: Path, poll_s: float = _POLL_S
) -> Finished:
    """Yield each job with its result as its task of an array ends; closing the iterator cancels what is left.

    Nodes need this very version of vislam in this environment, the recordings and `folder` under the same paths.
    `options` go to sbatch, as "--partition=cpu --mem=4G". A task that ends without a result (killed, out of memory) is
    a failed job. Raises UsageError where sbatch is missing or refuses, StorageError where `folder` cannot be written.
    """
    place = _written(specs, options, cache, keep, folder)
    waiting, arrays = dict(enumerate(specs)), list[str]()
    try:
        for script in sorted(place.glob("array*.sh")):
            said = _call(["sbatch", "--parsable", *shlex.split(options), str(script)])
            arrays.append(said.partition(";")[0].strip())
        gone_s: float | None = None
        while waiting:
            for number in [n for n in waiting if (place / f"{n}.result.json").is_file()]:
                result = json.loads((place / f"{number}.result.json").read_text(encoding="utf-8"))
                yield waiting.pop(number), result
            if _runs(arrays):
                gone_s = None
            elif gone_s is None:
                gone_s = time.monotonic()
            elif time.monotonic() - gone_s > _GRACE_S:
                for number, spec in waiting.items():
                    yield spec, _lost(place, number)
                return
            if waiting:
                time.sleep(poll_s)
    finally:
        if waiting and arrays:
            subprocess.run(["scancel", *arrays], capture_output=True, timeout=_ANSWER_S, check=False)


def _written(specs: Sequence[dict[str, Any]], options: str, cache: Path, keep: Path | None, folder: Path) -> Path:
    """Write a request for each job and the scripts of the arrays; return where."""
    minutes = max(int(spec["timeout_s"] // 60) for spec in specs) + _MARGIN_MIN
    try:
        folder.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix="array-", dir=folder))
    except OSError as error:
        raise StorageError(f"{folder} cannot be written: {error}; give another --store, which all nodes see") from error
    for number, spec in enumerate(specs):
        request = {"spec": spec, "cache": str(cache), "keep": None if keep is None else str(keep)}
        write_json(place / f"{number}.json", request)
    for first in range(0, len(specs), _LARGEST):
        size = min(_LARGEST, len(specs) - first)
        write_text(place / f"array{first:06d}.sh", _script(place, options, first, size, minutes))
    return place


def _script(place: Path, options: str, first: int, size: int, minutes: int) -> str:
    """Return the script of an array that runs `size` jobs from number `first` on."""
    command = shlex.join([sys.executable, "-m", "vislam.experiment.slurm", str(place)])
    lines = [
        "#!/bin/sh",
        f"#SBATCH --array=0-{size - 1}",
        "#SBATCH --job-name=vislam",
        "#SBATCH --output=/dev/null",
        *([] if "--time" in options else [f"#SBATCH --time={minutes}"]),
        f"number=$(({first} + SLURM_ARRAY_TASK_ID))",
        f'exec {command} "$number" >{shlex.quote(str(place))}/"$number".log 2>&1',
    ]
    return "\n".join(lines) + "\n"


def _runs(arrays: Sequence[str]) -> bool:
    """Whether a task of an array waits or runs; a scheduler that does not answer just now is no end."""
    try:
        listed = subprocess.run(
            ["squeue", "--noheader", "--jobs", ",".join(arrays), "--format=%i"],
            capture_output=True, text=True, timeout=_ANSWER_S, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return True
    return bool(listed.stdout.strip()) or (listed.returncode != 0 and "Invalid job id" not in listed.stderr)


def _call(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_ANSWER_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UsageError(
            f"--engine slurm needs {command[0]}: {error}; run this on a machine that submits to the cluster"
        ) from error
    if done.returncode != 0:
        raise UsageError(f"{shlex.join(command)} refused: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def _lost(place: Path, number: int) -> dict[str, Any]:
    log = place / f"{number}.log"
    said = log.read_text(encoding="utf-8", errors="replace").strip()[-_SAID:] if log.is_file() else ""
    reason = "crash: the task ended without a result" + (f"; last said: {said}" if said else "")
    return {"status": "failed", "reason": reason, "run": {}, "outputs": {}}


def main() -> None:
    """Answer one task of an array."""
    place, number = Path(sys.argv[1]), sys.argv[2]
    request = json.loads((place / f"{number}.json").read_text(encoding="utf-8"))
    write_json(place / f"{number}.result.json", run_isolated(request["spec"], request["cache"], request["keep"]))


if __name__ == "__main__":
    main()
