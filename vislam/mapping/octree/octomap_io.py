"""OctoMap's files, written and read: `.bt` (occupied or free, pruned) and `.ot` (log-odds, perhaps colour).

The format is OctoMap 1.9's: a text header, then the nodes depth first. In `.bt` each inner node is 16 bits, two per
child: 00 unknown, 01 free leaf, 10 occupied leaf, 11 inner. In `.ot` each node is a float32 log-odds, in a ColorOcTree
red, green and blue (white: no colour), and 8 bits, one per child that exists.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.reading import read_bytes, readable
from vislam.mapping.octree.tree import TREE_LEVELS, OctreeLeaves, log_odds

_BINARY_TITLE = b"# Octomap OcTree binary file"
_FULL_TITLE = b"# Octomap OcTree file"
_PLAIN, _COLOURED = "OcTree", "ColorOcTree"
_COMMENT = "# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
_MAX_HEADER_BYTES = 4096
_MAX_FILE_BYTES = 1 << 28  # 256 MiB: a building at 5 cm is under 10
_FREE, _OCCUPIED, _INNER = 1, 2, 3
_TRUNCATED, _TOO_DEEP, _LEFT_OVER = -1, -2, -3
_REASONS = {
    _TRUNCATED: "the file ends inside the tree",
    _TOO_DEEP: "a node lies below the 16th level",
    _LEFT_OVER: "bytes follow the end of the tree",
}
_Bytes = NDArray[np.uint8]
_LOG = logging.getLogger(__name__)


def encode_bt(octree: OctreeLeaves) -> bytes:
    """Return the `.bt` file of an octree whose leaves are pruned by occupied or free; colours are left out."""
    data, inner = _encode_bt(octree.starts, octree.levels, octree.log_odds)
    return _header(_BINARY_TITLE, _PLAIN, len(octree) + inner, octree.resolution_m) + data.tobytes()


def encode_ot(octree: OctreeLeaves) -> bytes:
    """Return the `.ot` file of an octree with its log-odds: a ColorOcTree when it has colours, else an OcTree.

    An inner node has the largest log-odds of its children, and the average of their colours.
    """
    values, children, levels = _nodes_of_leaves(octree.starts, octree.levels, octree.log_odds)
    kind = _PLAIN if octree.colors is None else _COLOURED
    nodes = np.empty(len(values), _node_type(kind))
    nodes["value"], nodes["children"] = values, children
    if octree.colors is not None:
        nodes["color"] = _average_colors(octree.colors, children, levels)
    return _header(_FULL_TITLE, kind, len(nodes), octree.resolution_m) + nodes.tobytes()


def _node_type(kind: str) -> np.dtype[np.void]:
    color = [("color", "u1", 3)] if kind == _COLOURED else []
    return np.dtype([("value", "<f4"), *color, ("children", "u1")])


def _header(title: bytes, kind: str, nodes: int, resolution_m: float) -> bytes:
    return title + f"\n{_COMMENT}id {kind}\nsize {nodes}\nres {resolution_m:g}\ndata\n".encode()


def read_octree(path: Path, occupied_probability: float = 0.971, free_probability: float = 0.1192) -> OctreeLeaves:
    """Return the octree of a `.bt` or `.ot` file, of which an inner node's own values are not kept.

    Leaves of a `.bt` get OctoMap's clamping thresholds unless others are given. As in OctoMap, an `.ot` is read by its
    nodes: another number in its header is logged as a warning. Raises DataError when the file is not a
    complete tree of kind OcTree or ColorOcTree. Memory is bounded by the file's size.
    """
    with readable(path):
        content = read_bytes(path, _MAX_FILE_BYTES)
    is_binary, fields, offset = _parse_header(content, path)
    kind, resolution_m, size = _checked_header(fields, path)
    if not is_binary:
        return _decode_full(content[offset:], kind, resolution_m, size, path)
    starts, levels, is_occupied = _decode_leaves(content[offset:], size, path)
    values = np.where(is_occupied, log_odds(occupied_probability), log_odds(free_probability))
    return OctreeLeaves(resolution_m, starts, levels, values)


def _parse_header(content: bytes, path: Path) -> tuple[bool, dict[str, str], int]:
    """Return whether it is a `.bt`, the header's fields, and where the nodes begin."""
    head = content[:_MAX_HEADER_BYTES]
    is_binary = head.startswith(_BINARY_TITLE)
    if not is_binary and not head.startswith(_FULL_TITLE):
        raise DataError(
            f"{path} does not start with '{_BINARY_TITLE.decode()}' or '{_FULL_TITLE.decode()}'; is it a .bt or .ot?"
        )
    fields: dict[str, str] = {}
    offset = 0
    while True:
        end = head.find(b"\n", offset)
        if end < 0:
            raise DataError(f"{path}: no 'data' line in the first {_MAX_HEADER_BYTES} bytes; the file is damaged")
        line = head[offset:end].decode("ascii", errors="replace").strip()
        offset = end + 1
        if line == "data":
            return is_binary, fields, offset
        if line and not line.startswith("#"):
            name, _, value = line.partition(" ")
            fields[name] = value.strip()


