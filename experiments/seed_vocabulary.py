"""Make the vocabulary that serves the first keyframes of a run again: vislam/loop/words/seed_vocabulary.npz.

    .venv/bin/python experiments/seed_vocabulary.py

It comes from images that the simulator renders, so there is nobody to ask for a licence; about two minutes. Worlds of
seed 0 are left out: measurements use them.
"""

from __future__ import annotations

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
    cv2.setNumThreads(1)
    sources = tuple(
        f"sim:{world},world_seed={seed},camera_hz={rate_hz},rig=mono"
        for seed in WORLD_SEEDS
        for world, rate_hz in WORLDS.items()
    )
    vocabulary, images, _ = train_vocabulary(sources, depth=DEPTH)
    path = ROOT / "vislam" / "loop" / "words" / "seed_vocabulary.npz"
    vocabulary.save(path)
    print(f"{vocabulary.word_count} words from {images} images, {path.stat().st_size} bytes, {vocabulary.hash}")


if __name__ == "__main__":
    main()
