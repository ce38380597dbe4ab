"""The pictures of a map that the report shows."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import replacing
from vislam.mapping.cloud.cloud import Cloud
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.drive.drive import Drive
from vislam.mapping.formats.ply import read_ply, read_ply_mesh
from vislam.mapping.pictures.picture import Line, render_cloud, render_mesh, render_octree
from vislam.mapping.pictures.plan import render_drive
from vislam.mapping.products import FILES, MapSource

_NEED_UP = ("picture_octree.png", "picture_where_to_drive.png")
_PATH_COLOR = (37, 99, 235)  # the blue that the report gives to the graph


def write_pictures(source: MapSource, folder: Path, path_m: NDArray[np.float64], is_level: bool) -> list[Path]:
    """Write pictures of the map, with the path [N, 3] drawn in; an empty map has none, return what was written.

    Cloud and mesh are those of the folder, if they are there. Where to drive and the octree, coloured by height, are
    only shown of a map that is level, with z up; pictures of them that are there are removed else.
    Raises StorageError when one cannot be written.
    """
    path = [Line(path_m, _PATH_COLOR)]
    octree = source.occupancy.max_likelihood_leaves()
    pictures = {}
    if (folder / FILES["cloud"]).is_file():
        points, colors = read_ply(folder / FILES["cloud"])
        if len(points):
            pictures["picture_cloud.png"] = render_cloud(Cloud(points, colors), path)
    if (folder / FILES["mesh"]).is_file():
        mesh = Mesh(*read_ply_mesh(folder / FILES["mesh"]))
        pictures["picture_mesh.png"] = render_mesh(mesh, path)
    if is_level and len(octree.occupied_voxels()):  # its colours are heights
        pictures["picture_octree.png"] = render_octree(octree, path)
    with suppress(DataError):  # too large a map for a grid: that is said where the grid is written
        drive = source.drive()
        if is_level and (drive.states == Drive.FREE).any():
            pictures["picture_where_to_drive.png"] = render_drive(drive, path)
    if not is_level:
        for name in _NEED_UP:
            (folder / name).unlink(missing_ok=True)
    for name, image in pictures.items():
        with replacing(folder / name) as file:
            file.write(cv2.imencode(".png", image[..., ::-1])[1].tobytes())
    return [folder / name for name in pictures]
