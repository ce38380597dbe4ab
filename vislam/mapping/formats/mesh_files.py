"""Meshes for other programs: binary glTF 2.0 and Wavefront OBJ, written in pieces.

Not Open3D's writers: a million vertices take 402 MB more memory (ours 0); its GLB of 48 MB (ours 28) lies on its side.
"""

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.files import replacing
from vislam.core.messages import ImageU8
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.formats.ply import chunks
from vislam.mapping.mesh.atlas import TexturedMesh

_FLOAT, _UNSIGNED_INT, _UNSIGNED_BYTE = 5126, 5125, 5121  # glTF's component types
_VERTICES, _INDICES = 34962, 34963  # and targets of buffer views
_LINEAR, _CLAMP = 9729, 33071  # and of samplers
_UNLIT = "KHR_materials_unlit"
_JPEG_QUALITY = 92
_Z_UP_TO_Y_UP = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]  # columns; glTF's y is up


class _Part(NamedTuple):
    """Rows of a buffer, as glTF calls them."""

    rows: NDArray[Any]  # [n, k]
    dtype: str  # of the file
    component: int
    shape: str
    target: int


def write_glb(path: Path, mesh: Mesh, textured: TexturedMesh | None = None) -> None:
    """Write a mesh as binary glTF 2.0, its z axis up; raises StorageError when the file cannot be written.

    With `textured`, its picture lies on the triangles that have a place in it, and only what is left has colours at
    its vertices; `mesh` is then not looked at.
    """
    rest = mesh if textured is None else textured.rest
    parts: list[_Part] = []
    primitives: list[dict[str, object]] = []
    if textured is not None:
        uv = _Part(textured.uv, "<f4", _FLOAT, "VEC2", _VERTICES)
        primitives += _primitives(parts, textured.points_m, ("TEXCOORD_0", uv), textured.triangles, textured.filled, 1)
    if textured is None or len(rest.triangles):
        colors = _Part(rest.colors, "u1", _UNSIGNED_BYTE, "VEC4", _VERTICES)
        primitives += _primitives(parts, rest.points_m, ("COLOR_0", colors), rest.triangles, rest.filled, 0)
    picture = b"" if textured is None else _jpeg(textured.atlas)
    sizes = [len(part.rows) * _row_bytes(part) for part in parts] + ([len(picture)] if picture else [])
    padding = b"\0" * (-sum(sizes) % 4)
    header = json.dumps(_gltf(parts, primitives, sizes, len(padding)), separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    length = sum(sizes) + len(padding)
    with replacing(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(header) + 8 + length))
        file.write(struct.pack("<I4s", len(header), b"JSON") + header)
        file.write(struct.pack("<I4s", length, b"BIN\0"))
        for part in parts:
            for chunk in chunks(len(part.rows)):
                file.write(_bytes(part, chunk))
        file.write(picture + padding)


def _primitives(
    parts: list[_Part], points_m: NDArray[np.float32], attribute: tuple[str, _Part], triangles: NDArray[np.int32],
    filled: int, material: int,
) -> list[dict[str, object]]:  # fmt: skip
    """Add points, their attribute and triangles to the parts of a file, and return what glTF states of them.

    What fills holes is stated apart from what was seen, and named.
    """
    first, seen = len(parts), len(triangles) - filled
    parts += [_Part(points_m, "<f4", _FLOAT, "VEC3", _VERTICES), attribute[1]]
    out: list[dict[str, object]] = []
    for rows, extras in ((triangles[:seen], {}), (triangles[seen:], {"extras": {"filled": True}})):
        if len(rows):
            attributes = {"POSITION": first, attribute[0]: first + 1}
            out.append({"attributes": attributes, "indices": len(parts), "material": material, **extras})
            parts.append(_Part(rows.reshape(-1, 1), "<u4", _UNSIGNED_INT, "SCALAR", _INDICES))
    return out


def _row_bytes(part: _Part) -> int:
    return {"SCALAR": 4, "VEC2": 8, "VEC3": 12, "VEC4": 4}[part.shape]


def _bytes(part: _Part, chunk: slice) -> bytes:
    rows = part.rows[chunk]
    if part.shape == "VEC4":  # of bytes, RGBA: rows of a buffer begin at multiples of four bytes
        rows = np.column_stack([rows, np.full(len(rows), 255, np.uint8)])
    return np.ascontiguousarray(rows, dtype=part.dtype).tobytes()


def _jpeg(image: ImageU8) -> bytes:
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _gltf(
    parts: list[_Part], primitives: list[dict[str, object]], sizes: list[int], padding: int
) -> dict[str, object]:  # fmt: skip
    """Return the description of a file whose buffer holds the parts, and a picture if there is one more size."""
    accessors: list[dict[str, object]] = []
    for i, part in enumerate(parts):
        accessor: dict[str, object] = {
            "bufferView": i, "componentType": part.component, "type": part.shape, "count": len(part.rows),
        }  # fmt: skip
        if part.shape == "VEC3":
            accessor |= {"min": part.rows.min(axis=0).tolist(), "max": part.rows.max(axis=0).tolist()}
        if part.shape == "VEC4":
            accessor["normalized"] = True
        accessors.append(accessor)
    starts = np.concatenate([[0], np.cumsum(sizes)]).tolist()
    views: list[dict[str, object]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in zip(starts, sizes, strict=False)
    ]
    for view, part in zip(views, parts, strict=False):
        view["target"] = part.target
    plain: dict[str, object] = {"metallicFactor": 0, "roughnessFactor": 1}
    materials: list[dict[str, object]] = [{"doubleSided": True, "pbrMetallicRoughness": plain}]
    pictures: dict[str, object] = {}
    if len(sizes) > len(parts):
        # light is in the pictures already; viewers that do not know the extension light them again
        materials[0]["extensions"] = {_UNLIT: {}}
        materials.append({
            "doubleSided": True, "extensions": {_UNLIT: {}},
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, **plain},
        })  # fmt: skip
        pictures = {
            "extensionsUsed": [_UNLIT],
            "images": [{"bufferView": len(parts), "mimeType": "image/jpeg"}],
            "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}],
            "textures": [{"source": 0, "sampler": 0}],
        }
    return {
        "asset": {"version": "2.0", "generator": "vislam"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": _Z_UP_TO_Y_UP}],
        "meshes": [{"primitives": primitives}],
        "materials": materials,
        **pictures,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(sizes) + padding}],
    }


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write a mesh as OBJ, colours behind the coordinates, what fills holes as a group.

    Raises StorageError when the file cannot be written.
    """
    with replacing(path) as file:
        file.write(b"# vislam, metres in the map frame\n")
        for chunk in chunks(len(mesh.points_m)):
            rows = np.column_stack([mesh.points_m[chunk], mesh.colors[chunk] / 255.0])
            np.savetxt(file, rows, "v %.5f %.5f %.5f %.4f %.4f %.4f")
        seen = len(mesh.triangles) - mesh.filled
        for name, triangles in (("seen", mesh.triangles[:seen]), ("filled", mesh.triangles[seen:])):
            file.write(f"g {name}\n".encode() if mesh.filled else b"")
            for chunk in chunks(len(triangles)):
                np.savetxt(file, triangles[chunk] + 1, "f %d %d %d")
