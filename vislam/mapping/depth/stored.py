"""The stored scans of a map as what answers where a depth camera is in it."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from vislam.config import MapConfig
from vislam.core.camera import Camera, Rig
from vislam.core.memory import PackedScan
from vislam.core.messages import Array, ImageF32
from vislam.mapping.cloud.store import KeyframeStore
from vislam.mapping.depth.image import rgbd_view
from vislam.mapping.depth.localise import DepthLocaliser


def stored_depth(
    rig: Rig, config: MapConfig, scans: Mapping[int, PackedScan], T_map_body: Mapping[int, Array] | Array
) -> tuple[DepthLocaliser, list[int]]:
    """Return what finds the depth camera of a rig among keyframes of a map, and their ids in the order it has them.

    `T_map_body` gives the pose [4, 4] of each id in `scans`; keyframes without a depth image are left out. Images are
    unpacked when they are needed. Raises DataError for poses that are none; damaged scans are reported when asked for.
    """
    camera, view = rig.cameras[0], rgbd_view(rig, config)
    localiser = DepthLocaliser(camera, rig.T_body_cams[0], _thinned(camera, config.pixel_step))
    store = KeyframeStore(view.size)
    ids = [k for k in sorted(scans) if scans[k].depth_png]
    for k in ids:
        store.put(k, scans[k])
        localiser.add(T_map_body[k], partial(_depth_m, store, k, view.unit_m))
    return localiser, ids


def _depth_m(store: KeyframeStore, keyframe_id: int, unit_m: float) -> ImageF32:
    depth = store.geometry(keyframe_id).depth
    assert depth is not None, "scans without depth were left out"
    return (depth * unit_m).astype(np.float32)


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
