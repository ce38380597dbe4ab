"""The depth of a finished run, for finding a camera in its map again by depth alone: `depth_localiser("runs/flat")`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.core.memory import PackedScan
from vislam.factors.factor_log import rig_from
from vislam.mapping.cloud.store import KeyframeStore
from vislam.mapping.depth.image import rgbd_view
from vislam.mapping.depth.localise import DepthLocaliser
from vislam.run.levelled import stored_level
from vislam.run.offline.rebuild import stored_submaps
from vislam.run.session import Session


def depth_localiser(run: Path | str) -> DepthLocaliser:
    """Return what finds the run's depth camera in the run's map, from a guess.

    It takes depth images [H, W] in metres, registered to cam0, and poses of the body in `map` as the run's files have
    them. Keyframes of submaps that are not joined with the map are left out.

    Raises:
        DataError: the session is missing, damaged, or holds no depth images.
        UsageError: the run had no depth camera, or made no map.
    """
    session = Session(Path(run) / "session.db")
    try:
        info, config = session.info(), session.config()
        rig = rig_from(info["rig"])
        if not rig.has_depth or not config.map.enabled:
            raise UsageError(
                f"{run} keeps no depth images: its camera has to measure depth, and `--map.enabled` has to be on"
            )
        camera = rig.cameras[0]
        view = rgbd_view(rig, config.map)
        localiser = DepthLocaliser(camera, rig.T_body_cams[0], _thinned(camera, config.map.pixel_step))
        store = KeyframeStore(view.size)
        for i, *row in session.rows("SELECT id, t_ns, depth_png, points, colors FROM scans ORDER BY id"):
            store.put(i, PackedScan(*row))
        T_level_map = stored_level(info).T_level_map
        submaps = stored_submaps(session)
        for keyframe in session.keyframes():
            if keyframe.id not in store or submaps.group(keyframe.id) != 0:
                continue
            depth = store.geometry(keyframe.id).depth
            if depth is not None:
                localiser.add(T_level_map @ keyframe.T_map_body, (depth * view.unit_m).astype(np.float32))
    finally:
        session.close()
    if not len(localiser):
        raise DataError(f"{run} holds no depth image of a keyframe; run the recording again")
    return localiser


def _thinned(camera: Camera, step: int) -> Camera:
    """Return the camera of every `step`-th pixel, as maps keep depth: kept pixel i is pixel i * step."""
    return replace(
        camera,
        width=-(-camera.width // step),
        height=-(-camera.height // step),
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=camera.cx / step,
        cy=camera.cy / step,
        skew_px=camera.skew_px / step,
    )
