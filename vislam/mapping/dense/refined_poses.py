"""Refined poses of the keyframes that a map stores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.mapping.cloud.store import KeyframeStore
from vislam.mapping.dense.refine import refined
from vislam.mapping.depth.image import DepthView
from vislam.mapping.mesh.posed import posed_views

_MOST = 1000  # keyframes: 300 kB each, and every two are looked at


def refined_poses(
    store: KeyframeStore, T_map_body: Mapping[int, Array], view: DepthView
) -> tuple[dict[int, Array], dict[str, Any]]:
    """Return the poses of keyframes that fit their depth images to each other, and what was found.

    Args:
        store: with the depth images; keyframes without one keep their poses.
        T_map_body: poses [4, 4] as they are.
        view: of the depth images.

    Returns:
        All poses in the order of ids, empty where they are no gain; pairs and costs, or why it was refused.
    """
    poses = dict(sorted(T_map_body.items()))
    ids = [i for i in poses if (packed := store.packed(i)) is not None and packed.depth_png]
    if len(ids) > _MOST:
        return {}, {"refused": f"{len(ids)} keyframes with depth, more than {_MOST}"}
    found = refined(posed_views(((store.scan(i), poses[i]) for i in ids), view))
    report = {"pairs": found.pairs, "cost_before": found.cost_before, "cost_after": found.cost_after}
    if not found.cost_after < found.cost_before:
        return {}, report
    T_refined = found.T_map_view @ invert(view.T_body_view)
    return poses | dict(zip(ids, T_refined, strict=True)), report
