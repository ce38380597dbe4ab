"""The pictures of a map that the report shows."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import replacing
from vislam.core.messages import ImageU8
from vislam.mapping.cloud.cloud import Cloud
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.drive.drive_grid import Drive, DriveGrid
from vislam.mapping.file_names import FILES
from vislam.mapping.formats.ply import read_ply, read_ply_mesh
from vislam.mapping.mapper import Mapper
from vislam.mapping.pictures.picture import Line, draw_ends, render_cloud, render_mesh, render_octree

_NEED_UP = ("picture_octree.png", "picture_where_to_drive.png")
_PATH_COLOR = (37, 99, 235)  # the blue that the report gives to the graph
_COLORS = {
    Drive.UNKNOWN: (232, 234, 238), Drive.FREE: (196, 231, 203), Drive.OBSTACLE: (52, 58, 70),
    Drive.LOW: (240, 160, 60), Drive.DROP: (170, 60, 140), Drive.STEEP: (215, 80, 60),
}  # fmt: skip
_CLOSE = (250, 236, 190)  # free ground on which the body would touch something at some heading
_NAMES = {
    Drive.FREE: "can be driven on", Drive.OBSTACLE: "in the way", Drive.LOW: "too low above", Drive.DROP: "drop",
    Drive.STEEP: "too steep", Drive.UNKNOWN: "no ground seen",
}  # fmt: skip
_MARGIN_CELLS = 4
_LEGEND_PX = 34  # height of a line of a picture that is so wide:
_LEGEND_WIDTH_PX = 560
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
_INK = (60, 66, 78)


def render_drive(grid: DriveGrid, lines: Sequence[Line] = (), width_px: int = 1400) -> ImageU8:
    """Return the picture [H, W, 3] RGB of a drive grid with paths drawn in; up is +y, as on a map.

    Ground where the cart has room to turn is green, ground that is nearer to something is yellow; the grid is cut to
    what is known.
    """
    colors = np.array([_COLORS[state] for state in sorted(Drive)], np.uint8)[grid.states - int(Drive.UNKNOWN)]
    close = (grid.states == Drive.FREE) & (grid.clearance_m < grid.turning_radius_m)
    colors[close] = _CLOSE
    first, last = _known(grid, lines)
    shown = colors[first[1] : last[1], first[0] : last[0]][::-1]
    rows, columns = shown.shape[:2]
    scale = max(1, min(width_px // columns, width_px // rows))
    image = np.repeat(np.repeat(shown, scale, axis=0), scale, axis=1)
    left_top = np.array(grid.origin_m) + grid.resolution_m * np.array([first[0], last[1]])
    for line in lines:
        xy = line.points_m[np.isfinite(line.points_m[:, :2]).all(axis=1), :2]
        pixels = (xy - left_top) * [1.0, -1.0] * scale / grid.resolution_m - 0.5
        _draw(image, pixels, line)
    return _with_legend(image, grid, scale)


def _known(grid: DriveGrid, lines: Sequence[Line]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and one past the last column and row of what is known or passed by a line, with a margin."""
    cells = [np.argwhere(grid.states != Drive.UNKNOWN)[:, ::-1]]
    for line in lines:
        rows, columns = grid.cells_at(line.points_m[:, :2])
        cells.append(np.stack([columns, rows], axis=1)[rows >= 0])
    known = np.concatenate(cells)
    shape = np.array(grid.states.shape[::-1])
    if len(known) == 0:
        return np.zeros(2, np.int64), shape
    return np.maximum(known.min(axis=0) - _MARGIN_CELLS, 0), np.minimum(known.max(axis=0) + 1 + _MARGIN_CELLS, shape)


def _draw(image: ImageU8, pixels: NDArray[np.float64], line: Line) -> None:
    """Draw a path with a light border, a ring at its start and a dot at its end."""
    if len(pixels) == 0:
        return
    fixed = np.round(np.clip(pixels, -1e4, 1e5) * 16).astype(np.int32)
    for color, width in (((255, 255, 255), line.width_px + 2.0), (line.color, line.width_px)):
        cv2.polylines(image, [fixed], False, color, max(1, round(width)), cv2.LINE_AA, 4)
    if line.marks_ends:
        draw_ends(image, fixed / 16.0, line)


def _with_legend(image: ImageU8, grid: DriveGrid, scale: int) -> ImageU8:
    """Return the picture with the meaning of its colours and the length of a metre below it.

    The words grow with the picture, so that they can be read where it is shown half a page wide.
    """
    used = [(_COLORS[s], _NAMES[s]) for s in (*_NAMES,) if (grid.states == s).any()]
    used.insert(1, (_CLOSE, f"less than {grid.turning_radius_m:.2f} m to what is in the way"))
    width = max(image.shape[1], _LEGEND_WIDTH_PX)
    zoom = width / _LEGEND_WIDTH_PX

    def px(length: float) -> int:
        return round(length * zoom)

    def write(text: str, x: int, y: int) -> None:
        cv2.putText(out, text, (x, y), _FONT, _FONT_SCALE * zoom, _INK, max(1, px(1)), cv2.LINE_AA)

    lines: list[list[tuple[int, tuple[int, int, int], str]]] = [[]]
    x = px(10)
    for color, name in used:
        needs = px(44) + cv2.getTextSize(name, _FONT, _FONT_SCALE * zoom, max(1, px(1)))[0][0]
        if x + needs > width and lines[-1]:
            lines.append([])
            x = px(10)
        lines[-1].append((x, color, name))
        x += needs
    height = px(_LEGEND_PX)
    out = np.full((image.shape[0] + height * (len(lines) + 1), width, 3), 255, np.uint8)
    out[: image.shape[0], : image.shape[1]] = image
    for k, entries in enumerate(lines):
        y = image.shape[0] + k * height + px(9)
        for x, color, name in entries:
            corner = (x + px(16), y + px(16))
            cv2.rectangle(out, (x, y), corner, color, -1)
            cv2.rectangle(out, (x, y), corner, _INK, max(1, px(1)))
            write(name, x + px(24), y + px(13))
    y, metre = out.shape[0] - height // 2, round(scale / grid.resolution_m)
    cv2.line(out, (px(10), y), (px(10) + metre, y), _INK, px(3))
    write("1 m", px(18) + metre, y + px(5))
    return out


def write_pictures(source: Mapper, folder: Path, path_m: NDArray[np.float64], is_level: bool) -> list[Path]:
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
