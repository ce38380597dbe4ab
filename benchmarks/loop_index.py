"""How long the vocabulary and the inverted index take, up to 200,000 keyframes.

    .venv/bin/python benchmarks/loop_index.py --sources tum:PATH euroc:PATH --picture docs/images/loop_index.png

Keyframes are made as the notes on peers made theirs: 70 % of the descriptors of one image, 30 % of any, 20 of 256 bits
flipped, 1,000 in all, walked down the real tree. Queries are such keyframes too, with the 20 newest excluded. Beside
each query a peer answers the same question in the same process: scipy's sparse product of weights (a dot product, not
even the L1 score), and every pair scored in turn by compiled code up to 5,000 keyframes. Times are CPU time of the
thread, in ms; 50,000 keyframes take 0.5 GB, 200,000 take 1 GB and about five minutes.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from scipy.sparse import csc_matrix  # noqa: E402

from vislam.core.messages import Frame  # noqa: E402
from vislam.loop.words.index import InvertedIndex  # noqa: E402
from vislam.loop.words.vocabulary import BagOfWords, Vocabulary, depth_for, train  # noqa: E402
from vislam.runs.sources import open_source  # noqa: E402
from vislam.vision.features import describe  # noqa: E402

FEATURES = 1000
SIZES = (1_000, 5_000, 10_000, 50_000, 200_000)
DBOW2_MS = {1_000: 1.7, 5_000: 13.0, 10_000: 30.0}  # the notes' measurement here, same features, k=10 L=6
SPARSE_UP_TO, PAIRS_UP_TO = 50_000, 5_000  # keyframes; more take gigabytes, or seconds a query
QUERIES = 40


def read_images(sources: list[str]) -> list[np.ndarray]:
    """Return the descriptors [N, 32] of every image of the sources."""
    cv2.setNumThreads(1)
    frames = (event for source in sources for event in open_source(source).events() if isinstance(event, Frame))
    return [describe(image, FEATURES)[1] for frame in frames for image in frame.images]


def make_keyframe(images: list[np.ndarray], pool: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return descriptors [1000, 32] of a made-up keyframe."""
    image = images[int(rng.integers(len(images)))]
    own = image[rng.integers(0, len(image), FEATURES * 7 // 10)]
    chosen = np.concatenate([own, pool[rng.integers(0, len(pool), FEATURES - len(own))]])
    bits = rng.integers(0, 256, (FEATURES, 20))
    for flip in bits.T:
        chosen[np.arange(FEATURES), flip >> 3] ^= (1 << (flip & 7)).astype(np.uint8)
    return chosen


def spent_ms(work: Callable[[], object]) -> float:
    """Return the CPU time of this thread in ms."""
    begin = time.thread_time()
    work()
    return (time.thread_time() - begin) * 1e3


def summary(times: list[float]) -> str:
    """Return smallest, median and 95th percentile."""
    values = np.array(times)
    return f"{values.min():7.3f} {np.median(values):7.3f} {np.percentile(values, 95):7.3f}"


def sparse_ms(bags: list[BagOfWords], queries: list[BagOfWords], words: int) -> list[float]:
    """Return the times of scipy's sparse product for the ten best."""
    rows = np.repeat(np.arange(len(bags), dtype=np.int32), [len(bag.words) for bag in bags])
    columns = np.concatenate([bag.words for bag in bags])
    values = np.concatenate([bag.weights for bag in bags]).astype(np.float32)
    matrix = csc_matrix((values, (rows, columns)), shape=(len(bags), words))

    def ask(bag: BagOfWords) -> None:
        scores = np.asarray(matrix[:, bag.words] @ bag.weights.astype(np.float32))
        np.argpartition(-scores, 10)

    return [spent_ms(lambda bag=bag: ask(bag)) for bag in queries[:10]]


def grow(vocabulary: Vocabulary, images: list[np.ndarray], sizes: list[int], seed: int) -> dict[int, float]:
    """Print the times at each size; return the median of a query."""
    rng, index = np.random.default_rng(seed), InvertedIndex(vocabulary.idf)
    pool = np.concatenate(images)
    kept: list[BagOfWords] = []
    walks: list[float] = []
    adds: list[float] = []
    medians: dict[int, float] = {}
    print("                          min  median     p95  (ms of CPU time)")
    for number in range(max(sizes)):
        descriptors = make_keyframe(images, pool, rng)
        found: list[BagOfWords] = []
        walks.append(spent_ms(lambda: found.append(vocabulary.transform(descriptors))))  # noqa: B023
        adds.append(spent_ms(lambda: index.add(number, found[0])))  # noqa: B023
        if number < SPARSE_UP_TO and number < max(sizes):
            kept.append(found[0])
        if number + 1 not in sizes:
            continue
        size = number + 1
        asked = [vocabulary.transform(make_keyframe(images, pool, rng)) for _ in range(QUERIES)]
        newest = np.arange(max(0, size - 20), size)
        times = [spent_ms(lambda bag=bag: index.query(bag, 10, newest)) for bag in asked]  # noqa: B023
        medians[size] = float(np.median(times))
        print(f"{size:7d}  query         {summary(times)}   {index.bytes_used / 1e6:.0f} MB", flush=True)
        print(f"         add           {summary(adds[-1000:])}\n         transform     {summary(walks[-1000:])}")
        if size <= SPARSE_UP_TO:
            print(f"         scipy sparse  {summary(sparse_ms(kept, asked, vocabulary.word_count))}", flush=True)
        if size <= PAIRS_UP_TO:
            pairs = [spent_ms(lambda bag=bag: [bag.score(old) for old in kept]) for bag in asked[:3]]
            print(f"         every pair    {summary(pairs)}", flush=True)
    return medians


def draw(curves: dict[str, dict[int, float]], path: Path) -> None:
    """Draw the growth curves beside DBoW2's."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for label, curve in curves.items():
        axes.loglog(list(curve), list(curve.values()), marker="o", label=label)
    axes.loglog(list(DBOW2_MS), list(DBOW2_MS.values()), marker="s", color="0.5", label="DBoW2, k=10 L=6")
    axes.plot([50_000, 200_000], [1.0, 3.0], "k_", markersize=14, label="targets")
    axes.set(xlabel="keyframes of 1,000 descriptors", ylabel="query [ms of CPU time, median]")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Read the command line, train both vocabularies, measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--sources", nargs="+", default=["sim:handheld-room,camera_hz=5", "sim:corridor-loop,camera_hz=2"]
    )
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES))
    parser.add_argument("--depths", nargs="+", type=int, default=[5, 6], help="levels of the trees that are measured")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, help="PNG to draw")
    args = parser.parse_args()
    images = read_images(args.sources)
    print(f"{len(images)} images; vislam would take depth {depth_for(sum(map(len, images)), 10, 6)} for these alone")
    curves = {}
    for depth in args.depths:
        begin = time.thread_time()
        vocabulary = train(images, 10, depth, args.seed, 500_000)
        print(
            f"k=10 L={depth}: {vocabulary.word_count} words, trained in {time.thread_time() - begin:.1f} s", flush=True
        )
        curves[f"vislam, L={depth}, {vocabulary.word_count // 1000},000 words"] = grow(
            vocabulary, images, sorted(args.sizes), args.seed
        )
    if args.picture:
        draw(curves, args.picture)


if __name__ == "__main__":
    main()