def _checked_header(fields: dict[str, str], path: Path) -> tuple[str, float, int]:
    """Return kind of tree, resolution in metres and number of nodes."""
    kind = fields.get("id", "")
    if kind not in (_PLAIN, _COLOURED):
        raise DataError(f"{path} holds a tree of kind '{kind}', only {_PLAIN} and {_COLOURED} can be read")
    try:
        resolution_m, size = float(fields["res"]), int(fields["size"])
    except (KeyError, ValueError) as error:
        raise DataError(f"{path}: the header lacks a valid 'res' or 'size': {error}") from error
    if not (np.isfinite(resolution_m) and resolution_m > 0.0) or size < 0:
        raise DataError(f"{path}: impossible header, res {resolution_m} and size {size}")
    return kind, resolution_m, size


def _decode_full(data: bytes, kind: str, resolution_m: float, size: int, path: Path) -> OctreeLeaves:
    node_type = _node_type(kind)
    nodes = np.frombuffer(data, node_type, len(data) // node_type.itemsize)
    children = np.ascontiguousarray(nodes["children"])
    leaves = np.flatnonzero(children == 0)
    starts, levels = np.empty(len(leaves), np.int64), np.empty(len(leaves), np.uint8)
    used = _decode_ot(children, starts, levels)
    if size > 0 and len(nodes) == 0:
        used = _TRUNCATED
    elif used == len(nodes) and len(data) % node_type.itemsize:
        used = _LEFT_OVER
    if used < 0:
        raise DataError(f"{path} is damaged: {_REASONS[used]} ({len(data)} bytes, the header states {size} nodes)")
    if used != size:  # OctoMap reads the nodes, whatever the header states
        _LOG.warning("%s: the header states %d nodes, the tree has %d, which were read", path, size, used)
    values = nodes["value"][leaves].astype(np.float32)
    if not np.isfinite(values).all():
        raise DataError(f"{path} is damaged: a leaf's log-odds is not a finite number")
    colors = np.ascontiguousarray(nodes["color"][leaves]) if kind == _COLOURED else None
    return OctreeLeaves(resolution_m, starts, levels, values, colors)


def _decode_leaves(
    data: bytes, size: int, path: Path
) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.bool_]]:
    """Return start code, level and occupied flag of every leaf; they are counted first, so a lie costs no memory."""
    if len(data) % 2:
        raise DataError(f"{path}: {len(data)} bytes of nodes is not a whole number of 16-bit nodes; the file is cut")
    words = np.frombuffer(data, np.dtype("<u2")).astype(np.uint16)
    leaf_count = int(np.bitwise_count((words ^ (words >> 1)) & np.uint16(0x5555)).sum())
    starts, levels = np.empty(leaf_count, np.int64), np.empty(leaf_count, np.uint8)
    is_occupied = np.empty(leaf_count, np.bool_)
    used = _decode_bt(words, starts, levels, is_occupied)
    if used < 0:
        raise DataError(f"{path} is damaged: {_REASONS[used]}")
    if size != leaf_count + len(words):
        raise DataError(f"{path} is damaged: the header promises {size} nodes, found {leaf_count + len(words)}")
    return starts, levels, is_occupied


