"""A vocabulary from images, recordings or ORB-SLAM's text file: the library's side of `vislam vocabulary`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import UsageError
from vislam.core.messages import Frame, ImageU8
from vislam.core.recording import with_camera
from vislam.datasets.images import read_any_size
from vislam.loop import Vocabulary, depth_for, train
from vislam.runs.sources import open_source
from vislam.vision.features import describe

_SUFFIXES = (".png", ".jpg", ".jpeg")


def train_vocabulary(
    sources: tuple[str, ...],
    *,
    every: int = 1,
    features: int = 1000,
    branching: int = 10,
    depth: int | None = None,
    max_descriptors: int = 1_000_000,
    seed: int = 0,
) -> tuple[Vocabulary, int, int]:
    """Train a vocabulary on every n-th image of folders of PNG or JPEG files, and of recordings as for `vislam run`.

    Without `depth` the tree is as deep as leaves each word some descriptors. Returns the vocabulary, how many images it
    comes from, and how many could not be read. Raises UsageError for numbers that make no sense, DataError when
    there is nothing to train on.
    """
    if every < 1 or features < 1:
        raise UsageError(f"--every {every} --features {features}: both must be at least 1")
    images: list[NDArray[np.uint8]] = []
    unreadable = 0
    for source in sources:
        for image in _images(source, every, seed):
            if image is None:
                unreadable += 1
                continue
            images.append(describe(image, features)[1])
    total = sum(len(image) for image in images)
    levels = depth_for(total, branching, 6) if depth is None else depth
    return train(images, branching, levels, seed, max_descriptors), len(images), unreadable


def _images(source: str, every: int, seed: int) -> Iterator[ImageU8 | None]:
    """Yield every n-th grey image of a source; None where one cannot be read."""
    folder = Path(source)
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES) if folder.is_dir() else []
    for path in files[::every]:
        yield read_any_size(path)
    if not files:
        frames = (event for event in with_camera(open_source(source, seed)).events() if isinstance(event, Frame))
        for number, frame in enumerate(frames):
            if number % every == 0:
                yield frame.images[0]
