"""What a live run goes on from: the map of another session, or what it was itself when it ended."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

from vislam.config import Config
from vislam.core.errors import DataError, UsageError
from vislam.core.memory import SlamMemory
from vislam.core.messages import Array
from vislam.core.recording import Recording
from vislam.runs.folder import MapChoice
from vislam.runs.session import Session, has_begun, recall


@dataclass(frozen=True, slots=True)
class Beginning:
    """An earlier session as each process has to know of it; who needs more reads the file."""

    session: Path
    is_own: bool  # the run is resumed: what comes is written into the same session
    first_id: int  # of the new keyframes
    next_track_id: int
    held: int  # keyframes that are not to move
    T_guess: Array | None = None  # [4, 4] where the body is assumed to be in the map, if a pose was given


def in_map(base: MapChoice, recording: Recording, config: Config) -> Beginning:
    """Return the beginning in a map; raises UsageError when the sensors cannot go on in it, DataError without one."""
    from vislam.runs import imu_noise, map_of  # whole runs, which the processes that get a beginning need not load

    with Session(base.session) as stored:
        noise = imu_noise(config.imu, recording.imu_noise)
        return _of(map_of(stored, recording, config, noise, base.localize_only), base.session, is_own=False)


def resumed(out: Path, recording: Recording, config: Config) -> Beginning | None:
    """Return the beginning of a run that goes on in its folder; None where it had nothing yet to go on from.

    Raises UsageError when its sensors are others now or none of them recognises a place, or the machine was restarted,
    DataError when its session is damaged.
    """
    from vislam.runs import check_fits, imu_noise

    path = out / "session.db"
    if not has_begun(path):
        return None
    if recording.rig.is_blind:
        raise UsageError(
            f"{out} was recorded without a camera, and no place tells where the cart is now; start a new run: vislam "
            "live --out NEW"
        )
    with Session(path) as stored:
        memory = recall(stored)
        if memory is None:
            return None
        check_fits(stored, recording, config, imu_noise(config.imu, recording.imu_noise))
    if memory.front.t_ns >= time.monotonic_ns():
        raise UsageError(
            f"the machine was restarted since {out} was recorded, and its clock begins again; start a new run in "
            f"that map: vislam live --map {out} --out NEW"
        )
    return _of(memory, path, is_own=True)


def recalled(beginning: Beginning) -> SlamMemory:
    """Read what a process needs of the session."""
    with Session(beginning.session) as stored:
        memory = recall(stored)
    if memory is None:
        raise DataError(f"{beginning.session} was changed while the run began; start it again")
    return replace(memory, held=beginning.held, map_keyframes=beginning.first_id, T_guess=beginning.T_guess)


def _of(memory: SlamMemory, session: Path, is_own: bool) -> Beginning:
    front = memory.front
    return Beginning(session, is_own, front.keyframe_id + 1, front.learned.next_track_id, memory.held, memory.T_guess)
