"""Binary PCD, the Point Cloud Library's format: written in pieces, read with memory bounded by the file's size.

Version 0.7 (https://pointclouds.org/documentation/tutorials/pcd_file_format.html); the colour is packed into one
number, 0x00RRGGBB, in a field `rgb`. Not Open3D's writer: an extra, 141 MB more memory for a million points (ours 0).
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import replacing
from vislam.mapping.formats.ply import chunks, read_rows

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]

_POINT = np.dtype([("xyz", "<f4", 3), ("bgr", "u1", 3), ("none", "u1")])
_MAX_HEADER_LINES = 50
_MAX_LINE_BYTES = 1024
_MAX_FIELDS = 64
_MAX_POINT_BYTES = 4096
_KINDS = {"F": "f", "U": "u", "I": "i"}


def write_pcd(path: Path, points_m: Points, colors: Colors) -> None:
    """Write points [N, 3] with RGB colours [N, 3]; raises StorageError when the file cannot be written."""
    header = (
        "# .PCD v0.7 - vislam, metres in the map frame\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\n"
        f"COUNT 1 1 1 1\nWIDTH {len(points_m)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points_m)}\nDATA binary\n"
    )
    with replacing(path) as file:
        file.write(header.encode())
        for chunk in chunks(len(points_m)):
            rows = np.zeros(chunk.stop - chunk.start, _POINT)
            rows["xyz"], rows["bgr"] = points_m[chunk], colors[chunk][:, ::-1]
            file.write(rows.tobytes())


def read_pcd(path: Path) -> tuple[Points, Colors]:
    """Return points [N, 3] and RGB colours [N, 3] (grey 128 if it has none) of a binary PCD.

    Raises DataError when it is something else or cut short; what a header promises is checked against the file's size
    before memory is taken.
    """
    rows = read_rows(path, _read_header)
    points = np.stack([rows[name] for name in ("x", "y", "z")], axis=1).astype(np.float32)
    if "rgb" not in (rows.dtype.names or ()) or rows.dtype["rgb"].itemsize != 4:
        return points, np.full((len(rows), 3), 128, np.uint8)
    packed = np.ascontiguousarray(rows["rgb"]).view("<u4")
    return points, np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1).astype(np.uint8)


def _read_header(file: BinaryIO, path: Path) -> tuple[int, np.dtype[np.void]]:
    """Return the number of points and their layout."""
    entries: dict[str, list[str]] = {}
    for _ in range(_MAX_HEADER_LINES):
        words = file.readline(_MAX_LINE_BYTES).decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
            if words[0] == "DATA":
                break
    missing = [name for name in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA") if name not in entries]
    if missing:
        raise DataError(f"{path} has no PCD header: {', '.join(missing)} is missing in its first lines")
    if entries["DATA"] != ["binary"]:
        raise DataError(f"{path} holds '{' '.join(entries['DATA'])[:40]}' data, only binary is read; convert it first")
    names, sizes, types = entries["FIELDS"], entries["SIZE"], entries["TYPE"]
    counts = entries.get("COUNT", ["1"] * len(names))
    if not (len(names) == len(sizes) == len(types) == len(counts) <= _MAX_FIELDS):
        raise DataError(f"{path}: FIELDS, SIZE, TYPE and COUNT differ in length, or are more than {_MAX_FIELDS}")
    layout: list[tuple[str, str] | tuple[str, str, int]] = []
    for i, (name, size, kind, number) in enumerate(zip(names, sizes, types, counts, strict=True)):
        valid = kind in _KINDS and size in ("1", "2", "4", "8") and not (kind == "F" and size in ("1", "2"))
        if not (valid and number.isdecimal() and 0 < int(number[:6]) <= _MAX_POINT_BYTES):
            raise DataError(f"{path}: field '{name[:40]}' of type {kind[:9]}, size {size[:9]} cannot be read")
        code = f"<{_KINDS[kind]}{size}"
        unique = name if name not in names[:i] else f"{name} {i}"  # padding is often called _ again and again
        layout.append((unique, code) if int(number) == 1 else (unique, code, int(number)))
    point = np.dtype(layout)
    if not all(name in names and point[name].kind == "f" and point[name].shape == () for name in ("x", "y", "z")):
        raise DataError(f"{path}: points lack x, y, z as single numbers; they have {names[:20]}")
    total = entries["POINTS"][0] if entries["POINTS"] else ""
    if not total.isdecimal() or len(total) > 12 or point.itemsize > _MAX_POINT_BYTES:
        raise DataError(f"{path}: POINTS must be a number, got '{total[:40]}'")
    return int(total), point