@njit(cache=True, nogil=True)
def _shared_level(a: int, b: int) -> int:
    """Return the level of the smallest node that holds both voxels."""
    level, difference = 0, a ^ b
    while difference:
        difference >>= 3
        level += 1
    return level


@njit(cache=True, nogil=True)
def _encode_bt(starts: NDArray[np.int64], levels: NDArray[np.uint8], values: NDArray[np.float32]) -> tuple[_Bytes, int]:
    """Return the nodes of a `.bt` and their number; an inner node is opened when its first leaf is met."""
    out = np.zeros(64 + 2 * TREE_LEVELS * len(starts) // 4, np.uint8)
    place = np.zeros(TREE_LEVELS + 1, np.int64)  # where the open inner node of each level stands in the output
    end = 0
    for i in range(len(starts)):
        top = TREE_LEVELS + 1 if i == 0 else _shared_level(starts[i - 1], starts[i])
        if end + 2 * (TREE_LEVELS + 1) > len(out):
            larger = np.zeros(2 * len(out), np.uint8)
            larger[:end] = out[:end]
            out = larger
        for level in range(top - 1, levels[i], -1):
            if level < TREE_LEVELS:
                child = (starts[i] >> (3 * level)) & 7
                out[place[level + 1] + (child >> 2)] |= _INNER << (2 * (child & 3))
            place[level] = end
            end += 2
        if levels[i] < TREE_LEVELS:
            child = (starts[i] >> (3 * levels[i])) & 7
            bits = _OCCUPIED if values[i] >= 0.0 else _FREE
            out[place[levels[i] + 1] + (child >> 2)] |= bits << (2 * (child & 3))
        else:
            end += 2  # the root is a leaf: OctoMap writes it as a node without children
    return out[:end].copy(), end // 2 if len(starts) == 0 or levels[0] < TREE_LEVELS else 0


@njit(cache=True, nogil=True)
def _nodes_of_leaves(
    starts: NDArray[np.int64], levels: NDArray[np.uint8], values: NDArray[np.float32]
) -> tuple[NDArray[np.float32], _Bytes, _Bytes]:
    """Return log-odds, children and level of all nodes, depth first; inner ones have the largest of their leaves."""
    capacity = 64 + 2 * len(starts)
    node_value, node_children = np.empty(capacity, np.float32), np.zeros(capacity, np.uint8)
    node_level = np.empty(capacity, np.uint8)
    place = np.zeros(TREE_LEVELS + 1, np.int64)
    count = 0
    for i in range(len(starts)):
        top = TREE_LEVELS + 1 if i == 0 else _shared_level(starts[i - 1], starts[i])
        if count + TREE_LEVELS + 1 > capacity:
            capacity *= 2
            node_value, node_children, node_level = (
                np.append(node_value, np.empty(capacity - len(node_value), np.float32)),
                np.append(node_children, np.zeros(capacity - len(node_children), np.uint8)),
                np.append(node_level, np.empty(capacity - len(node_level), np.uint8)),
            )
        for level in range(top - 1, int(levels[i]) - 1, -1):
            if level < TREE_LEVELS:
                node_children[place[level + 1]] |= 1 << ((starts[i] >> (3 * level)) & 7)
            place[level] = count
            node_value[count], node_level[count] = values[i], level
            count += 1
        for level in range(max(top, int(levels[i]) + 1), TREE_LEVELS + 1):
            node_value[place[level]] = max(node_value[place[level]], values[i])
    return node_value[:count].copy(), node_children[:count].copy(), node_level[:count].copy()


@njit(cache=True, nogil=True)
def _average_colors(leaf_colors: _Bytes, children: _Bytes, levels: _Bytes) -> _Bytes:
    """Return the colours [M, 3] of all nodes; an inner one's is the average, rounded down, of its coloured children."""
    out = np.empty((len(children), 3), np.uint8)
    sums = np.zeros((TREE_LEVELS + 2, 4), np.int64)  # of the coloured children met so far, for a parent of each level
    leaf = len(leaf_colors)
    for n in range(len(children) - 1, -1, -1):  # backwards, children come before their parent
        level = levels[n]
        if children[n] == 0:
            leaf -= 1
            out[n] = leaf_colors[leaf]
        else:
            for c in range(3):
                out[n, c] = sums[level, c] // sums[level, 3] if sums[level, 3] > 0 else 255
            sums[level] = 0
        if out[n, 0] != 255 or out[n, 1] != 255 or out[n, 2] != 255:
            for c in range(3):
                sums[level + 1, c] += out[n, c]
            sums[level + 1, 3] += 1
    return out


@njit(cache=True, nogil=True)
def _decode_bt(
    words: NDArray[np.uint16], starts: NDArray[np.int64], levels: NDArray[np.uint8], occupied: NDArray[np.bool_]
) -> int:
    """Fill the leaves of a `.bt`; return the number of inner nodes read, or a negative reason for damage."""
    if len(words) == 0:
        return 0
    code = np.zeros(TREE_LEVELS + 1, np.int64)
    mask = np.zeros(TREE_LEVELS + 1, np.int64)
    child = np.zeros(TREE_LEVELS + 1, np.int64)
    level, read, leaf = TREE_LEVELS, 1, 0
    mask[level] = words[0]
    while level <= TREE_LEVELS:
        if child[level] == 8:
            level += 1
            continue
        c = child[level]
        child[level] += 1
        bits = (mask[level] >> (2 * c)) & 3
        start = code[level] | (c << (3 * (level - 1)))
        if bits == _INNER:
            if level == 1:
                return _TOO_DEEP
            if read == len(words):
                return _TRUNCATED
            level -= 1
            code[level], mask[level], child[level] = start, words[read], 0
            read += 1
        elif bits != 0:
            starts[leaf], levels[leaf], occupied[leaf] = start, level - 1, bits == _OCCUPIED
            leaf += 1
    return read if read == len(words) else _LEFT_OVER


@njit(cache=True, nogil=True)
def _decode_ot(children: _Bytes, starts: NDArray[np.int64], levels: NDArray[np.uint8]) -> int:
    """Fill the leaves of an `.ot`; return the number of nodes read, or a negative reason for damage."""
    if len(children) == 0:
        return 0
    code = np.zeros(TREE_LEVELS + 2, np.int64)
    mask = np.zeros(TREE_LEVELS + 2, np.int64)  # children that were not visited yet
    mask[TREE_LEVELS + 1] = 1  # the root, as the only child of nothing
    level, read, leaf = TREE_LEVELS + 1, 0, 0
    while level <= TREE_LEVELS + 1:
        if mask[level] == 0:
            level += 1
            continue
        child = 0
        while not (mask[level] >> child) & 1:
            child += 1
        mask[level] &= mask[level] - 1
        if read == len(children):
            return _TRUNCATED
        start = code[level] | (child << (3 * (level - 1)))
        if children[read] == 0:
            starts[leaf], levels[leaf] = start, level - 1
            leaf += 1
        elif level == 1:
            return _TOO_DEEP
        else:
            level -= 1
            code[level], mask[level] = start, children[read]
        read += 1
    return read if read == len(children) else _LEFT_OVER
