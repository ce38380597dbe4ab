"""Two-dimensional navigation grid from the octree: nav2's and ROS map_server's image with a YAML file beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import replacing
from vislam.core.jit import njit
from vislam.core.reading import parse_yaml, read_bytes, read_text
from vislam.mapping.octree import OctreeLeaves

_OCCUPIED_SHADE, _FREE_SHADE, _UNKNOWN_SHADE = 0, 254, 205  # map_saver's
_MAX_CELLS = 1 << 28
_MAX_DESCRIPTION_BYTES = 1 << 16
_LARGE_SHARE = 0.5  # of the largest horizontal surface: from there on a level may be the floor


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells of a horizontal plane: 1 occupied, 0 free, -1 unknown; row 0 is at the lowest y."""

    cells: NDArray[np.int8]  # [rows, columns]
    resolution_m: float
    origin_m: tuple[float, float]  # x, y of the lower-left corner, in the map frame
    floor_m: float  # height of the floor, in the map frame


def floor_height_m(octree: OctreeLeaves) -> float:
    """Return the height of the lowest large horizontal surface: its voxels' lower side; 0 when nothing is occupied."""
    voxels = octree.occupied_voxels()
    if len(voxels) == 0:
        return 0.0
    lowest = int(voxels[:, 2].min())
    counts = np.bincount(voxels[:, 2] - lowest)
    level = lowest + int(np.flatnonzero(counts >= _LARGE_SHARE * counts.max())[0])
    return level * octree.resolution_m


def navigation_grid(octree: OctreeLeaves, floor_m: float, low_m: float, high_m: float) -> Grid:
    """Return the grid of what lies between `low_m` and `high_m` above the floor.

    A column is occupied when any voxel of the band is, else free when any is free, else unknown. Raises DataError
    when the grid would be larger than any navigation map.
    """
    resolution = octree.resolution_m
    first = int(np.ceil((floor_m + low_m) / resolution - 0.5))  # voxels whose centre lies in the band
    last = int(np.floor((floor_m + high_m) / resolution - 0.5))
    low, size = octree.boxes()
    inside = (low[:, 2] <= last) & (low[:, 2] + size > first)
    low, size, occupied = low[inside], size[inside], octree.log_odds[inside] >= 0.0
    if len(low) == 0:
        return Grid(np.full((1, 1), -1, np.int8), resolution, (0.0, 0.0), floor_m)
    corner = np.array([low[:, 0].min(), low[:, 1].min()])
    shape = np.array([(low[:, 0] + size).max(), (low[:, 1] + size).max()]) - corner
    if float(shape[0]) * float(shape[1]) > _MAX_CELLS:
        raise DataError(f"a grid of {shape.tolist()} cells of {resolution} m is too large; use a coarser resolution")
    cells = np.full((int(shape[1]), int(shape[0])), -1, np.int8)
    for state in (False, True):  # occupied last: it wins
        _fill(cells, low[occupied == state, :2] - corner, size[occupied == state], int(state))
    origin = (float(corner[0] * resolution), float(corner[1] * resolution))
    return Grid(cells, resolution, origin, floor_m)


@njit(cache=True, nogil=True)
def _fill(cells: NDArray[np.int8], low: NDArray[np.int64], size: NDArray[np.int64], value: int) -> None:
    for i in range(len(low)):
        cells[low[i, 1] : low[i, 1] + size[i], low[i, 0] : low[i, 0] + size[i]] = value


def write_grid(folder: Path, grid: Grid, name: str = "grid") -> tuple[Path, Path]:
    """Write `NAME.pgm` and `NAME.yaml` as nav2's map_server reads them; return both paths.

    The image's first row is the highest y. Raises StorageError when they cannot be written.
    """
    shades = np.full(grid.cells.shape, _UNKNOWN_SHADE, np.uint8)
    shades[grid.cells == 0] = _FREE_SHADE
    shades[grid.cells == 1] = _OCCUPIED_SHADE
    image, description = folder / f"{name}.pgm", folder / f"{name}.yaml"
    rows, columns = grid.cells.shape[0], grid.cells.shape[1]
    with replacing(image) as file:
        file.write(f"P5\n# vislam, {grid.resolution_m:g} m per pixel\n{columns} {rows}\n255\n".encode())
        file.write(np.ascontiguousarray(shades[::-1]).tobytes())
    # 0.196 and not nav2's usual 0.25: the unknown shade 205 is (255 - 205) / 255 = 0.19608, and must not pass for free
    text = (
        f"image: {name}.pgm\nmode: trinary\nresolution: {grid.resolution_m:g}\n"
        f"origin: [{grid.origin_m[0]:.6f}, {grid.origin_m[1]:.6f}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    with replacing(description) as file:
        file.write(text.encode())
    return image, description


@dataclass(frozen=True, slots=True, eq=False)
class GridImage:
    """What the files of a grid say: cells as in `Grid`; they know no floor."""

    cells: NDArray[np.int8]  # [rows, columns]
    resolution_m: float
    origin_m: tuple[float, float]


def read_grid(folder: Path, name: str = "grid") -> GridImage:
    """Return what `write_grid` wrote as `NAME.pgm` and `NAME.yaml`; raises DataError when they are something else."""
    image, description = folder / f"{name}.pgm", folder / f"{name}.yaml"
    try:
        described = parse_yaml(read_text(description, _MAX_DESCRIPTION_BYTES))
        resolution, origin = float(described["resolution"]), [float(value) for value in described["origin"]]
        if not (np.isfinite([resolution, *origin]).all() and resolution > 0.0 and len(origin) == 3):
            raise ValueError("resolution or origin cannot be")
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(f"{description} cannot be used: {reason}; `vislam map RUN` writes it again") from error
    try:
        shades = _read_pgm(read_bytes(image, _MAX_CELLS + _MAX_DESCRIPTION_BYTES))
    except (OSError, ValueError) as error:
        raise DataError(f"{image} cannot be used: {error}; `vislam map RUN` writes it again") from error
    cells = np.full(shades.shape, -1, np.int8)
    cells[shades == _FREE_SHADE] = 0
    cells[shades == _OCCUPIED_SHADE] = 1
    return GridImage(cells[::-1], resolution, (origin[0], origin[1]))


def _read_pgm(content: bytes) -> NDArray[np.uint8]:
    """Return the shades [rows, columns] of a binary PGM with one comment, as `write_grid` makes it."""
    magic, comment, size, depth, *rest = content.split(b"\n", 4)
    columns, rows = map(int, size.split())
    if magic != b"P5" or not comment.startswith(b"#") or depth != b"255" or min(columns, rows) < 1:
        raise ValueError("no binary PGM with shades to 255 and one comment")
    if not rest or len(rest[0]) != columns * rows:
        raise ValueError(f"{columns} x {rows} shades are promised, {len(rest[0]) if rest else 0} bytes follow")
    return np.frombuffer(rest[0], np.uint8).reshape(rows, columns)
