"""One job in a process of its own: `python -m vislam.experiment.worker FOLDER`, from request.json to result.json.

Standard input is a pipe that nothing is written to: when it closes, the parent is gone, and the worker ends.
"""

import gc
import json
import os
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

from vislam.config import Config, from_data
from vislam.core.errors import VislamError
from vislam.core.files import write_json
from vislam.experiment import commands
from vislam.experiment.commands import run_command
from vislam.experiment.identity import environment
from vislam.experiment.measures import output_measures, run_measures
from vislam.experiment.programs import run_program
from vislam.experiment.recordings import TimedRecording, on_disk, open_cached
from vislam.runs import execute
from vislam.runs.folder import prepare

_ORPHANED = 70
_MAX_TRACE = 4000  # characters of a traceback that are kept


def run_job(spec: dict[str, Any], folder: Path, cache: Path) -> dict[str, Any]:
    """Run the pipeline by `spec` (see `Job.spec`) into `folder`/run and return the result as plain data.

    Whatever goes wrong is a result too: status "failed" with a reason, beside what could be measured. Status
    "mismatch": this machine has other code or packages than the one that asked.
    """
    if (mine := environment()) != spec["environment"]:
        wrong = [name for name, value in mine.items() if value != spec["environment"].get(name)]
        return {"status": "mismatch", "reason": f"{os.uname().nodename} differs in {', '.join(wrong)}"}
    result: dict[str, Any] = {"status": "ok", "reason": "", "run": {}, "outputs": {}}
    try:
        _run(spec, folder / "run", cache, result)
    except VislamError as error:
        result |= {"status": "failed", "reason": f"{type(error).__name__}: {error}".replace(f"{folder}/", "")}
    except Exception as error:  # a bug of the pipeline is a result of the experiment
        result |= {"status": "failed", "reason": f"bug, {type(error).__name__}: {error}"}
        result["traceback"] = traceback.format_exc()[-_MAX_TRACE:]
    return result


def _run(spec: dict[str, Any], out: Path, cache: Path, result: dict[str, Any]) -> None:
    config: Config = from_data(spec["config"], "job")
    recording = TimedRecording(open_cached(spec["source"], config.seed, cache, config.calibration))
    prepare(out, overwrite=False)
    try:
        if spec["program"]:
            run_program(spec["program"], spec["options"], recording, config, out, recording.frame_done)
        elif spec["command"]:
            run_command(spec["command"], on_disk(spec["source"], config.seed, cache), recording, config, out)
        else:
            execute(recording, config, out, spec["source"], ["vislam", "compare"], recording.frame_done)
    finally:
        metrics_file = out / "metrics.json"
        if metrics_file.is_file():
            metrics = json.loads(metrics_file.read_text(encoding="utf-8"))
            result["run"] = run_measures(metrics, recording.latencies_s)
            outputs = ["ekf", "live", "graph", *_batch(spec, config, out, result)]
            if spec["program"] or spec["command"]:
                outputs = [*commands.OUTPUTS]
            result["outputs"] = output_measures(out, outputs, metrics, recording.span_ns)


def _batch(spec: dict[str, Any], config: Config, out: Path, result: dict[str, Any]) -> list[str]:
    """Estimate the run again in batch, if that was asked for; time and memory of the run are those without it."""
    if not spec["batch"]:
        return []
    from vislam.runs.offline.optimize_run import optimize

    try:
        optimize(out, config.batch)
    except VislamError as error:  # the other trajectories stay; this one is missing, and that is reported
        result["batch_failure"] = str(error)
    return ["batch"]


def _exit_when_orphaned() -> None:
    while os.read(0, 1):
        pass
    os._exit(_ORPHANED)


def main() -> None:
    """Answer one job."""
    folder = Path(sys.argv[1])
    request = json.loads((folder / "request.json").read_text(encoding="utf-8"))
    threading.Thread(target=_exit_when_orphaned, daemon=True).start()
    write_json(folder / "result.json", run_job(request["spec"], folder, Path(request["cache"])))
    gc.freeze()  # the end of the process looks for garbage among all that is not frozen


if __name__ == "__main__":
    main()
