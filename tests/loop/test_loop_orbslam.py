"""ORB-SLAM's text vocabulary: read as it was meant, and scored as DBoW2 does; damaged ones refused with the line."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.cli import run_verb
from vislam.core.errors import DataError
from vislam.loop.words.index import InvertedIndex
from vislam.loop.words.orbslam import read_orbslam
from vislam.loop.words.vocabulary import Vocabulary

BRANCHING, DEPTH = 5, 3


class Dbow2:
    """DBoW2's TemplatedVocabulary (TF_IDF, L1_NORM) for a text file, transcribed line for line into plain Python."""

    def __init__(self, text: str) -> None:
        lines = text.splitlines()
        self.nodes: list[dict] = [{"children": [], "word": None}]
        self.words: list[dict] = []
        for line in lines[1:]:  # loadFromTextFile
            parent, leaf, *rest = line.split()
            node = {"descriptor": [int(byte) for byte in rest[:32]], "weight": float(rest[32]), "children": []}
            self.nodes[int(parent)]["children"].append(node)
            self.nodes.append(node)
            if int(leaf) > 0:
                node["word"] = len(self.words)
                self.words.append(node)

    def word(self, feature: list[int]) -> dict:
        """transform(feature, word_id, weight): the first of the nearest children."""
        node = self.nodes[0]
        while node["children"]:
            best = 10**9
            for child in node["children"]:
                d = sum((a ^ b).bit_count() for a, b in zip(feature, child["descriptor"], strict=True))
                if d < best:
                    best, node = d, child
        return node

    def transform(self, image: np.ndarray) -> dict[int, float]:
        """transform(features, v): add the weight for each occurrence, then normalise by the L1 norm."""
        v: dict[int, float] = {}
        for feature in image.tolist():
            node = self.word(feature)
            if node["weight"] > 0:
                v[node["word"]] = v.get(node["word"], 0.0) + node["weight"]
        norm = sum(abs(value) for value in v.values())
        return {word: value / norm for word, value in sorted(v.items())} if norm > 0.0 else v

    @staticmethod
    def score(v: dict[int, float], w: dict[int, float]) -> float:
        """L1Scoring::score: sum of |vi - wi| - |vi| - |wi| over common words, over -2."""
        total = 0.0
        for word in v.keys() & w.keys():
            total += abs(v[word] - w[word]) - abs(v[word]) - abs(w[word])
        return -total / 2.0

    def set_weights(self, images: list[np.ndarray]) -> list[float]:
        """setNodeWeights: log(NDocs / Ni)."""
        counts = [0] * len(self.words)
        for image in images:
            for word in {self.word(feature)["word"] for feature in image.tolist()}:
                counts[word] += 1
        return [math.log(len(images) / n) if n else 0.0 for n in counts]


def make_text(seed: int, shuffled: bool = False) -> str:
    """A random tree in DBoW2's order (children together, then depth first) or in any that names parents first."""
    rng = np.random.default_rng(seed)
    lines: list[str] = []
    waiting = [(0, 0)]  # number, level
    while waiting:
        at = int(rng.integers(0, len(waiting))) if shuffled else len(waiting) - 1
        parent, level = waiting.pop(at)
        for _ in range(int(rng.integers(1, BRANCHING + 1))):
            leaf = level + 1 == DEPTH or (level > 0 and rng.random() < 0.2)
            octets = " ".join(str(x) for x in rng.integers(0, 256, 32))
            weight = f"{rng.uniform(0.0, 9.0):.6g}" if leaf and rng.random() < 0.9 else "0"
            lines.append(f"{parent} {int(leaf)} {octets}  {weight}")
            if not leaf:
                waiting.append((len(lines), level + 1))
    return f"{BRANCHING} {DEPTH}  0 0\n" + "\n".join(lines) + "\n"


