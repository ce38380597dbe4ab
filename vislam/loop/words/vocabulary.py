"""The vocabulary: which of some thousand words a descriptor is, and how informative each word is of a place.

tf-idf weights and the L1 score are those of DBoW2 (Galvez-Lopez and Tardos, "Bags of binary words for fast place
recognition in image sequences", T-RO 2012). Where vocabularies come from: `database.py`.
"""

from __future__ import annotations

import hashlib
import io
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import replacing
from vislam.core.reading import read_bytes
from vislam.loop.words.tree import MAX_CHILDREN, descend, grow, similarity, walk_table, weigh
from vislam.vision.hamming import packed

_FORMAT = 1
_PER_WORD = 5  # descriptors
_MAX_FILE_BYTES = 512 * 1024 * 1024  # ten million nodes; a larger file is damaged or hostile
_FREE_BYTES, _TIMES = 2**25, 20  # what may be packed in one: trees of bits hardly get smaller
_UNREADABLE = (  # TokenError: numpy parses an array's header
    OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError
)  # fmt: skip
_DTYPES = {"format": "<i8", "nodes": "<u8", "first_child": "<i4", "child_count": "<i4", "idf": "<f8"}


@dataclass(frozen=True, slots=True, eq=False)
class BagOfWords:
    """An image as weighted words: ascending, unique; the weights are positive and sum to 1 (or there are none)."""

    words: NDArray[np.int32]  # [M]
    counts: NDArray[np.int32]  # [M] how many features are this word, >= 1
    weights: NDArray[np.float64]  # [M] count * idf / total
    total: float  # of count * idf

    def score(self, other: BagOfWords) -> float:
        """Return the similarity 0..1: 1 - |a - b|_1 / 2, as DBoW2's L1 score."""
        return float(similarity(self.words, self.weights, other.words, other.weights))


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """A tree of descriptors; leaves are words, numbered in node order, each with its inverse document frequency."""

    nodes: NDArray[np.uint64]  # [nodes, 4] packed centres, breadth first; the root's is unused
    first_child: NDArray[np.int32]  # [nodes]
    child_count: NDArray[np.int32]  # [nodes]; 0: a leaf
    idf: NDArray[np.float64]  # [words]

    @property
    def word_count(self) -> int:
        """The number of words."""
        return len(self.idf)

    @cached_property
    def _table(self) -> NDArray[np.uint64]:
        return walk_table(self.nodes, self.first_child, self.child_count)

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the content: word numbers mean something only together with it."""
        digest = hashlib.sha256()
        for array in (self.nodes, self.first_child, self.child_count, self.idf):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def words(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the word [N] of each descriptor [N, 32]."""
        return np.asarray(descend(packed(descriptors), self._table), dtype=np.int32)

    def transform(self, descriptors: NDArray[np.uint8]) -> BagOfWords:
        """Return the bag of words of an image's descriptors [N, 32]."""
        return BagOfWords(*weigh(np.sort(self.words(descriptors)), self.idf))  # 8 times faster than compiled by numba

    def to_bytes(self) -> bytes:
        """Return the vocabulary as a compressed npz, for `from_bytes`; the same vocabulary gives the same bytes."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            format=np.int64(_FORMAT),
            nodes=self.nodes,
            first_child=self.first_child,
            child_count=self.child_count,
            idf=self.idf,
        )
        return buffer.getvalue()

    @staticmethod
    def from_bytes(data: bytes, name: str) -> Vocabulary:
        """Read what `to_bytes` gave; raises DataError, which calls it by `name`, when it is no sound vocabulary."""
        arrays = _read_arrays(data, name)
        if int(arrays["format"]) != _FORMAT:
            raise DataError(
                f"vocabulary {name} has format {int(arrays['format'])}, this version reads {_FORMAT}; train it again"
            )
        vocabulary = Vocabulary(arrays["nodes"], arrays["first_child"], arrays["child_count"], arrays["idf"])
        fault = _fault(vocabulary)
        if fault:
            raise DataError(f"vocabulary {name} is damaged: {fault}; train it again")
        return vocabulary

    def save(self, path: Path) -> None:
        """Write the vocabulary to a file, which appears whole or not at all.

        Raises StorageError when it cannot be written.
        """
        with replacing(path) as file:
            file.write(self.to_bytes())

    @staticmethod
    def load(path: Path) -> Vocabulary:
        """Read a vocabulary that `save` wrote; raises DataError when the file is not a sound one."""
        try:
            data = read_bytes(path, _MAX_FILE_BYTES)
        except OSError as error:
            raise DataError(f"vocabulary {path} cannot be read: {error.strerror}; give one that exists") from error
        return Vocabulary.from_bytes(data, str(path))


def depth_for(descriptors: int, branching: int, most: int) -> int:
    """Return how many levels leave each word at least five of the descriptors: 1 to `most`.

    Words that are rarer know their training images by heart and nothing else (measured: benchmarks/RESULTS.md).
    """
    depth = 1
    while depth < most and branching ** (depth + 1) * _PER_WORD <= descriptors:
        depth += 1
    return depth


def train(
    images: Sequence[NDArray[np.uint8]], branching: int, depth: int, seed: int, max_descriptors: int
) -> Vocabulary:
    """Train a vocabulary on the descriptors of images ([N_i, 32] each), deterministic for a seed.

    The tree grows on at most `max_descriptors`, taken evenly; idf = log(images / images that have the word), from all.
    Raises DataError when there is nothing to train on.
    """
    filled = [image for image in images if len(image)]
    if not filled or not 2 <= branching <= MAX_CHILDREN or depth < 1 or max_descriptors < 1:
        raise DataError(
            f"training a vocabulary needs descriptors, branching 2 to {MAX_CHILDREN}, depth >= 1; got {len(filled)} "
            f"images with any, branching {branching}, depth {depth}, at most {max_descriptors} descriptors"
        )
    total = sum(len(image) for image in filled)
    stride = -(-total // max_descriptors)
    sample = packed(np.concatenate(filled)[::stride])
    nodes, first_child, child_count = grow(sample, branching, depth, seed)
    bare = Vocabulary(nodes, first_child, child_count, np.zeros(int(np.sum(child_count == 0))))
    images_with = np.zeros(bare.word_count)
    for image in filled:
        images_with[np.unique(bare.words(image))] += 1.0
    idf = np.where(images_with > 0.0, np.log(len(filled) / np.maximum(images_with, 1.0)), 0.0)
    return Vocabulary(nodes, first_child, child_count, idf)


def _read_arrays(data: bytes, name: str) -> dict[str, NDArray[Any]]:
    """Read the npz with bounds on what it may claim; nothing in it is ever executed."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            claimed, most = sum(member.file_size for member in archive.infolist()), _FREE_BYTES + _TIMES * len(data)
            if claimed > most:
                raise DataError(f"vocabulary {name} would unpack to {claimed} bytes, the limit for its size is {most}")
            return {key: _array(archive, key, name) for key in _DTYPES}
    except DataError:
        raise
    except _UNREADABLE as error:
        raise DataError(f"vocabulary {name} cannot be read: {error}; train it again") from error


