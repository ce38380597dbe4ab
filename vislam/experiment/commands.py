"""Systems that are programs of their own: a command over a recording on disk, which writes its poses as TUM files.

Nothing of them is imported, linked or installed, so their licences stay theirs.
"""

import hashlib
import json
import shutil
import string
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from vislam.config import Config
from vislam.core.errors import UsageError
from vislam.core.messages import Frame
from vislam.core.recording import Recording
from vislam.experiment.peers import driver_identity
from vislam.experiment.programs import ProgramError, setup_of, write_metrics
from vislam.experiment.stated import split_stated
from vislam.runs.cost import per_frame
from vislam.trajectory import read_tum, write_tum

OUTPUTS = ("causal", "final")
_PLACES = ("recording", "mode", "seed", "work", *OUTPUTS)
_SAID = 400  # characters of what a program last said
# a process's peak memory begins with that of who started it, so a small one has to
_METER = """
import json, os, sys
_, status, used = os.wait4(os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ), 0)
usage = {"code": os.waitstatus_to_exitcode(status), "cpu_s": used.ru_utime + used.ru_stime, "peak_kb": used.ru_maxrss}
with open(sys.argv[1], "w") as file:
    json.dump(usage, file)
"""


def outputs_of(command: Sequence[str]) -> tuple[str, ...]:
    """Return which trajectories a command is asked to write."""
    return tuple(name for name in OUTPUTS if name in _places(command))


def check(command: Sequence[str]) -> None:
    """Raise UsageError for a command that cannot be run here."""
    if unknown := sorted(_places(command) - set(_PLACES)):
        raise UsageError(f"{{{unknown[0]}}} means nothing in a command; there are {{{'}, {'.join(_PLACES)}}}")
    if not outputs_of(command):
        raise UsageError(f"'{' '.join(command)}' has nowhere to write: it needs {{causal}} or {{final}}, a TUM file")
    if shutil.which(command[0]) is None:
        raise UsageError(f"there is no program '{command[0]}'; install it first, for vislam does not")


def identity(command: Sequence[str]) -> list[str]:
    """Return what a command is: its words, and the SHA-256 of those that are files."""
    return [driver_identity(word) or _word_identity(word) for word in command]


def _word_identity(word: str) -> str:
    return hashlib.sha256(Path(word).read_bytes()).hexdigest() if Path(word).is_file() else word


def run_command(
    command: Sequence[str], folder: Path, recording: Recording, config: Config, out: Path
) -> dict[str, Any]:
    """Run a command over a recording in `folder`, write truth and metrics beside its trajectories; return the metrics.

    CPU and memory are those of the program and of all that it waited for. `recording` is the same one, for its stamps.
    Raises ProgramError when the program fails or does not write what it was asked for.
    """
    setup = setup_of(recording, config)
    t_ns = [value.t_ns for value in recording.events() if isinstance(value, Frame)]
    if (truth := recording.truth()) is not None:
        write_tum(truth, out / "trajectory_truth.tum")
    files = {name: out / f"trajectory_{name}.tum" for name in OUTPUTS}
    with tempfile.TemporaryDirectory(dir=out) as work:
        places = {"recording": folder, "mode": setup.mode, "seed": setup.seed, "work": work, **files}
        failure, paid = _run([word.format_map(places) for word in command], Path(work))
    wanted = [files[name] for name in outputs_of(command)]
    missing = [path.name for path in wanted if not path.is_file()]
    for path in wanted:
        if path.is_file():
            split_stated(path, out / f"states_{path.stem.removeprefix('trajectory_')}.csv")
    # those known in time come first: what is known in the end does not show when a pose was there
    begins_ns = [int(poses.t_ns[0]) for path in wanted if path.is_file() and len(poses := read_tum(path))]
    cost = {
        **per_frame(paid.cpu_s, len(t_ns), {}),
        "peak_memory_mb": paid.peak_memory_mb,
        "first_pose_s": (begins_ns[0] - t_ns[0]) * 1e-9 if begins_ns and t_ns else None,
        "first_pose_cpu_s": None,
    }
    metrics = write_metrics(out, command[0], setup, t_ns, cost)
    if failure or missing:
        raise ProgramError(f"{command[0]}: {failure or 'wrote no ' + ' and no '.join(missing)}")
    return metrics


class _Paid(NamedTuple):
    cpu_s: float
    peak_memory_mb: float


def _run(command: list[str], work: Path) -> tuple[str, _Paid]:
    """Run a command to its end; return what went wrong, or nothing, and what it used, as Linux counts it."""
    log, usage = work / "said.txt", work / "used.json"
    with log.open("wb") as said:
        meter = [sys.executable, "-I", "-S", "-c", _METER, str(usage), *command]
        subprocess.run(meter, stdin=subprocess.DEVNULL, stdout=said, stderr=said, check=False)
    used = json.loads(usage.read_text(encoding="utf-8"))
    paid = _Paid(used["cpu_s"], used["peak_kb"] / 1024.0)
    if used["code"] == 0:
        return "", paid
    last = log.read_text(encoding="utf-8", errors="replace").strip()[-_SAID:]
    return f"exit code {used['code']}" + (f"; last said: {last}" if last else ""), paid


def _places(command: Sequence[str]) -> set[str]:
    """Return the names in braces."""
    try:
        return {name for word in command for _, name, _, _ in string.Formatter().parse(word) if name is not None}
    except ValueError as error:
        raise UsageError(f"command '{' '.join(command)}': {error}; double a brace that is meant as such") from error
