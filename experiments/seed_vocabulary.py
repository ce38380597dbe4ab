"""Make the vocabulary that serves the first keyframes of a run again: vislam/loop/words/seed_vocabulary.npz.

    .venv/bin/python experiments/seed_vocabulary.py

It comes from images that the simulator renders, so there is nobody to ask for a licence; about two minutes. Worlds of
seed 0 are left out: measurements use them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from vislam.runs.offline.train_vocabulary import train_vocabulary  # noqa: E402

WORLDS = {"workshop-cart": 0.5, "handheld-room": 1.0, "corridor-loop": 0.5}  # images per second: all show new things
WORLD_SEEDS = (1, 2, 3)
DEPTH = 4  # 10,000 words, 360 kB


def main() -> None:
    """Render, train, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "vislam" / "loop" / "words" / "seed_vocabulary.npz")
    parser.add_argument("--seeds", type=int, nargs="+", default=WORLD_SEEDS, help="of the worlds")
    parser.add_argument("--duration-s", type=float, help="only the first so many seconds of each world")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    length = "" if arguments.duration_s is None else f",duration_s={arguments.duration_s:g}"
    sources = tuple(
        f"sim:{world},world_seed={seed},camera_hz={rate_hz},rig=mono{length}"
        for seed in arguments.seeds
        for world, rate_hz in WORLDS.items()
    )
    vocabulary, images, _ = train_vocabulary(sources, depth=DEPTH)
    vocabulary.save(arguments.out)
    print(
        f"{vocabulary.word_count} words from {images} images, {arguments.out.stat().st_size} bytes, {vocabulary.hash}"
    )


if __name__ == "__main__":
    main()
