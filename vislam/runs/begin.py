"""How a run begins: from nothing, in the map of another session, or where it was killed or interrupted."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import Config, recorded
from vislam.core.errors import DataError, UsageError
from vislam.core.files import storage
from vislam.core.geometry import rotation_from_quaternion_xyzw, transform
from vislam.core.memory import SlamMemory
from vislam.core.messages import Array
from vislam.core.progress import Progress, silent
from vislam.core.recording import Recording, with_camera
from vislam.factors import rig_data
from vislam.imu import ImuNoise
from vislam.mapping.semantic.images import LabelFolder
from vislam.pipeline.settings import derived
from vislam.runs.drive import Run, imu_noise
from vislam.runs.folder import MapChoice, write_setup
from vislam.runs.levelled import stored_up
from vislam.runs.session import Session, SessionWriter, has_begun, recall

_FARTHEST_M = 1e5  # of a pose that a user gives
# settings (map.*) that decide what a keyframe's cloud is; what is made of clouds may be set otherwise in every run
_SHAPING = (
    "min_range_m", "max_range_m", "pixel_step", "edge_px", "speckle_pixels", "stereo_scale",
    "stereo_disparity_sigma_px", "stereo_max_range_m", "stereo_max_sigma_m", "mono_depth",
)  # fmt: skip


def execute(
    recording: Recording,
    config: Config,
    out: Path,
    source: str,
    command: list[str],
    progress: Progress = silent,
    base: MapChoice | None = None,
) -> dict[str, Any]:
    """Run a recording into the prepared folder `out` and return its metrics; see `Run.execute`.

    With `base` it begins in the map of another session, which stays as it is. Raises UsageError when that does not fit.
    """
    return begun(recording, config, out, source, command, base).execute(progress)


def resume(
    recording: Recording,
    config: Config,
    out: Path,
    source: str,
    command: list[str],
    progress: Progress = silent,
    base: MapChoice | None = None,
) -> dict[str, Any]:
    """Go on with the run in `out` after its last stored keyframe and return the metrics of the whole.

    A run that had no keyframe yet, or had not found gravity, begins again, in the map `base` if it began there. Raises
    UsageError when it is finished or `config` is not what it began with, DataError when its session is damaged or the
    recording is another one.
    """
    path = out / "session.db"
    if has_begun(path):
        session = SessionWriter.reopen(path)
        run = Run(recording, config, out, session)
        with Session(path) as stored:
            is_begun = run.resume(stored)
        if is_begun:
            return run.execute(progress)
        session.close()
    with storage(path):
        for name in ("session.db", "session.db-wal", "session.db-shm", "session.db-journal"):
            (out / name).unlink(missing_ok=True)
    return execute(recording, config, out, source, command, progress, base)


def begun(
    recording: Recording,
    config: Config,
    out: Path,
    source: str,
    command: list[str],
    base: MapChoice | None,
    make: Callable[[SessionWriter], Run] | None = None,
) -> Run:
    """Return a run at its beginning, in the map `base` if there is one; see `execute`.

    `make` makes another kind of run of its session.
    """
    noise = imu_noise(config.imu, recording.imu_noise)
    config = derived(config, recording.rig, noise)
    info = {"source": source, "config": asdict(config), **_label_names(config, recording)}
    path = out / "session.db"
    make = make or partial(Run, recording, config, out)
    if base is None:
        write_setup(out, config, source, command)
        return make(SessionWriter.create(path, info, recording.rig, noise, config.machine.gravity_m_s2))
    with Session(base.session) as stored:
        memory = map_of(stored, recording, config, noise, base.localize_only)
        write_setup(out, config, source, command, base)
        up = stored_up(stored.info())
        session = SessionWriter.in_map(path, stored, info, noise, base.localize_only, bool(memory.scans), up)
    run = make(session)
    run.begin_in_map(memory)
    if not memory.scans and config.map.enabled:
        run.warnings.append(
            f"{stored.path} brings no clouds, or of another shape (--map.*): the map holds new ones only"
        )
    return run


def _label_names(config: Config, recording: Recording) -> dict[str, Any]:
    """Return what labels mean, as an entry of a session; nothing where there are no label images.

    Raises DataError when the label images cannot be used.
    """
    folder = config.map.labels.folder
    if folder is None or not config.map.enabled:
        return {}
    return {"labels": LabelFolder(Path(folder), with_camera(recording).rig.cameras[0]).classes.data()}


def map_of(
    stored: Session, recording: Recording, config: Config, noise: ImuNoise | None, is_held: bool = False
) -> SlamMemory:
    """Return the map of a session; raises UsageError when a recording cannot go on in it, DataError without one.

    With `is_held` it is not to change. It is level, if up was found in it: a session of a run without gravity is not.
    """
    check_fits(stored, recording, config, noise)
    memory, up = recall(stored), stored_up(stored.info())
    if memory is None:
        raise DataError(f"{stored.path} holds no map: not one keyframe, or gravity was not found")
    if up is not None:
        memory = memory.turned(up.T_level_map)
    if config.loop.start_in_map is not None and not recording.rig.has_depth:
        raise UsageError(f"--loop.start-in-map is a guess for depth, which {recording.name} does not have")
    count = len(memory.graph.packets)
    T_guess = parse_start(config.loop.start_in_map)
    memory = replace(memory, held=count if is_held else 0, map_keyframes=count, T_guess=T_guess)
    was = recorded(stored.info().get("config") or {}, str(stored.path)).get("map") or {}
    now = json.loads(json.dumps(asdict(config.map)))
    if any(was.get(name) != now[name] for name in _SHAPING):
        return replace(memory, scans={})
    return memory


def parse_start(text: str | None) -> Array | None:
    """Return the pose [4, 4] that `loop.start_in_map` gives in a map. Raises UsageError when it is no pose."""
    if text is None:
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
        if values.shape != (7,) or not np.isfinite(values).all() or np.abs(values[:3]).max() > _FARTHEST_M:
            raise ValueError
        return transform(rotation_from_quaternion_xyzw(values[3:]), values[:3])
    except ValueError:
        raise UsageError(
            f"--loop.start-in-map {text}: give X,Y,Z in metres and QX,QY,QZ,QW of the body in the map, as a line of "
            "its trajectory_graph.tum has them after the stamp"
        ) from None


def check_fits(stored: Session, recording: Recording, config: Config, noise: ImuNoise | None) -> None:
    """Raise UsageError when a recording, with these settings, cannot go on in the map of a session."""
    info = stored.info()
    settings, sensors = info.get("config") or {}, json.loads(json.dumps(rig_data(recording.rig)))
    if recording.rig.is_blind:
        raise UsageError("a run without a camera recognises no place, so it cannot begin in a map: leave --map away")
    if settings.get("frontend", {}).get("mode") == "none":
        raise UsageError(f"{stored.path} was made without a camera and has no places to recognise: leave --map away")
    if settings.get("graph", {}).get("coupling") != "tight" or config.graph.coupling != "tight":
        raise UsageError("a map is made and continued with tight coupling only; use --graph.coupling tight for both")
    if info.get("rig") != sensors:
        raise UsageError(f"{stored.path} was made with other cameras, or another calibration, than {recording.name}")
    if (info.get("imu_noise") is None) != (noise is None):
        raise UsageError(f"{stored.path} and {recording.name} must both have an IMU, or both none")