def image_near(text: str, seed: int, features: int = 40) -> np.ndarray:
    """Descriptors near some of the tree's."""
    rng = np.random.default_rng(seed)
    rows = [[int(x) for x in line.split()[2:34]] for line in text.splitlines()[1:]]
    chosen = np.array(rows, dtype=np.uint8)[rng.integers(0, len(rows), features)]
    return chosen ^ np.packbits(rng.random((features, 256)) < 0.1, axis=1)


def read(tmp_path: Path, text: str) -> Vocabulary:
    (tmp_path / "voc.txt").write_text(text)
    return read_orbslam(tmp_path / "voc.txt")


@given(st.integers(0, 10_000), st.booleans())
def test_weights_and_scores_are_dbow2s(tmp_path_factory: pytest.TempPathFactory, seed: int, shuffled: bool) -> None:
    text = make_text(seed, shuffled)
    ours, theirs = read(tmp_path_factory.mktemp("v"), text), Dbow2(text)
    assert ours.word_count == len(theirs.words)
    images = [image_near(text, seed + i) for i in range(4)]
    bags = [ours.transform(image) for image in images]
    plain = [theirs.transform(image) for image in images]
    index = InvertedIndex(ours.idf)
    for i, bag in enumerate(bags):
        index.add(i, bag)
        # words are numbered differently, weights are the same
        np.testing.assert_allclose(np.sort(bag.weights), np.sort(list(plain[i].values())), rtol=1e-12, atol=0.0)
    ids, scores = index.query(bags[0], 4)
    for i in range(4):
        expected = Dbow2.score(plain[0], plain[i])
        assert bags[0].score(bags[i]) == pytest.approx(expected, abs=1e-12)
        found = dict(zip(ids.tolist(), scores.tolist(), strict=True)).get(i, 0.0)
        assert found == pytest.approx(expected, abs=1e-6)


def test_training_weighs_words_as_dbow2() -> None:
    from vislam.loop.words.vocabulary import train

    text = make_text(3)
    images = [image_near(text, i) for i in range(8)]
    trained = train(images, 4, 2, 0, 10_000)
    theirs = Dbow2("4 2 0 0\n")
    theirs.words = [{} for _ in range(trained.word_count)]
    theirs.word = lambda feature: {"word": int(trained.words(np.array([feature], dtype=np.uint8))[0])}  # type: ignore[method-assign]
    np.testing.assert_allclose(trained.idf, theirs.set_weights(images), rtol=1e-12)


