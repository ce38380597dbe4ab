"""Finding keyframes that look alike: a vocabulary trained on the run's own keyframes, over an inverted index.

A small vocabulary that was trained on simulated images serves the first keyframes, or one that the user names. The
run's own words find more as long as they know most of its keyframes (benchmarks/RESULTS.md), so they are trained again
and again, in a thread whose compiled parts run beside the rest. What a training was started with and when it is taken
over are counted in keyframes, so a replay gives the same bytes however long a training took.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from threading import Event
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopConfig
from vislam.core.memory import WordsMemory
from vislam.loop.view import View
from vislam.loop.words.index import InvertedIndex
from vislam.loop.words.vocabulary import Vocabulary, depth_for, train

_TRAINING_LAG_SHARE = 0.05  # ... and of those it is trained on; so long it takes at 10 keyframes a second
_THREADS = 2  # whose compiled parts run side by side; the cores of the smallest machine that is meant
_BLOCK = 50  # keyframes that a thread takes at a time


A = TypeVar("A")
B = TypeVar("B")


def side_by_side(work: Callable[[Sequence[A]], list[B]], items: Sequence[A]) -> Iterator[B]:
    """Yield what `work` makes of blocks of items, in their order, in threads whose compiled parts do not wait."""
    blocks = [items[begin : begin + _BLOCK] for begin in range(0, len(items), _BLOCK)]
    with ThreadPoolExecutor(_THREADS) as pool:
        for results in pool.map(work, blocks):
            yield from results


@dataclass(frozen=True, slots=True, eq=False)
class _Words:
    """A vocabulary and the index of the keyframes under it."""

    vocabulary: Vocabulary
    index: InvertedIndex
    data: bytes = b""  # of a trained vocabulary, for a session: compressing it takes long, so it is part of a training

    def add(self, view: View) -> None:
        self.index.add(view.id, self.vocabulary.transform(view.descriptors))


@dataclass(frozen=True, slots=True, eq=False)
class _Training:
    """A training under way, and at how many keyframes it is taken over."""

    words: Future[_Words | None]
    due: int


def seed_vocabulary() -> Vocabulary:
    """Return the vocabulary that comes with vislam: small, trained on images of the simulator."""
    file = resources.files("vislam.loop.words") / "seed_vocabulary.npz"
    return Vocabulary.from_bytes(file.read_bytes(), file.name)


class PlaceDatabase:
    """Owns the vocabulary and the inverted index of a run; `close` it, so that no training outlives it."""

    def __init__(self, config: LoopConfig, seed: int) -> None:
        """Start with the configured vocabulary or the seed; raises DataError when the file cannot be used."""
        self._config = config
        self._seed = seed
        self._views: list[View] = []
        first = Vocabulary.load(Path(config.vocabulary)) if config.vocabulary else seed_vocabulary()
        self._words = _Words(first, InvertedIndex(first.idf))
        self._trains = config.train == "always" or (config.train == "auto" and config.vocabulary is None)
        self._train_at = config.first_training
        self._training: _Training | None = None
        self._next: _Words | None = None  # trained, but some keyframes that came meanwhile are not in its index yet
        self._closed = Event()
        self._trained_at = 0
        self.trainings = 0
        self.revision = 0  # grows when what `words` returns is new

    @property
    def vocabulary(self) -> Vocabulary:
        """The vocabulary in use."""
        return self._words.vocabulary

    def query(self, view: View, k: int, excluded: NDArray[np.int64]) -> tuple[list[int], list[float]]:
        """Return ids and scores 0..1 of the at most k keyframes that look most like a view, best first."""
        bag = self._words.vocabulary.transform(view.descriptors)
        ids, scores = self._words.index.query(bag, k, excluded)
        return ids.tolist(), scores.tolist()

    def add(self, view: View) -> None:
        """Add a view (ids ascend), start a training when it is time, and take one over when it is due.

        An error of a training is raised here, when it is due.
        """
        self._views.append(view)
        self._words.add(view)
        self._take_over()
        self._catch_up()
        idle = self._training is None and self._next is None
        if idle and self._trains and len(self._views) >= self._train_at:
            self._begin(len(self._views))

    def close(self) -> None:
        """Stop a training that is under way and wait for its thread; raises what it raised."""
        self._closed.set()
        if self._training is not None:
            training, self._training = self._training, None
            training.words.result()

    def words(self) -> WordsMemory | None:
        """Return what `restore` takes; None before the first training."""
        if self.trainings == 0:
            return None
        data = self._words.data or self._words.vocabulary.to_bytes()
        return WordsMemory(data, self._trained_at, self.trainings)

    def restore(self, views: list[View], words: WordsMemory | None) -> None:
        """Take over the views of an earlier run and where its words stood; raises DataError when they are damaged.

        A training that was under way begins again, and is taken over when it would have been.
        """
        self._views = list(views)
        if words is not None:
            vocabulary = Vocabulary.from_bytes(words.data, "of the session")
            self._words = _Words(vocabulary, InvertedIndex(vocabulary.idf), words.data)
        vocabulary = self._words.vocabulary
        bags = side_by_side(lambda block: [vocabulary.transform(view.descriptors) for view in block], views)
        for view, bag in zip(views, bags, strict=True):
            self._words.index.add(view.id, bag)
        if words is None:
            return
        self._trained_at, self.trainings = words.trained_at, words.trainings
        self._train_at = self._following(words.trained_at)
        due, step = words.trained_at + self._lag(words.trained_at), 1 + self._config.catch_up_keyframes
        behind = len(views) - words.trained_at - step * max(0, len(views) - due + 1)
        if not self._trains or behind <= 0:
            return
        self.trainings -= 1
        self._begin(words.trained_at)
        if len(views) >= due:
            self._take_over()
            if self._next is not None:
                for view in self._views[words.trained_at : len(views) - behind]:
                    self._next.add(view)

    def _following(self, count: int) -> int:
        """Return at how many keyframes the training after one at `count` begins."""
        return max(count + 1, int(self._config.training_growth * count))

    def _lag(self, count: int) -> int:
        return max(self._config.min_training_lag, int(_TRAINING_LAG_SHARE * count))

    def _begin(self, count: int) -> None:
        """Begin to train on the first `count` views."""
        views = tuple(self._views[:count])
        if not any(len(view.descriptors) for view in views):
            return
        # a pool for one job: its thread ends with it
        pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="vislam-words")
        job = partial(_train, self._config, self._seed + self.trainings, views, self._closed)
        self._training = _Training(pool.submit(job), count + self._lag(count))
        pool.shutdown(wait=False)
        self._trained_at, self._train_at = count, self._following(count)
        self.trainings += 1
        self.revision += 1

    def _take_over(self) -> None:
        if self._training is not None and len(self._views) >= self._training.due:
            training, self._training = self._training, None
            self._next = training.words.result()

    def _catch_up(self) -> None:
        """Index some keyframes that the training did not see yet; with the last one its words come into use."""
        if self._next is None:
            return
        done = len(self._next.index)
        for view in self._views[done : done + 1 + self._config.catch_up_keyframes]:
            self._next.add(view)
        if len(self._next.index) == len(self._views):
            self._words, self._next = self._next, None
            self.revision += 1


def _train(config: LoopConfig, seed: int, views: tuple[View, ...], closed: Event) -> _Words | None:
    """Train on views and index them; None when closed meanwhile."""
    images = [view.descriptors for view in views]
    branching = config.vocabulary_branching
    depth = depth_for(sum(len(image) for image in images), branching, config.vocabulary_depth)
    vocabulary = train(images, branching, depth, seed, config.training_descriptors)
    words = _Words(vocabulary, InvertedIndex(vocabulary.idf), vocabulary.to_bytes())
    for view in views:
        if closed.is_set():
            return None
        words.add(view)
    return words