def _array(archive: zipfile.ZipFile, key: str, name: str) -> NDArray[Any]:
    """Return an array, whose head is compared with what it should be before memory is taken for it."""
    with archive.open(f"{key}.npy") as file:
        np.lib.format.read_magic(file)
        shape, is_by_columns, dtype = np.lib.format.read_array_header_1_0(file)
        expected, axes = np.dtype(_DTYPES[key]), 0 if key == "format" else 2 if key == "nodes" else 1
        if dtype != expected or len(shape) != axes or is_by_columns:
            raise DataError(f"vocabulary {name}: '{key}' is {dtype} {list(shape)}, expected {expected}")
        return np.frombuffer(bytearray(file.read()), dtype).reshape(shape)


def _fault(vocabulary: Vocabulary) -> str:
    """Return what is wrong with the tree, or an empty string: a walk down a sound tree ends at a word."""
    nodes, idf = vocabulary.nodes, vocabulary.idf
    first, count = vocabulary.first_child.astype(np.int64), vocabulary.child_count.astype(np.int64)
    if not (len(nodes) == len(first) == len(count) >= 1) or nodes.shape[1] != 4:
        return f"its arrays disagree in length ({len(nodes)}, {len(first)}, {len(count)} nodes)"
    inner = np.flatnonzero(count)
    if (
        np.any(count < 0)
        or np.any(count > MAX_CHILDREN)
        or np.any(first[inner] <= inner)
        or np.any(first[inner] + count[inner] > len(nodes))
    ):
        return "a node points at children that cannot be its own"
    if len(idf) != len(nodes) - len(inner):
        return f"{len(idf)} word weights for {len(nodes) - len(inner)} leaves"
    if not np.all(np.isfinite(idf)) or np.any(idf < 0.0):
        return "a word weight is negative or not finite"
    return ""
