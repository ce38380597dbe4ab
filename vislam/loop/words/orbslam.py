"""Reading a vocabulary from ORB-SLAM's text format (DBoW2's `saveToTextFile`, such as ORBvoc.txt).

The first line is `k L scoring weighting`; every other line is a node: its parent (0: the root; nodes are numbered by
line, from 1), whether it is a leaf, its 32 bytes, its weight. Only L1 scores of tf-idf weights (0 0) mean what they
mean here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.reading import read_bytes
from vislam.loop.words.vocabulary import Vocabulary
from vislam.vision.hamming import DESCRIPTOR_BYTES

_MAX_FILE_BYTES = 2**30  # ORBvoc.txt has 145 MB
_MIN_LINE_BYTES = 2 * (DESCRIPTOR_BYTES + 3)  # a digit and a blank per field: bounds what the file can make us allocate
_MAX_BRANCHING, _MAX_DEPTH = 20, 10  # DBoW2's own limits
_HEADER_BYTES = 100

_FAULTS = {
    1: "a parent is expected, the number of an earlier line's node",
    2: "a 0 or 1 is expected, whether the node is a leaf",
    3: f"{DESCRIPTOR_BYTES} bytes 0..255 are expected",
    4: "a weight is expected, a number that is not negative",
    5: "there is more than a node needs",
    6: "the parent is a leaf",
    7: "the parent has more children than the file's first line allows",
    8: "the node is deeper than the file's first line allows",
    9: "the line does not end: the file was cut short",
}

Octets = NDArray[np.uint8]


@njit(cache=True, nogil=True)
def _skip_blanks(text: Octets, at: int) -> int:
    while at < len(text) and (text[at] == 32 or text[at] == 9 or text[at] == 13):
        at += 1
    return at


@njit(cache=True, nogil=True)
def _whole(text: Octets, at: int, largest: int) -> tuple[int, int]:
    """Return a whole number 0..largest and where it ends; -1 when there is none."""
    at = _skip_blanks(text, at)
    value, begin = 0, at
    while at < len(text) and 48 <= text[at] <= 57 and value <= largest:
        value = 10 * value + int(text[at] - 48)
        at += 1
    blank = at == len(text) or text[at] in (32, 9, 13, 10)
    return (value if at > begin and value <= largest and blank else -1), at


@njit(cache=True, nogil=True)
def _decimal(text: Octets, at: int) -> tuple[float, int]:
    """Return a decimal number >= 0, within two units of its last place, and where it ends; -1: there is none."""
    at = _skip_blanks(text, at)
    mantissa, exponent, digits, fraction = 0, 0, 0, False
    while at < len(text) and (48 <= text[at] <= 57 or (text[at] == 46 and not fraction)):
        if text[at] == 46:
            fraction = True
        else:
            digits += 1
            if mantissa < 10**17:
                mantissa = 10 * mantissa + int(text[at] - 48)
                exponent -= 1 if fraction else 0
            else:
                exponent += 0 if fraction else 1
        at += 1
    if digits > 0 and at < len(text) and text[at] in (101, 69):  # e, E
        at += 1
        negative = at < len(text) and text[at] == 45
        if at < len(text) and text[at] in (43, 45):
            at += 1
        power, at = _whole(text, at, 999)
        if power < 0:
            return -1.0, at
        exponent += -power if negative else power
    if digits == 0 or not (at == len(text) or text[at] in (32, 9, 13, 10)):
        return -1.0, at
    value = np.float64(mantissa)
    while exponent != 0 and 0.0 < value < np.inf:  # exact powers of ten, 10^22 is the largest
        step = min(abs(exponent), 22)
        value = value * 10.0**step if exponent > 0 else value / 10.0**step
        exponent += -step if exponent > 0 else step
    return (value if value < np.inf else -1.0), at


@njit(cache=True, nogil=True)
def _is_over(text: Octets, at: int) -> bool:
    """Return whether only blank lines follow."""
    while at < len(text) and text[at] in (32, 9, 13, 10):
        at += 1
    return at == len(text)


@njit(cache=True, nogil=True)
def _node(text: Octets, at: int, node: int, octets: Octets) -> tuple[int, int, float, int, int]:
    """Return parent, leaf, weight, where the next line begins, and 0 or the fault of a line; fill its bytes [32]."""
    parent, at = _whole(text, at, node - 1)
    if parent < 0:
        return 0, 0, 0.0, at, 1
    is_leaf, at = _whole(text, at, 1)
    if is_leaf < 0:
        return 0, 0, 0.0, at, 2
    for i in range(DESCRIPTOR_BYTES):
        value, at = _whole(text, at, 255)
        if value < 0:
            return 0, 0, 0.0, at, 3
        octets[i] = value
    weight, at = _decimal(text, at)
    if weight < 0.0:
        return 0, 0, 0.0, at, 4
    at = _skip_blanks(text, at)
    fault = 9 if at == len(text) else 0 if text[at] == 10 else 5
    return parent, is_leaf, weight, at + 1, fault


@njit(cache=True, nogil=True)
def _parse(
    text: Octets, at: int, branching: int, depth: int, parents: NDArray[np.int32], leaf: Octets, nodes: Octets,
    weights: NDArray[np.float64],
) -> tuple[int, int]:  # fmt: skip
    """Fill the arrays from row 1 on; return how many nodes there are with the root, and 0 or the fault of the next."""
    children, level = np.zeros(len(parents), np.int32), np.zeros(len(parents), np.int8)
    node = 1
    while not _is_over(text, at):
        if node == len(parents):
            return node, 3  # more lines than fit into the file are lines too short for a node
        parent, is_leaf, weight, at, fault = _node(text, at, node, nodes[node])
        if fault:
            return node, fault
        parents[node], leaf[node], weights[node] = parent, is_leaf, weight
        children[parent] += 1
        level[node] = level[parent] + 1
        if leaf[parent]:
            return node, 6
        if children[parent] > branching:
            return node, 7
        if level[node] > depth:
            return node, 8
        node += 1
    return node, 0


def read_orbslam(path: Path) -> Vocabulary:
    """Read a vocabulary in ORB-SLAM's text format; words get other numbers, scores are the same.

    Raises DataError, with the line, for a file that is not one or was damaged.
    """
    try:
        text = np.frombuffer(read_bytes(path, _MAX_FILE_BYTES), dtype=np.uint8)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}; give a vocabulary in ORB-SLAM's format") from error
    branching, depth, begin = _header(text, path)
    most = min(int(np.count_nonzero(text == 10)), len(text) // _MIN_LINE_BYTES) + 2
    parents, leaf = np.zeros(most, np.int32), np.zeros(most, np.uint8)
    nodes, weights = np.zeros((most, DESCRIPTOR_BYTES), np.uint8), np.zeros(most)
    count, fault = _parse(text, begin, branching, depth, parents, leaf, nodes, weights)
    if fault:
        raise DataError(f"{path}, line {count + 1}: {_FAULTS[fault]}; get a whole copy of the vocabulary")
    childless = np.bincount(parents[1:count], minlength=count) == 0
    wrong = np.flatnonzero(childless != leaf[:count].astype(bool))
    if len(wrong):
        no_child = f"line {wrong[0] + 1}: the node is no leaf, but has no child"
        where = "the file holds no node" if wrong[0] == 0 else no_child
        raise DataError(f"{path}, {where}; get a whole copy of the vocabulary")
    return _in_order(parents[:count], nodes[:count], weights[:count])


def _header(text: Octets, path: Path) -> tuple[int, int, int]:
    """Return branching, depth, and where the second line begins."""
    line, end, _ = text[:_HEADER_BYTES].tobytes().partition(b"\n")
    fields = line.split()
    if not end or len(fields) != 4 or not all(field.isdigit() for field in fields):
        raise DataError(f"{path}, line 1: 'k L scoring weighting' is expected; this is no ORB-SLAM text vocabulary")
    branching, depth, scoring, weighting = (int(field) for field in fields)
    if not (2 <= branching <= _MAX_BRANCHING and 1 <= depth <= _MAX_DEPTH):
        raise DataError(
            f"{path}, line 1: branching {branching} and depth {depth}, but 2..{_MAX_BRANCHING} and 1..{_MAX_DEPTH} "
            "are possible"
        )
    if (scoring, weighting) != (0, 0):
        raise DataError(
            f"{path}, line 1: scoring {scoring} and weighting {weighting}, but only L1 scores of tf-idf weights (0 0) "
            "can be used; train a vocabulary of your own: vislam vocabulary"
        )
    return branching, depth, len(line) + 1


def _in_order(parents: NDArray[np.int32], nodes: Octets, weights: NDArray[np.float64]) -> Vocabulary:
    """Return the vocabulary with the children of each node side by side, and after it.

    Sorted by parent they are: a parent has a smaller number than its child, so its own parent has one, too.
    """
    count = len(parents)
    order = np.concatenate([[0], 1 + np.argsort(parents[1:], kind="stable")])
    child_count = np.bincount(parents[1:], minlength=count)
    first = 1 + np.concatenate([[0], np.cumsum(child_count)[:-1]])  # in the new order, by old number of the parent
    child_count, first = child_count[order].astype(np.int32), first[order]
    first_child = np.where(child_count > 0, first, 0).astype(np.int32)
    packed_nodes = np.ascontiguousarray(nodes[order]).view(np.uint64)
    return Vocabulary(packed_nodes, first_child, child_count, weights[order][child_count == 0])
