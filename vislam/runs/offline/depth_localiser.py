"""The depth of a finished run, for finding a camera in its map again by depth alone: `depth_localiser("runs/flat")`."""

from pathlib import Path

from vislam.core.errors import DataError, UsageError
from vislam.mapping.depth.localise import DepthLocaliser
from vislam.mapping.depth.stored import stored_depth
from vislam.runs.levelled import stored_level
from vislam.runs.offline.rebuild import stored_submaps
from vislam.runs.session import Session


def depth_localiser(run: Path | str) -> DepthLocaliser:
    """Return what finds the run's depth camera in the run's map, from a guess.

    It takes depth images [H, W] in metres, registered to cam0, and poses of the body in `map` as the run's files have
    them. Keyframes of submaps that are not joined with the map are left out.

    Raises:
        DataError: the session is missing, damaged, or holds no depth images.
        UsageError: the run had no depth camera, or made no map.
    """
    with Session(Path(run) / "session.db") as session:
        info, config = session.info(), session.config()
        rig = session.rig()
        if not rig.has_depth or not config.map.enabled:
            raise UsageError(
                f"{run} keeps no depth images: its camera has to measure depth, and `--map.enabled` has to be on"
            )
        submaps, T_level_map = stored_submaps(session), stored_level(info).T_level_map
        poses = {k.id: T_level_map @ k.T_map_body for k in session.keyframes() if submaps.group(k.id) == 0}
        scans = {k: scan for k, scan in session.scans().items() if k in poses}
        localiser, _ = stored_depth(rig, config.map, scans, poses)
    if not len(localiser):
        raise DataError(f"{run} holds no depth image of a keyframe; run the recording again")
    return localiser
