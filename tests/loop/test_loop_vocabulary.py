"""The vocabulary against a plain numpy reference of DBoW2's formulae, its determinism, and damaged files."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vislam.core.errors import DataError, StorageError
from vislam.loop.words.vocabulary import BagOfWords, Vocabulary, train


def some_images(seed: int, images: int = 12, per_image: int = 150, sources: int = 600) -> list[np.ndarray]:
    """Images that share descriptors, with a few bits flipped each time."""
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 256, (sources, 32), dtype=np.uint8)
    chosen = [base[rng.integers(0, sources, per_image)] for _ in range(images)]
    return [image ^ np.packbits(rng.random((per_image, 256)) < 0.04, axis=1) for image in chosen]


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    return train(some_images(0), branching=6, depth=3, seed=1, max_descriptors=100_000)


def slow_words(vocabulary: Vocabulary, image: np.ndarray) -> list[int]:
    """Walk down the tree in plain Python, bit by bit."""
    centres = np.unpackbits(vocabulary.nodes.view(np.uint8).reshape(-1, 32), axis=1)
    leaves = np.flatnonzero(vocabulary.child_count == 0).tolist()
    words = []
    for bits in np.unpackbits(image, axis=1):
        node = 0
        while vocabulary.child_count[node]:
            first = int(vocabulary.first_child[node])
            children = range(first, first + int(vocabulary.child_count[node]))
            node = min(children, key=lambda child: int(np.sum(centres[child] != bits)))
        words.append(leaves.index(node))
    return words


def slow_bag(vocabulary: Vocabulary, image: np.ndarray) -> dict[int, float]:
    """tf-idf as DBoW2: the idf of each occurrence added up, divided by the sum of all."""
    bag: dict[int, float] = {}
    for word in slow_words(vocabulary, image):
        if vocabulary.idf[word] > 0.0:
            bag[word] = bag.get(word, 0.0) + vocabulary.idf[word]
    total = sum(bag.values())
    return {word: weight / total for word, weight in bag.items()}


def test_words_are_those_of_a_plain_walk(vocabulary: Vocabulary) -> None:
    image = some_images(5)[0]
    assert vocabulary.words(image).tolist() == slow_words(vocabulary, image)


def test_idf_is_the_log_of_images_over_images_with_the_word(vocabulary: Vocabulary) -> None:
    images = some_images(0)
    sets = [set(slow_words(vocabulary, image)) for image in images]
    for word in range(vocabulary.word_count):
        count = sum(word in words for words in sets)
        assert vocabulary.idf[word] == pytest.approx(np.log(len(images) / count) if count else 0.0, abs=1e-12)


@given(st.integers(0, 10_000), st.integers(0, 10_000))
def test_scores_are_dbow2s(vocabulary: Vocabulary, seed_a: int, seed_b: int) -> None:
    a, b = some_images(seed_a, images=1, per_image=60)[0], some_images(seed_b, images=1, per_image=60)[0]
    slow_a, slow_b = slow_bag(vocabulary, a), slow_bag(vocabulary, b)
    distance = sum(abs(slow_a.get(w, 0.0) - slow_b.get(w, 0.0)) for w in slow_a.keys() | slow_b.keys())
    score = vocabulary.transform(a).score(vocabulary.transform(b))
    assert score == pytest.approx(1.0 - 0.5 * distance, abs=1e-12)
    assert vocabulary.transform(a).score(vocabulary.transform(a)) == pytest.approx(1.0, abs=1e-12)


def test_training_is_deterministic_and_depends_on_its_seed() -> None:
    images = some_images(3)
    first = train(images, 8, 4, seed=7, max_descriptors=100_000)
    assert train(images, 8, 4, seed=7, max_descriptors=100_000).hash == first.hash
    assert train(images, 8, 4, seed=8, max_descriptors=100_000).hash != first.hash
    assert train(images, 8, 4, seed=7, max_descriptors=500).hash != first.hash


def test_a_deep_tree_tells_every_different_descriptor_apart() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (200, 32), dtype=np.uint8)
    doubled = np.concatenate([image, image])
    vocabulary = train([doubled, image], 10, 20, seed=0, max_descriptors=100_000)
    assert vocabulary.word_count == 200
    assert len(np.unique(vocabulary.words(image))) == 200


def test_like_images_score_higher_than_unlike_ones() -> None:
    images = some_images(4, images=20)
    vocabulary = train(images, 10, 3, seed=0, max_descriptors=100_000)
    rng = np.random.default_rng(9)
    again = images[3] ^ np.packbits(rng.random((len(images[3]), 256)) < 0.03, axis=1)
    scores = [vocabulary.transform(again).score(vocabulary.transform(image)) for image in images]
    assert int(np.argmax(scores)) == 3
    assert scores[3] > 2.0 * sorted(scores)[-2]


def test_an_image_without_features_is_an_empty_bag(vocabulary: Vocabulary) -> None:
    bag = vocabulary.transform(np.empty((0, 32), dtype=np.uint8))
    assert len(bag.words) == 0
    assert bag.score(BagOfWords(np.array([1], np.int32), np.array([1], np.int32), np.array([1.0]), 1.0)) == 0.0


def test_saved_is_loaded_and_bytes_repeat(vocabulary: Vocabulary, tmp_path: Path) -> None:
    vocabulary.save(tmp_path / "a.npz")
    vocabulary.save(tmp_path / "b.npz")
    loaded = Vocabulary.load(tmp_path / "a.npz")
    assert loaded.hash == vocabulary.hash
    assert Vocabulary.from_bytes(vocabulary.to_bytes(), "kept in a session").hash == vocabulary.hash
    with pytest.raises(DataError, match="kept in a session"):
        Vocabulary.from_bytes(vocabulary.to_bytes()[:-30], "kept in a session")
    image = some_images(8)[0]
    np.testing.assert_array_equal(loaded.words(image), vocabulary.words(image))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_a_place_that_cannot_be_written_says_so(vocabulary: Vocabulary, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"gone.*cannot be written"):
        vocabulary.save(tmp_path / "gone" / "a.npz")


@given(st.integers(0, 2**31), st.sampled_from(["cut", "flip", "noise"]))
@example(500_000_000, "flip")  # the archive claims a compression that does not exist
def test_damaged_files_never_pass_and_never_crash(
    vocabulary: Vocabulary, tmp_path_factory: pytest.TempPathFactory, seed: int, damage: str
) -> None:
    path = tmp_path_factory.mktemp("v") / "v.npz"
    vocabulary.save(path)
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    if damage == "cut":
        data = data[: int(rng.integers(0, len(data)))]
    elif damage == "flip":
        for place in rng.integers(0, len(data), 20):
            data[place] ^= int(rng.integers(1, 256))
    else:
        data = bytearray(rng.integers(0, 256, 300, dtype=np.uint8).tobytes())
    path.write_bytes(bytes(data))
    try:
        loaded = Vocabulary.load(path)
    except DataError as error:
        assert "v.npz" in str(error)
    else:  # the damage hit what carries no content, such as a time stamp
        assert loaded.hash == vocabulary.hash


@pytest.mark.parametrize(
    "fault", ["child before parent", "too many children", "word weights", "nan", "format", "dtype"]
)
def test_a_tree_that_cannot_be_one_is_refused(vocabulary: Vocabulary, tmp_path: Path, fault: str) -> None:
    arrays = {
        "format": np.int64(1),
        "nodes": vocabulary.nodes,
        "first_child": vocabulary.first_child.copy(),
        "child_count": vocabulary.child_count.copy(),
        "idf": vocabulary.idf.copy(),
    }
    inner = int(np.flatnonzero(vocabulary.child_count)[-1])
    if fault == "child before parent":
        arrays["first_child"][inner] = 0  # would walk in circles for ever
    elif fault == "too many children":
        arrays["child_count"][inner] = 2**30
    elif fault == "word weights":
        arrays["idf"] = arrays["idf"][:-1]
    elif fault == "nan":
        arrays["idf"][0] = np.nan
    elif fault == "format":
        arrays["format"] = np.int64(99)
    else:
        arrays["nodes"] = arrays["nodes"].astype(np.float32)
    np.savez(tmp_path / "v.npz", **arrays)
    with pytest.raises(DataError, match=r"v\.npz"):
        Vocabulary.load(tmp_path / "v.npz")


@pytest.mark.parametrize(("rows", "mib", "why"), [(2**26, 600, "limit"), (2**50, 0, "cannot reshape")])
def test_a_file_that_claims_gigabytes_is_refused_unread(rows: int, mib: int, why: str, tmp_path: Path) -> None:
    header, version = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<u8", "fortran_order": False, "shape": (rows, 4)})
    np.save(version, np.int64(1))
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("format.npy", version.getvalue())
        with archive.open("nodes.npy", "w", force_zip64=True) as member:
            member.write(header.getvalue())
            for _ in range(mib):
                member.write(bytes(2**20))
    with pytest.raises(DataError, match=why):
        Vocabulary.load(tmp_path / "bomb.npz")


def test_pickles_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "p.npz", format=np.array([{"a": 1}], dtype=object))
    with pytest.raises(DataError, match=r"p\.npz"):
        Vocabulary.load(tmp_path / "p.npz")


def test_nothing_to_train_on_says_so() -> None:
    with pytest.raises(DataError, match="0 images"):
        train([np.empty((0, 32), dtype=np.uint8)], 10, 4, seed=0, max_descriptors=100)
    with pytest.raises(DataError, match="256-bit"):
        train([np.zeros((4, 61), dtype=np.uint8)], 10, 4, seed=0, max_descriptors=100)