@pytest.mark.parametrize(
    ("line", "change", "says"),
    [
        (1, lambda f: "ORB vocabulary", "line 1"),
        (1, lambda f: "10 6 0 1", "weighting 1"),
        (1, lambda f: "1000 6 0 0", "branching 1000"),
        (1, lambda f: "2 3 0 0", "more children"),
        (1, lambda f: "5 1 0 0", "deeper"),
        (4, lambda f: " ".join(["4", *f[1:]]), "line 4: a parent"),
        (4, lambda f: " ".join(["-1", *f[1:]]), "line 4: a parent"),
        (4, lambda f: " ".join(["99999999999999999999", *f[1:]]), "line 4: a parent"),
        (4, lambda f: " ".join([f[0], "2", *f[2:]]), "line 4: a 0 or 1"),
        (4, lambda f: " ".join([*f[:5], "256", *f[6:]]), "line 4: 32 bytes"),
        (4, lambda f: " ".join(f[:20]), "line 4: 32 bytes"),
        (4, lambda f: " ".join([*f[:34], "nan"]), "line 4: a weight"),
        (4, lambda f: " ".join([*f[:34], "-1.5"]), "line 4: a weight"),
        (4, lambda f: " ".join([*f[:34], "1e999"]), "line 4: a weight"),
        (4, lambda f: " ".join([*f[:34], "1.2.3"]), "line 4: a weight"),
        (4, lambda f: " ".join([*f, "7"]), "line 4: there is more"),
        (4, lambda f: "", "line 4: a parent"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, line: int, change, says: str) -> None:
    lines = make_text(1).splitlines()
    lines[line - 1] = change(lines[line - 1].split())
    with pytest.raises(DataError, match=says) as error:
        read(tmp_path, "\n".join(lines) + "\n")
    assert "voc.txt" in str(error.value)


def test_a_parent_that_is_a_leaf_is_refused(tmp_path: Path) -> None:
    octets = " ".join(["7"] * 32)
    with pytest.raises(DataError, match="line 3: the parent is a leaf"):
        read(tmp_path, f"5 3 0 0\n0 1 {octets} 1.5\n1 1 {octets} 1.5\n")


@given(st.integers(0, 2**31))
def test_a_file_that_was_cut_never_passes(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    text = make_text(seed % 50)
    cut = int(np.random.default_rng(seed).integers(0, len(text)))
    vocabulary = None
    try:
        vocabulary = read(tmp_path_factory.mktemp("v"), text[:cut])
    except DataError as error:
        assert "voc.txt" in str(error)
    if vocabulary is not None:  # cut between whole lines, where what is left is a tree
        assert text[cut - 1] == "\n"
        assert vocabulary.word_count == sum(row.split()[1] == "1" for row in text[:cut].splitlines()[1:])


@given(st.integers(0, 2**31), st.binary(max_size=300))
def test_noise_never_passes_and_never_crashes(
    tmp_path_factory: pytest.TempPathFactory, seed: int, noise: bytes
) -> None:
    path = tmp_path_factory.mktemp("v") / "voc.txt"
    rng = np.random.default_rng(seed)
    data = bytearray(make_text(seed % 20).encode())
    if seed % 2:
        at = int(rng.integers(0, len(data)))
        data[at : at + len(noise)] = noise
    else:
        data = bytearray(b"10 6 0 0\n" + noise)
    path.write_bytes(bytes(data))
    try:
        vocabulary = read_orbslam(path)
    except DataError as error:
        assert "voc.txt" in str(error)
    else:
        again = Vocabulary.from_bytes(vocabulary.to_bytes(), "again")  # passes all checks
        assert again.words(rng.integers(0, 256, (5, 32), dtype=np.uint8)).max() < vocabulary.word_count


def test_blank_lines_and_carriage_returns_at_the_end_do_no_harm(tmp_path: Path) -> None:
    text = make_text(2)
    assert read(tmp_path, text.replace("\n", "\r\n") + "\n \n").hash == read(tmp_path, text).hash


def test_the_verb_converts_and_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "voc.txt").write_text(make_text(2))
    out = str(tmp_path / "words.npz")
    assert run_verb(["vocabulary", "--from-orbslam", str(tmp_path / "voc.txt"), "--out", out]) == 0
    assert Vocabulary.load(tmp_path / "words.npz").hash == read_orbslam(tmp_path / "voc.txt").hash
    assert run_verb(["vocabulary", "--out", out]) == 2
    (tmp_path / "voc.txt").write_text("nonsense")
    assert run_verb(["vocabulary", "--from-orbslam", str(tmp_path / "voc.txt"), "--out", out]) == 3
    assert "line 1" in capsys.readouterr().err


def test_the_verb_trains_on_a_folder_of_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import cv2

    rng = np.random.default_rng(0)
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(4):
        picture = cv2.resize(rng.integers(0, 256, (24, 32), dtype=np.uint8), (320, 240), interpolation=0)
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    (folder / "4.jpg").write_bytes(b"no image")
    for name in ("a.npz", "b.npz"):
        assert run_verb(["vocabulary", str(folder), "--out", str(tmp_path / name)]) == 0
    assert "4 images (1 could not be read)" in capsys.readouterr().out
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert Vocabulary.load(tmp_path / "a.npz").word_count > 20
    assert run_verb(["vocabulary", str(tmp_path / "nowhere"), "--out", str(tmp_path / "c.npz")]) == 3
