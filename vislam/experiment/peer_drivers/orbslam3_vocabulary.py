"""A vocabulary for ORB-SLAM3 of the images at hand, for a machine that cannot fetch ORBvoc.txt.

    python orbslam3_vocabulary.py OUT.txt IMAGES...

DBoW2's text format: branching 10, depth 6, k-majority over ORB descriptors of up to 120 of the images, seed 0. It is
some tenth of ORBvoc.txt (139 MB), so loading it takes less time and memory.
"""

import sys

import cv2
import numpy as np

BRANCHES, DEPTH = 10, 6
_IMAGES = 120
_ROUNDS = 6
_SMALLEST = 3  # distinct descriptors; a node with fewer is a word
_BITS = np.array([bin(byte).count("1") for byte in range(256)], dtype=np.uint8)


def described(paths):
    """Return ORB descriptors [N, 32] of images and the index of the image of each [N]."""
    orb = cv2.ORB_create(600, 1.2, 8)
    found = [orb.detectAndCompute(cv2.imread(path, cv2.IMREAD_GRAYSCALE), None)[1] for path in paths]
    owners = [np.full(len(rows), i) for i, rows in enumerate(found) if rows is not None]
    return np.concatenate([rows for rows in found if rows is not None]), np.concatenate(owners)


def nearest(rows, centres):
    """Return the nearest centre of each row [N] by Hamming distance."""
    return np.stack([_BITS[rows ^ centre].sum(axis=1) for centre in centres], axis=1).argmin(axis=1)


def split(rows, rng):
    """Return the branch of each row [N] and the descriptor of each branch."""
    if len(rows) <= BRANCHES:
        return np.arange(len(rows)), rows.copy()
    centres = rows[rng.choice(len(rows), BRANCHES, replace=False)].copy()
    for _ in range(_ROUNDS):
        branch = nearest(rows, centres)
        for k in range(BRANCHES):
            own = rows[branch == k]
            centres[k] = np.packbits(np.unpackbits(own, axis=1).mean(axis=0) >= 0.5) if len(own) else rng.choice(rows)
    return nearest(rows, centres), centres


def grow(nodes, parent, rows, owners, level, rng):
    """Append the nodes below `parent`: (parent, whether it is a word, images that have it, descriptor)."""
    branch, centres = split(rows, rng)
    kids = []
    for k in np.unique(branch):
        own = branch == k
        is_word = level == DEPTH or len(np.unique(rows[own], axis=0)) <= _SMALLEST
        nodes.append((parent, is_word, len(np.unique(owners[own])), centres[k]))
        if not is_word:
            kids.append((len(nodes), own))
    for node, own in kids:
        grow(nodes, node, rows[own], owners[own], level + 1, rng)


def main():
    """Train and write."""
    out, paths = sys.argv[1], sorted(sys.argv[2:])
    chosen = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, _IMAGES).astype(int))]
    rows, owners = described(chosen)
    nodes = []
    grow(nodes, 0, rows, owners, 1, np.random.default_rng(0))
    with open(out, "w") as file:
        file.write(f"{BRANCHES} {DEPTH} 0 0")
        for parent, is_word, images, descriptor in nodes:
            weight = np.log(len(chosen) / images) if is_word else 0.0
            file.write(f"\n{parent} {int(is_word)} {' '.join(map(str, descriptor.tolist()))} {weight:.6f}")


if __name__ == "__main__":
    main()
