"""The labels of a map as the interactive view of a report shows them: voxels by class, thinned and quantised."""

from __future__ import annotations

from typing import Any

import numpy as np

from vislam.core.errors import DataError
from vislam.mapping.semantic.layer_files import CLASSES_NAME, read_layer
from vislam.runs.report.page_assets import packed
from vislam.runs.report.run_files import RunFiles
from vislam.runs.report.scene import Scene

MAX_VOXELS = 120_000  # 1 MB of page
_MAX_CLASSES = 16  # with a colour and a switch of their own
_REST = {"name": "all other labels", "color": [128, 128, 128]}


def label_data(run: RunFiles, scene: Scene, most: int = MAX_VOXELS) -> dict[str, Any]:
    """Return classes with their voxels in the scene's frame, the largest first; empty where a map has no labels.

    What cannot be read is left out and named in `run.unread`.
    """
    folder = run.folder / "map"
    if not (folder / CLASSES_NAME).is_file():
        return {}
    try:
        layer = read_layer(folder)
    except DataError as error:
        run.unread[f"map/{CLASSES_NAME}"] = str(error)
        return {}
    if len(layer) == 0:
        return {}
    chosen = np.random.default_rng(0).permutation(len(layer))[:most]
    labels, S = layer.labels[chosen], scene.S_scene_map
    placed = layer.points_m[chosen].astype(np.float64) @ S[:3, :3].T + S[:3, 3]
    low, high = placed.min(axis=0), placed.max(axis=0)
    step = np.maximum(high - low, 1e-6) / 65535.0
    cells = np.rint((placed - low) / step)
    ids, counts = np.unique(labels, return_counts=True)
    order = ids[np.argsort(-counts, kind="stable")].tolist()
    classes = [(_named(layer.classes[i].name, layer.classes[i].color), labels == i) for i in order[:_MAX_CLASSES]]
    if rest := order[_MAX_CLASSES:]:
        classes.append((_REST, np.isin(labels, rest)))
    return {
        "count": len(chosen),
        "of": len(layer),
        "low": low.tolist(),
        "step": step.tolist(),
        "size": layer.resolution_m * float(np.cbrt(abs(np.linalg.det(S[:3, :3])))),
        "classes": [{**named, "xyz": packed(cells[there], "<u2")} for named, there in classes],
    }


def _named(name: str, color: tuple[int, int, int]) -> dict[str, Any]:
    return {"name": name, "color": list(color)}
