"""Finding keyframes that look alike: a vocabulary trained on the run's own keyframes, over an inverted index.

There is no vocabulary file. The first training comes after a few keyframes, before any of them is old enough to be a
candidate, and the tree is grown again each time their number has doubled: always on what this run has seen, which
retrieves better than a generic tree of 700,000 words. Training is part of `add`, so that a replay gives the same
words.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopConfig
from vislam.loop.index import InvertedIndex
from vislam.loop.view import View
from vislam.loop.vocabulary import Vocabulary, train
from vislam.memory import WordsMemory

_DEEP_FROM = 60_000  # descriptors; fewer do not fill a fifth level


class PlaceDatabase:
    """Owns the vocabulary and the inverted index of a run."""

    def __init__(self, config: LoopConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._views: list[View] = []
        self._train_at = config.first_training
        self._index: InvertedIndex | None = None
        self.vocabulary: Vocabulary | None = None
        self.trainings = 0

    def query(self, view: View, k: int, excluded: NDArray[np.int64]) -> tuple[list[int], list[float]]:
        """Return ids and scores 0..1 of the at most k keyframes that look most like a view, best first."""
        if self.vocabulary is None or self._index is None or len(view.descriptors) == 0:
            return [], []
        ids, scores = self._index.query(self.vocabulary.transform(view.descriptors), k, excluded)
        return ids.tolist(), scores.tolist()

    def words(self) -> WordsMemory | None:
        """Return the vocabulary as `restore` takes it; None before the first training."""
        if self.vocabulary is None:
            return None
        return WordsMemory(self.vocabulary.to_bytes(), self._train_at // 2, self.trainings)

    def restore(self, views: list[View], words: WordsMemory | None) -> None:
        """Take over the views of an earlier run and the vocabulary it had; raises DataError when that is damaged."""
        self._views = list(views)
        if words is not None:
            self.vocabulary = Vocabulary.from_bytes(words.data, "of the session")
            self._train_at, self.trainings = 2 * words.trained_at, words.trainings
            self._rebuild()

    def add(self, view: View) -> None:
        """Add a view (ids ascend) and train again when it is time."""
        self._views.append(view)
        if len(self._views) >= self._train_at and any(len(old.descriptors) for old in self._views):
            self._train()
            self._train_at = 2 * len(self._views)
        elif self.vocabulary is not None and self._index is not None:
            self._index.add(view.id, self.vocabulary.transform(view.descriptors))

    def _train(self) -> None:
        config = self._config
        images = [view.descriptors for view in self._views]
        used = min(sum(len(image) for image in images), config.training_descriptors)
        depth = config.vocabulary_depth if used >= _DEEP_FROM else max(1, config.vocabulary_depth - 1)
        self.vocabulary = train(
            images, config.vocabulary_branching, depth, self._seed + self.trainings, config.training_descriptors
        )
        self._rebuild()
        self.trainings += 1

    def _rebuild(self) -> None:
        """Index all views anew."""
        assert self.vocabulary is not None
        self._index = InvertedIndex(self.vocabulary.idf)
        for view in self._views:
            self._index.add(view.id, self.vocabulary.transform(view.descriptors))
