"""Live runs of a replayed recording, what watches over them and ends them, and what they must not leave behind.

The recording is played again from its start each time, as a cart does that was put back to where it began. A run is
ended when it has been found, or has seen enough, however long that takes.
"""

import os
import signal
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import psutil

from vislam.config import Config, SensorsConfig, load
from vislam.core.files import write_json
from vislam.hw.health import Health
from vislam.live.beginning import in_map, resumed
from vislam.live.replay import Outages, ReplaySource
from vislam.live.run_live import LiveRun
from vislam.runs.folder import MapChoice, prepare
from vislam.runs.session import Session

PATIENCE_S = 600.0  # a quiet machine needs a few of them; the recording goes on as long
WORLD = f"points:laps,rig=rgbd,camera_hz=10,tracks=150,duration_s={PATIENCE_S:g}"
FILES = {
    "manifest.json", "config.json", "metrics.json", "tracking.csv", "loops.csv", "retrieved.csv", "session.db",
    "states_ekf.csv", "states_graph.csv", "trajectory_ekf.tum", "trajectory_live.tum", "trajectory_graph.tum",
    "trajectory_truth.tum",
}  # fmt: skip


def settings(name: str = "going-on", *, dense: bool = False, **others: object) -> Config:
    """Settings of a live run without a viewer; `dense`: with a map of voxels, which takes seconds to rehearse."""
    live = {f"live.{key}": value for key, value in {"send_to": (), **others}.items()}
    off = {"view.enabled": False, "map.enabled": dense}
    return load(None, {**off, "live.name": f"vislam-test-{name}-{os.getpid()}", **live})


def begin(
    out: Path, base: MapChoice | None = None, outages: Outages | None = None, *, dense: bool = False,
    name: str = "going-on",
) -> LiveRun:  # fmt: skip
    """Return a run that goes on with what is in a folder, with its settings, or begins in a map, or begins."""
    source, config = ReplaySource(WORLD, outages=outages), settings(name, dense=dense)
    if (out / "session.db").exists():
        with closing(Session(out / "session.db")) as stored:
            config = stored.config()  # another worker may have begun it, under a name of its own
        beginning = resumed(out, source, config)
        assert beginning is not None
    else:
        prepare(out, overwrite=False)
        beginning = None if base is None else in_map(base, source, config)
    write_json(out / "sensors.json", asdict(SensorsConfig()))
    return LiveRun(source, config, out, f"replay:{WORLD}", ["vislam", "live"], base, beginning)


def until(enough: Callable[[LiveRun], bool], act: Callable[[LiveRun], None]) -> Callable[[LiveRun], None]:
    """Return what watches a run and acts once, when it has enough."""
    done: list[bool] = []

    def watch(run: LiveRun) -> None:
        if not done and enough(run):
            done.append(True)
            act(run)

    return watch


def status(run: LiveRun) -> dict:
    """Return the newest status of the fast process."""
    return run.notes.get("fast", {}).get("status", {})


class Notes(dict):
    """Notes of a run that keep each health that the fast process reported, however late this one looks."""

    def __init__(self) -> None:
        super().__init__()
        self.health: list[Health] = []

    def __setitem__(self, role: str, values: dict) -> None:
        if role == "fast" and "status" in values:
            self.health.append(Health(values["status"]["health"]))
        super().__setitem__(role, values)


def has_map(run: LiveRun) -> bool:
    return status(run).get("map_revision", 0) >= 8


def interrupt(run: LiveRun) -> None:
    os.kill(os.getpid(), signal.SIGINT)


def is_of_a_run(process: psutil.Process) -> bool:
    """Whether a process was spawned, or forked from the one that has imported all; not that one itself."""
    words = " ".join(process.cmdline())
    return "spawn_main" in words or ("forkserver" in words and process.ppid() != os.getpid())


def left_behind(name: str = "going-on") -> list[str]:
    """Return processes and shared memory of a run that should have ended."""
    going = [process.name() for process in psutil.Process().children(recursive=True) if is_of_a_run(process)]
    return going + [p.name for p in Path("/dev/shm").glob(f"*vislam-test-{name}-{os.getpid()}*")]
