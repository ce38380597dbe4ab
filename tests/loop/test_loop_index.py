"""The inverted index against scoring every keyframe in turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.loop.words.index import InvertedIndex
from vislam.loop.words.vocabulary import BagOfWords

WORDS = 40
IDF = np.random.default_rng(0).uniform(0.01, 5.0, WORDS)


def make_bag(words: list[int], counts: list[int], idf: np.ndarray = IDF) -> BagOfWords:
    numbers = np.array(words, dtype=np.int32)
    raw = np.array(counts) * idf[numbers]
    total = float(raw.sum())
    return BagOfWords(numbers, np.array(counts, dtype=np.int32), raw / total if len(raw) else raw, total)


@st.composite
def bags(draw: st.DrawFn) -> BagOfWords:
    words = sorted(draw(st.sets(st.integers(0, WORDS - 1), max_size=15)))
    counts = st.one_of(st.just(1), st.integers(1, 4), st.integers(200, 4095))
    return make_bag(words, draw(st.lists(counts, min_size=len(words), max_size=len(words))))


@given(st.lists(bags(), max_size=30), bags(), st.integers(0, 8), st.sets(st.integers(0, 60), max_size=6))
def test_a_query_finds_what_brute_force_finds(
    stored: list[BagOfWords], asked: BagOfWords, k: int, excluded: set[int]
) -> None:
    index = InvertedIndex(IDF)
    for number, bag in enumerate(stored):
        index.add(2 * number + 1, bag)  # ids need not be dense
    brute = {2 * n + 1: asked.score(bag) for n, bag in enumerate(stored) if 2 * n + 1 not in excluded}
    expected = sorted((score for score in brute.values() if score > 0.0), reverse=True)[:k]
    for _ in range(2):  # a query leaves nothing behind
        ids, scores = index.query(asked, k, np.array(sorted(excluded), dtype=np.int64))
        np.testing.assert_allclose(scores, expected, atol=1e-6)
        for identifier, score in zip(ids.tolist(), scores.tolist(), strict=True):
            assert score == pytest.approx(brute[identifier], abs=1e-6)
        assert len(set(ids.tolist())) == len(ids)


def test_it_grows_without_losing_anything() -> None:
    rng = np.random.default_rng(0)
    idf = rng.uniform(0.1, 3.0, 300)
    index, stored = InvertedIndex(idf), []
    for number in range(400):
        words = np.sort(rng.permutation(300)[:50]).tolist()
        stored.append(make_bag(words, np.maximum(1, rng.poisson(0.7, 50)).tolist(), idf))
        index.add(number, stored[-1])
    assert len(index) == 400
    for asked in (0, 199, 399):
        ids, scores = index.query(stored[asked], 400)
        brute = np.array([stored[asked].score(bag) for bag in stored])
        assert ids[0] == asked
        np.testing.assert_allclose(scores, brute[ids], atol=1e-6)
        assert len(ids) == np.count_nonzero(brute > 0.0)


def test_a_word_that_comes_back_after_two_hundred_thousand_keyframes_is_found() -> None:
    """Distances between postings are stored in two bytes; longer ones take several."""
    index, empty = InvertedIndex(IDF), make_bag([], [])
    rare, often = make_bag([7], [1]), make_bag([7], [3])
    for number in range(200_000):
        index.add(number, {3: rare, 5: often, 131_075: rare, 199_999: often}.get(number, empty))
    assert index.query(rare, 9)[0].tolist() == [3, 5, 131_075, 199_999]
    np.testing.assert_allclose(index.query(often, 9)[1], 1.0, atol=1e-6)


def test_of_equals_the_older_comes_first() -> None:
    bag = make_bag([3], [1])
    index = InvertedIndex(IDF)
    for number in range(6):
        index.add(number, bag)
    assert index.query(bag, 3)[0].tolist() == [0, 1, 2]


def test_ids_that_do_not_ascend_are_a_fault_of_the_caller() -> None:
    index = InvertedIndex(IDF)
    bag = make_bag([3], [1])
    index.add(4, bag)
    with pytest.raises(ValueError, match="keyframe 4"):
        index.add(4, bag)
