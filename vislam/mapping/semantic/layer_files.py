"""The labels of a map as files: `labels.ply`, a point per voxel, and `labels.json`, classes and things."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import write_json
from vislam.core.reading import read_json
from vislam.mapping.file_names import CLASSES_NAME, VOXELS_NAME
from vislam.mapping.formats.ply import read_ply_rows, write_ply
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.layer import LabelLayer
from vislam.mapping.semantic.votes import voxel_keys

_MAX_JSON_BYTES = 64 * 2**20


def write_layer(folder: Path, layer: LabelLayer) -> None:
    """Write both files; raises StorageError when that fails."""
    extra: dict[str, NDArray[Any]] = {
        "label": layer.labels,
        "votes": layer.votes,
        "total": layer.total,
        "thing": layer.thing_of,
    }
    write_ply(folder / VOXELS_NAME, layer.points_m, layer.colors, extra=extra)
    write_json(folder / CLASSES_NAME, layer.describe())


def read_layer(folder: Path) -> LabelLayer:
    """Return the labels of the map in a folder; raises DataError when there are none, or they are damaged."""
    path = folder / CLASSES_NAME
    try:
        data = read_json(path, _MAX_JSON_BYTES)
    except FileNotFoundError as error:
        raise DataError(
            f"{path} is not there: the map has no labels; give label images by `vislam map RUN --labels.folder FOLDER`"
        ) from error
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise DataError(f"{path} is damaged ({error}); make it again by `vislam map RUN`") from error
    if not isinstance(data, dict):
        raise DataError(f"{path} is damaged: it is no table; make it again by `vislam map RUN`")
    resolution_m, least = _positive(data, "resolution_m", path), int(_positive(data, "least_voxels", path))
    classes = LabelClasses.of(data.get("names"), str(path))
    return _voxels(folder / VOXELS_NAME, resolution_m, classes, least)


def _positive(data: Mapping[str, Any], name: str, path: Path) -> float:
    value = data.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < 1e9:
        raise DataError(f"{path} is damaged: {name} is {value!r}; make it again by `vislam map RUN`")
    return float(value)


def _voxels(path: Path, resolution_m: float, classes: LabelClasses, least: int) -> LabelLayer:
    rows = read_ply_rows(path)
    names = set(rows.dtype.names or ())
    if not {"label", "votes", "total"} <= names:
        raise DataError(f"{path} has no label, votes and total of its voxels; make it again by `vislam map RUN`")
    keys = voxel_keys(np.stack([rows[name] for name in ("x", "y", "z")], axis=1), resolution_m)
    labels = rows["label"].astype(np.int64)
    votes, total = rows["votes"].astype(np.int64), rows["total"].astype(np.int64)
    sound = (np.diff(keys) > 0).all() and (keys >= 0).all() and ((labels > 0) & (labels <= 65535)).all()
    if not sound or not ((votes > 0) & (votes <= total)).all():
        raise DataError(f"{path} is damaged: its voxels are not those of a map; make it again by `vislam map RUN`")
    return LabelLayer(
        resolution_m, classes, keys, labels.astype(np.uint16), votes.astype(np.int32), total.astype(np.int32), least
    )
