"""Vocabularies that change under a run: when, deterministically, without a keyframe lost, a thread left or an error."""

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vislam.loop.words.database as database_module
from vislam.config import LoopConfig
from vislam.core.errors import DataError
from vislam.loop.view import View
from vislam.loop.words.database import PlaceDatabase, seed_vocabulary
from vislam.loop.words.vocabulary import train
from waiting import wait_for

CONFIG = LoopConfig()
NOTHING = np.empty(0, dtype=np.int64)


def make_views(count: int, seed: int = 0, features: int = 60) -> list[View]:
    """Views along a way: each sees half of what the one before saw."""
    rng = np.random.default_rng(seed)
    world = rng.integers(0, 256, (features * (count + 1) // 2, 32), dtype=np.uint8)
    views = []
    for i in range(count):
        seen = world[i * features // 2 :][:features]
        noisy = seen ^ np.packbits(rng.random((len(seen), 256)) < 0.03, axis=1)
        views.append(View(i, i, noisy, np.zeros((len(seen), 2), np.float32), None))
    return views


def words_in_use(config: LoopConfig, views: list[View]) -> tuple[list[int], list[Any]]:
    """Return after which counts of keyframes the words changed, and everything that queries answered."""
    database, changes, answers = PlaceDatabase(config, 5), [], []
    last = database.vocabulary.hash
    for count, view in enumerate(views, start=1):
        answers.append(database.query(view, 5, NOTHING))
        database.add(view)
        if database.vocabulary.hash != last:
            changes.append(count)
            last = database.vocabulary.hash
    database.close()
    return changes, [last, *answers]


def slowed(function: Callable[..., Any], delay_s: float) -> Callable[..., Any]:
    def slow(*arguments: Any) -> Any:
        time.sleep(delay_s)
        return function(*arguments)

    return slow


def test_words_change_at_the_same_keyframes_however_long_a_training_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    views = make_views(130)
    changes, answers = words_in_use(CONFIG, views)
    assert changes == [22, 27, 33, 40, 49, 60, 75, 94, 117]  # trained at 20, 25, 31, ..., 112; 2 to 5 come meanwhile
    monkeypatch.setattr(database_module, "train", slowed(train, 0.1))
    assert words_in_use(CONFIG, views) == (changes, answers)


def test_nothing_that_came_during_a_training_is_lost() -> None:
    views, slow = make_views(140), replace(CONFIG, first_training=50, training_growth=2.0, catch_up_keyframes=2)
    assert words_in_use(slow, views)[0] == [52, 106]  # at 105 five are missing, three are caught up with a keyframe
    database = PlaceDatabase(slow, 0)
    for view in views:
        database.add(view)
        for asked in (views[0], views[view.id // 2], view):
            assert database.query(asked, 1, NOTHING)[0] == [asked.id]
    assert database.trainings == 2
    database.close()


def test_the_seed_serves_before_the_first_training() -> None:
    views = make_views(6)
    database = PlaceDatabase(CONFIG, 0)
    for view in views:
        database.add(view)
    assert database.vocabulary.hash == seed_vocabulary().hash
    assert database.query(views[2], 3, NOTHING)[0][0] == 2
    database.close()


@pytest.mark.parametrize(("setting", "trainings"), [("auto", 0), ("always", 1), ("never", 0)])
def test_a_vocabulary_that_was_given_stays_unless_told_otherwise(tmp_path: Path, setting: Any, trainings: int) -> None:
    views = make_views(23)
    given = train([view.descriptors for view in make_views(9, seed=7)], 8, 3, 0, 10_000)
    given.save(tmp_path / "mine.npz")
    config = replace(CONFIG, vocabulary=str(tmp_path / "mine.npz"), train=setting)
    database = PlaceDatabase(config, 0)
    assert database.vocabulary.hash == given.hash
    for view in views:
        database.add(view)
    assert database.trainings == trainings
    assert (database.vocabulary.hash == given.hash) == (trainings == 0)
    database.close()


def test_a_vocabulary_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "no.npz").write_text("10 6 0 0")
    for name in ("no.npz", "missing.npz"):
        with pytest.raises(DataError, match=name):
            PlaceDatabase(replace(CONFIG, vocabulary=str(tmp_path / name)), 0)


def failing(*_: Any) -> None:
    raise MemoryError("as if there were no memory")


def test_what_fails_in_a_training_is_raised_when_it_is_due(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database_module, "train", failing)
    database, views = PlaceDatabase(CONFIG, 0), make_views(22)
    for view in views[:21]:
        database.add(view)
    with pytest.raises(MemoryError, match="as if"):
        database.add(views[21])
    database.close()


def test_closing_ends_the_thread_and_raises_what_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def workers() -> list[str]:
        return [thread.name for thread in threading.enumerate() if thread.name.startswith("vislam-words")]

    views = make_views(20)
    for work, error in ((train, None), (failing, MemoryError)):
        released = threading.Event()

        def held(*arguments: Any, work: Callable[..., Any] = work, released: threading.Event = released) -> Any:
            assert released.wait(600.0)
            return work(*arguments)

        monkeypatch.setattr(database_module, "train", held)
        database = PlaceDatabase(CONFIG, 0)
        for view in views:
            database.add(view)
        assert workers()
        released.set()
        if error is None:
            database.close()
        else:
            with pytest.raises(error):
                database.close()
        wait_for(lambda: not workers())
        database.close()  # twice does no harm


def test_a_run_that_was_ended_anywhere_goes_on_as_if_it_were_not() -> None:
    views = make_views(70, features=30)
    config = replace(CONFIG, min_training_lag=6, catch_up_keyframes=1)  # so that it is cut in every phase of a training
    whole = PlaceDatabase(config, 3)
    kept = []
    for view in views:
        whole.add(view)
        kept.append((whole.words(), whole.vocabulary.hash, whole.query(views[0], 5, NOTHING)))
    whole.close()
    for cut in range(1, 60, 2):
        resumed = PlaceDatabase(config, 3)
        resumed.restore(views[:cut], kept[cut - 1][0])
        for view, (words, vocabulary, answer) in zip(views[cut:], kept[cut:], strict=True):
            resumed.add(view)
            assert (resumed.vocabulary.hash, resumed.query(views[0], 5, NOTHING)) == (vocabulary, answer)
            again = resumed.words()
            assert (again is None) == (words is None)
            if again is not None and words is not None:
                assert asdict(again) == asdict(words)
        resumed.close()


def test_keyframes_without_features_are_no_reason_to_train() -> None:
    blind = [replace(view, descriptors=view.descriptors[:0]) for view in make_views(30)]
    database = PlaceDatabase(CONFIG, 0)
    for view in blind:
        database.add(view)
        assert database.query(view, 5, NOTHING) == ([], [])
    assert database.trainings == 0
    database.close()
