"""The files of a map: which there are, what they are called, and how each is written."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.core.errors import DataError
from vislam.core.files import replacing, storage
from vislam.core.kinds import Kinds, lacking
from vislam.mapping.cloud.cloud import Cloud
from vislam.mapping.cloud.mesh import Mesh, poisson_mesh
from vislam.mapping.cloud.surfels import Surfels
from vislam.mapping.drive.grid import write_grid
from vislam.mapping.file_names import CLASSES_NAME, FILES, NEEDS_UP, VOXELS_NAME
from vislam.mapping.formats.gaussians import write_gaussians
from vislam.mapping.formats.mesh_files import write_glb, write_obj
from vislam.mapping.formats.pcd import write_pcd
from vislam.mapping.formats.ply import write_ply
from vislam.mapping.mesh.atlas import textured
from vislam.mapping.octree import encode_bt, encode_ot
from vislam.mapping.semantic.layer import LabelLayer
from vislam.mapping.semantic.layer_files import write_layer

if TYPE_CHECKING:
    from vislam.mapping.mapper import Mapper

_NO_SURFELS = "no surface was seen with dense depth by enough keyframes"


class MapProduct(Protocol):
    """A product that a package brings."""

    FILE: str  # its name in the folder

    def write(self, path: Path, source: Mapper) -> str | None:
        """Write it; return the reason where there is none."""


PRODUCTS = Kinds[MapProduct]("vislam.map_products", {}, lacking("FILE", "write"))


def write_products(
    source: Mapper, folder: Path, config: MapConfig, step: Callable[[str], None] | None = None,
    not_level: str | None = None,
) -> tuple[dict[str, Path], dict[str, str]]:  # fmt: skip
    """Write the configured products into a folder; return the files, and the reasons why some are missing.

    Labels are written where the map has some.

    Where z of the map may not be up, `not_level` is the reason: products that need it are removed and not written.
    `step` is called with each configured product before it is made.

    Raises StorageError when one cannot be written.
    """
    with storage(folder):
        folder.mkdir(parents=True, exist_ok=True)
    cloud, mesh, surfels = cache(source.cloud), cache(source.mesh), cache(source.surfels)
    labels = source.labels()
    in_colors = config.labels.cloud_colors
    writers: dict[str, Callable[[Path], object]] = {  # a text is the reason why nothing was written
        "cloud": lambda path: _write_cloud(path, cloud(), labels, in_colors),
        "pcd": lambda path: write_pcd(path, cloud().points_m, cloud().colors),
        "octomap": lambda path: _write_octree(path, encode_bt(source.occupancy.max_likelihood_leaves())),
        "ot": lambda path: _write_octree(path, encode_ot(source.coloured_octree())),
        "grid": lambda _: write_grid(folder, source.grid()),
        "drive": lambda _: write_grid(folder, source.drive().navigation_grid(), "drive"),
        "glb": lambda path: _write_glb(path, *mesh(), source, config.mesh_atlas_px),
        "surfels": lambda path: _write_surfels(path, surfels(), labels, in_colors),
        "splats": lambda path: _write_splats(path, surfels(), config.surfel_m),
        "poisson": lambda path: _write_mesh(path, *poisson_mesh(surfels(), config.poisson_depth)),
    }
    if labels is not None:
        writers["labels"] = lambda _: write_layer(folder, labels)
    else:
        _remove_labels(folder)
    written: dict[str, Path] = {}
    notes: dict[str, str] = {}
    for product in (*dict.fromkeys(config.products), *(() if labels is None else ("labels",))):
        if step is not None and product in config.products:
            step(product)
        own = None if product in FILES else PRODUCTS[product]
        path = folder / (FILES[product] if own is None else own.FILE)
        if own is not None:
            writers[product] = partial(own.write, source=source)
        if not_level is not None and product in NEEDS_UP:
            notes[product] = not_level
            _remove_grid(folder, product)
            continue
        try:
            reason = writers[product](path) if product in writers else _write_mesh(path, *mesh())
        except DataError as error:  # too large for a grid, say; the other products are none the worse
            reason = str(error)
        if isinstance(reason, str):
            notes[product] = reason
        else:
            written[product] = path
            if path.suffix == ".pgm":
                written[f"{product}_yaml"] = path.with_suffix(".yaml")
    return written, notes


def remove_products(folder: Path) -> None:
    """Remove the files of a map, and its folder if nothing else is in it."""
    for name in FILES.values():
        (folder / name).unlink(missing_ok=True)
    for product in NEEDS_UP:
        _remove_grid(folder, product)
    _remove_labels(folder)
    with suppress(OSError):
        folder.rmdir()


def _remove_grid(folder: Path, product: str) -> None:
    for name in (FILES[product], f"{product}.yaml"):
        (folder / name).unlink(missing_ok=True)


def _remove_labels(folder: Path) -> None:
    for name in (VOXELS_NAME, CLASSES_NAME):
        (folder / name).unlink(missing_ok=True)


def _write_cloud(path: Path, cloud: Cloud, layer: LabelLayer | None, in_colors: bool) -> None:
    """Write a cloud as a PLY, with the label of each point's voxel where there are labels."""
    if layer is None:
        write_ply(path, cloud.points_m, cloud.colors)
        return
    labels = layer.label_at(cloud.points_m)
    write_ply(path, cloud.points_m, layer.colors_of(labels) if in_colors else cloud.colors, extra={"label": labels})


def _write_octree(path: Path, content: bytes) -> None:
    with replacing(path) as file:
        file.write(content)


def _write_surfels(path: Path, surfels: Surfels, layer: LabelLayer | None, in_colors: bool) -> str | None:
    """Write surfels as a PLY; return the reason if there are none."""
    if len(surfels) == 0:
        return _NO_SURFELS
    normals = dict(zip(("nx", "ny", "nz"), surfels.normals.T, strict=True))
    extra: dict[str, NDArray[Any]] = {**normals, "radius": surfels.radius_m, "confidence": surfels.confidence}
    colors = surfels.colors
    if layer is not None:
        extra |= {"label": surfels.labels, "votes": surfels.label_votes, "total": surfels.label_total}
        colors = layer.colors_of(surfels.labels) if in_colors else colors
    write_ply(path, surfels.points_m, colors, extra=extra)
    return None


def _write_splats(path: Path, surfels: Surfels, spacing_m: float) -> str | None:
    """Write surfels as Gaussians; return the reason if there are none."""
    if len(surfels) == 0:
        return _NO_SURFELS
    write_gaussians(path, surfels, spacing_m)
    return None


def _write_mesh(path: Path, mesh: Mesh | None, reason: str) -> str | None:
    """Write a mesh in the format that the name asks for; return the reason if there is none."""
    if mesh is None:
        return reason
    if path.suffix == ".obj":
        write_obj(path, mesh)
    else:
        write_ply(path, mesh.points_m, mesh.colors, mesh.triangles, filled=mesh.filled)
    return None


def _write_glb(path: Path, mesh: Mesh | None, reason: str, source: Mapper, atlas_px: int) -> str | None:
    """Write a mesh as glTF, with pictures on it if they may take any pixels; return the reason if there is none."""
    if mesh is None:
        return reason
    write_glb(path, mesh, textured(mesh, source.posed_views, atlas_px) if atlas_px else None)
    return None
