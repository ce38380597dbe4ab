"""The inverted index against scoring every keyframe in turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.loop.index import InvertedIndex
from vislam.loop.vocabulary import BagOfWords

WORDS = 40


@st.composite
def bags(draw: st.DrawFn) -> BagOfWords:
    words = np.array(sorted(draw(st.sets(st.integers(0, WORDS - 1), max_size=15))), dtype=np.int32)
    raw = np.array(draw(st.lists(st.floats(0.01, 5.0), min_size=len(words), max_size=len(words))))
    return BagOfWords(words, raw / raw.sum() if len(raw) else raw)


@given(st.lists(bags(), max_size=30), bags(), st.integers(0, 8), st.sets(st.integers(0, 60), max_size=6))
def test_a_query_finds_what_brute_force_finds(
    stored: list[BagOfWords], asked: BagOfWords, k: int, excluded: set[int]
) -> None:
    index = InvertedIndex(WORDS)
    for number, bag in enumerate(stored):
        index.add(2 * number + 1, bag)  # ids need not be dense
    ids, scores = index.query(asked, k, np.array(sorted(excluded), dtype=np.int64))
    brute = {2 * n + 1: asked.score(bag) for n, bag in enumerate(stored) if 2 * n + 1 not in excluded}
    expected = sorted((score for score in brute.values() if score > 0.0), reverse=True)[:k]
    np.testing.assert_allclose(scores, expected, atol=1e-6)
    for identifier, score in zip(ids.tolist(), scores.tolist(), strict=True):
        assert score == pytest.approx(brute[identifier], abs=1e-6)
    assert len(set(ids.tolist())) == len(ids)


def test_it_grows_without_losing_anything() -> None:
    rng = np.random.default_rng(0)
    index, stored = InvertedIndex(300), []
    for number in range(400):
        words = np.sort(rng.permutation(300)[:50]).astype(np.int32)
        weights = rng.uniform(0.1, 1.0, 50)
        stored.append(BagOfWords(words, weights / weights.sum()))
        index.add(number, stored[-1])
    assert len(index) == 400
    for asked in (0, 199, 399):
        ids, scores = index.query(stored[asked], 400)
        brute = np.array([stored[asked].score(bag) for bag in stored])
        assert ids[0] == asked
        np.testing.assert_allclose(scores, brute[ids], atol=1e-5)
        assert len(ids) == np.count_nonzero(brute > 0.0)


def test_of_equals_the_older_comes_first() -> None:
    bag = BagOfWords(np.array([3], np.int32), np.array([1.0]))
    index = InvertedIndex(5)
    for number in range(6):
        index.add(number, bag)
    assert index.query(bag, 3)[0].tolist() == [0, 1, 2]


def test_ids_that_do_not_ascend_are_a_fault_of_the_caller() -> None:
    index = InvertedIndex(5)
    bag = BagOfWords(np.array([3], np.int32), np.array([1.0]))
    index.add(4, bag)
    with pytest.raises(ValueError, match="keyframe 4"):
        index.add(4, bag)
