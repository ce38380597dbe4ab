"""Image features: detect corners, follow them, describe and match keypoints. Only here is OpenCV asked for features.

Corners are Shi-Tomasi (CVPR 1994), followed by pyramidal Lucas-Kanade (Bouguet 2000) with a forward-backward check
(Kalal, ICPR 2010); keypoints are ORB (Rublee, ICCV 2011). OpenCV's Python binding of Lucas-Kanade refuses pyramids
built beforehand, so images go in as they are; a pyramid costs 0.6 ms of the 4 ms that 400 corners take.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array, Bools, ImageU8
from vislam.vision.hamming import packed, popcount

Indices = NDArray[np.int64]
Descriptors = NDArray[np.uint8]
Words = NDArray[np.uint64]

_BORDER_PX = 12  # corners nearer to the border lose half of their window as soon as the camera moves
_ORB_FAST_THRESHOLD, _ORB_CELL_PX = 10, 40
_ORB_BORDER_PX = 31  # ORB's patch; OpenCV drops keypoints nearer to the border
_AT_ONCE_PX = 8  # columns of a window that OpenCV's Lucas-Kanade takes at once; the rest costs as much one by one
LEAST_USED = 128  # in a mask: a pixel of less is not used
_NO_INDICES = np.empty((0, 2), dtype=np.int64)


@dataclass(frozen=True, slots=True)
class FlowSettings:
    """How Lucas-Kanade follows a corner from one image to another."""

    window_px: int = 21  # side of a square as large as the window, which is a multiple of eight pixels wide
    levels: int = 3  # pyramid levels above the full image: the reach is about window / 2 * 2^levels
    back_levels: int = 0  # the way back starts at the true place, so the image itself does
    max_back_px: float = 0.7  # largest distance between a corner and where the way back ends
    min_eigenvalue: float = 1e-4  # of the normalised gradient matrix; windows below are flat
    iterations: int = 30
    epsilon_px: float = 0.01  # stopped earlier, corners stay short on the side of the guess
    back_iterations: int = 10
    back_epsilon_px: float = 0.1  # the way back only has to separate right from wrong


def detect_corners(
    image: ImageU8, count: int, cell_px: int, min_distance_px: float, live: Array, quality: float,
    mask: ImageU8 | None = None,
) -> Array:  # fmt: skip
    """Find new corners where the image is not yet covered.

    Args:
        image: grey image [H, W].
        count: at most this many new corners.
        cell_px: side of the grid cells that share `count` fairly: strongest of each cell first, then the second, ...
        min_distance_px: from every live corner and from each other.
        live: pixels [M, 2] of corners that are already followed; NaN rows are ignored.
        quality: least response, as the smaller eigenvalue of the mean gradient matrix in (grey levels / px)^2.
        mask: [H, W], see `Frame.masks`.

    Returns:
        Pixels [N, 2], N <= count, in order of choice.
    """
    if count <= 0:
        return np.empty((0, 2))
    response = cv2.cornerMinEigenVal(image, 5, ksize=3)
    peaks = response >= cv2.dilate(response, np.ones((3, 3), np.uint8))
    # OpenCV scales the eigenvalue of 8-bit images: Sobel 3 has gain 8 per grey level and px, then 1 / (4 * 5 * 255)
    scale = (8.0 / (4.0 * 5.0 * 255.0)) ** 2 * 25.0
    peaks &= response > quality * scale
    if mask is not None:
        peaks &= mask >= LEAST_USED
    peaks[:_BORDER_PX], peaks[-_BORDER_PX:], peaks[:, :_BORDER_PX], peaks[:, -_BORDER_PX:] = False, False, False, False
    rows, columns = np.nonzero(peaks)
    strengths = response[rows, columns]
    candidates = np.column_stack([columns, rows]).astype(np.float64)
    rank = _rank_in_cells(candidates, strengths, cell_px, image.shape[1])
    order = np.lexsort((-strengths, rank))
    usable = live[np.isfinite(live).all(axis=1)]
    chosen = _choose_apart(candidates[order], usable, count, min_distance_px, image.shape[1], image.shape[0])
    return candidates[order][chosen]


def detect_harris(
    image: ImageU8, boxes: Array, count: int, min_distance_px: float, live: Array, used: ImageU8 | None = None
) -> Array:
    """Find new Harris corners (Harris and Stephens, AVC 1988), box by box.

    Args:
        image: grey image [H, W].
        boxes: left, top, right, bottom [B, 4] in pixels.
        count: of corners in each box, those that are followed included.
        min_distance_px: from every live corner and from each other.
        live: pixels [M, 2] of corners that are already followed.
        used: a mask [H, W], see `Frame.masks`.

    Returns:
        Pixels [N, 2], box by box, strongest first.
    """
    found = []
    for left, top, right, bottom in boxes.astype(np.int64).tolist():
        inside = (live >= (left, top)).all(axis=1) & (live < (right, bottom)).all(axis=1)
        wanted = count - int(np.count_nonzero(inside))
        if wanted <= 0 or right - left < _BORDER_PX or bottom - top < _BORDER_PX:
            continue
        mask = np.full((bottom - top, right - left), 255, dtype=np.uint8)
        if used is not None:
            mask[used[top:bottom, left:right] < LEAST_USED] = 0
        for x, y in live[inside]:
            cv2.circle(mask, (round(x) - left, round(y) - top), round(min_distance_px), 0, -1)
        corners = cv2.goodFeaturesToTrack(
            image[top:bottom, left:right], wanted, 0.02, min_distance_px, mask=mask, blockSize=3,
            useHarrisDetector=True, k=0.04,
        )  # fmt: skip
        if corners is not None:
            found.append(np.asarray(corners, dtype=np.float64).reshape(-1, 2) + np.array([left, top]))
    return np.vstack(found) if found else np.empty((0, 2))


def noise_grey(image: ImageU8) -> float:
    """Return the standard deviation of an image's noise in grey levels (Immerkaer, CVIU 1996, with a median).

    Texture as fine as a pixel counts as noise.
    """
    kernel = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=np.float32)
    rough = cv2.filter2D(image, cv2.CV_32F, kernel)[1:-1:2, 1:-1:2]
    return float(1.4826 * np.median(np.abs(rough)) / 6.0)


def _rank_in_cells(points: Array, strengths: NDArray[np.float32], cell_px: int, width: int) -> Indices:
    """Return how many stronger points [N] share each point's cell, so that cells are served in turn."""
    columns = width // cell_px + 1
    cells = (points[:, 1] // cell_px).astype(np.int64) * columns + (points[:, 0] // cell_px).astype(np.int64)
    order = np.lexsort((-strengths, cells))
    sorted_cells = cells[order]
    starts = np.flatnonzero(np.r_[True, sorted_cells[1:] != sorted_cells[:-1]]) if len(cells) else np.empty(0, np.int64)
    sizes = np.diff(np.r_[starts, len(cells)])
    rank = np.empty(len(cells), dtype=np.int64)
    rank[order] = np.arange(len(cells)) - np.repeat(starts, sizes)
    return rank


@njit(cache=True, nogil=True)
def _choose_apart(points: Array, live: Array, count: int, distance: float, width: int, height: int) -> Indices:
    """Return indices of points taken in order that keep `distance` from the live ones and from those taken before."""
    side = max(distance, 1.0)
    columns, rows = int(width / side) + 1, int(height / side) + 1
    # a bucket as wide as the distance holds few points; what overflows is only checked less strictly
    slots = 8
    bucket = np.zeros((rows, columns, slots, 2))
    filled = np.zeros((rows, columns), dtype=np.int64)
    for i in range(len(live)):
        column, row = int(live[i, 0] / side), int(live[i, 1] / side)
        if 0 <= column < columns and 0 <= row < rows and filled[row, column] < slots:
            bucket[row, column, filled[row, column]] = live[i]
            filled[row, column] += 1
    chosen = np.empty(min(count, len(points)), dtype=np.int64)
    taken = 0
    for i in range(len(points)):
        if taken >= count:
            break
        column, row = int(points[i, 0] / side), int(points[i, 1] / side)
        free = True
        for r in range(max(0, row - 1), min(rows, row + 2)):
            for c in range(max(0, column - 1), min(columns, column + 2)):
                for k in range(filled[r, c]):
                    dx, dy = bucket[r, c, k, 0] - points[i, 0], bucket[r, c, k, 1] - points[i, 1]
                    free = free and dx * dx + dy * dy >= distance * distance
        if free:
            chosen[taken] = i
            taken += 1
            if filled[row, column] < slots:
                bucket[row, column, filled[row, column]] = points[i]
                filled[row, column] += 1
    return chosen[:taken]


def follow(
    source: ImageU8, target: ImageU8, pixels: Array, guess: Array, settings: FlowSettings, mask: ImageU8 | None = None
) -> tuple[Array, Array]:
    """Follow corners [N, 2] of `source` into `target`, starting at `guess` [N, 2] (NaN: not tried).

    Returns:
        Pixels [N, 2] in target and the mean grey difference [N] of the windows. Both are NaN where the corner was lost:
        outside the image or what its `mask` [H, W] lets be used, or not back at its start within `max_back_px` when
        followed the other way.
    """
    found, difference = np.full(pixels.shape, np.nan), np.full(len(pixels), np.nan)
    tried = np.flatnonzero(np.isfinite(pixels).all(axis=1) & _near(guess, target))
    if len(tried) == 0:
        return found, difference
    start = pixels[tried].astype(np.float32)
    forth = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, settings.iterations, settings.epsilon_px)
    returns = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, settings.back_iterations, settings.back_epsilon_px)
    there, seen, error = _flow(source, target, start, guess[tried].astype(np.float32), settings.levels, forth, settings)
    back, seen_back, _ = _flow(target, source, there, start, settings.back_levels, returns, settings)
    good = seen & seen_back & (np.linalg.norm(back - start, axis=1) <= settings.max_back_px)
    height, width = target.shape
    good &= (there[:, 0] >= 0.0) & (there[:, 0] <= width - 1) & (there[:, 1] >= 0.0) & (there[:, 1] <= height - 1)
    if mask is not None:
        good[good] = are_used(mask, there[good])
    found[tried[good]] = there[good]
    difference[tried[good]] = error[good]
    return found, difference


def are_used(mask: ImageU8, pixels: NDArray[np.floating]) -> Bools:
    """Return which pixels [N, 2] of an image a mask [H, W] lets be used, see `Frame.masks`."""
    rows, columns = np.clip(np.rint(pixels[:, ::-1]).astype(np.int64), 0, np.array(mask.shape) - 1).T
    return np.asarray(mask[rows, columns] >= LEAST_USED)


def _near(pixels: Array, image: ImageU8) -> Bools:
    """Return which pixels [N, 2] are not absurdly far outside the image (OpenCV's integers overflow there)."""
    height, width = image.shape
    with np.errstate(invalid="ignore"):
        inside = (np.abs(pixels[:, 0] - width / 2) < width) & (np.abs(pixels[:, 1] - height / 2) < height)
    return np.asarray(inside, dtype=np.bool_)


def _flow(
    source: ImageU8,
    target: ImageU8,
    pixels: NDArray[np.float32],
    guess: NDArray[np.float32],
    levels: int,
    criteria: tuple[int, int, float],
    s: FlowSettings,
) -> tuple[NDArray[np.float32], Bools, NDArray[np.float32]]:
    width = max(round(s.window_px / _AT_ONCE_PX) * _AT_ONCE_PX, _AT_ONCE_PX)
    there, status, error = cv2.calcOpticalFlowPyrLK(
        source, target, pixels[:, None], guess[:, None].copy(), winSize=(width, max(round(s.window_px**2 / width), 3)),
        maxLevel=levels, criteria=criteria, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=s.min_eigenvalue,
    )  # fmt: skip
    return there[:, 0], status[:, 0] == 1, error[:, 0]


def describe(image: ImageU8, count: int = 1000, mask: ImageU8 | None = None) -> tuple[Array, Descriptors]:
    """Find and describe ORB keypoints spread over a grey image [H, W], or what its mask [H, W] lets be used of it.

    Three times too many are detected over eight octaves and served cell by cell, so that one rich corner of the image
    does not take them all.

    Returns:
        Pixels [N, 2] and descriptors [N, 32], N <= count; both empty for an image without features.
    """
    orb = cv2.ORB.create(3 * count, fastThreshold=_ORB_FAST_THRESHOLD, edgeThreshold=_ORB_BORDER_PX)
    keypoints = orb.detect(image, None if mask is None else np.where(mask >= LEAST_USED, mask, np.uint8(0)))
    if not keypoints:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    pixels = _places(keypoints)
    strengths = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
    rank = _rank_in_cells(pixels, strengths, _ORB_CELL_PX, image.shape[1])
    chosen: Sequence[int] = np.lexsort((-strengths, rank))[:count].tolist()
    kept, descriptors = orb.compute(image, [keypoints[i] for i in chosen])
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    return _places(kept), np.asarray(descriptors, dtype=np.uint8)


def _places(keypoints: Sequence[cv2.KeyPoint]) -> Array:
    return np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64)


def match(
    descriptors_a: Descriptors, descriptors_b: Descriptors, ratio: float = 0.8, max_distance: int = 64
) -> Indices:
    """Match binary descriptors [N, 32] and [M, 32] by Hamming distance.

    A pair counts when each is the other's nearest, at most `max_distance` bits apart and nearer than `ratio` times the
    second nearest in b (Lowe 2004).

    Returns:
        Index pairs [K, 2] into a and b, ascending in a.
    """
    if len(descriptors_a) == 0 or len(descriptors_b) == 0:
        return _NO_INDICES.copy()
    return np.asarray(_match(packed(descriptors_a), packed(descriptors_b), ratio, max_distance), dtype=np.int64)


def find_tags(image: ImageU8, family: str, min_side_px: float) -> tuple[Indices, Array]:
    """Find AprilTags (Olson 2011) of a family, as "36h11", in a grey image [H, W].

    Tags with sides well below `min_side_px` are not looked for, which saves most of the time.

    Returns:
        Ids [T], ascending, and corners [T, 4, 2] in pixels: top left of the tag first, then clockwise as printed.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.minMarkerPerimeterRate = 0.8 * 4.0 * min_side_px / max(image.shape)  # outlines come out a little short
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{family}"))
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if ids is None:
        return np.empty(0, np.int64), np.empty((0, 4, 2))
    found = np.asarray(ids, np.int64).reshape(-1)
    order = np.argsort(found, kind="stable")
    return found[order], np.asarray(corners, np.float64).reshape(-1, 4, 2)[order]


@njit(cache=True, nogil=True)
def _match(a: Words, b: Words, ratio: float, max_distance: int) -> Indices:
    """Match packed descriptors [N, 4] and [M, 4]; loops without a branch, over columns, become vector instructions."""
    worst = np.uint64(64 * b.shape[1] + 1)
    b0, b1, b2, b3 = b[:, 0].copy(), b[:, 1].copy(), b[:, 2].copy(), b[:, 3].copy()
    distances = np.empty(len(b), np.uint64)
    nearest_b = np.full(len(b), worst, np.uint64)  # bits to the nearest in a of each in b
    owner = np.full(len(b), -1, np.int64)
    nearest = np.full(len(a), -1, np.int64)
    passes = np.zeros(len(a), np.bool_)
    for i in range(len(a)):
        a0, a1, a2, a3 = a[i]
        for j in range(len(b)):
            distances[j] = (
                popcount(a0 ^ b0[j]) + popcount(a1 ^ b1[j]) + popcount(a2 ^ b2[j]) + popcount(a3 ^ b3[j])
            )  # fmt: skip
        for j in range(len(b)):
            nearer = distances[j] < nearest_b[j]
            nearest_b[j] = distances[j] if nearer else nearest_b[j]
            owner[j] = i if nearer else owner[j]
        first = np.uint64(2**63)  # distance and index in one number: the least one is the first of the nearest
        for j in range(len(b)):
            first = min(first, (distances[j] << np.uint64(32)) | np.uint64(j))
        nearest[i], bits = np.int64(first & np.uint64(2**32 - 1)), np.int64(first >> np.uint64(32))
        distances[nearest[i]] = worst
        second = worst
        for j in range(len(b)):
            second = min(second, distances[j])
        passes[i] = bits <= max_distance and bits < ratio * np.int64(second)
    pairs = np.empty((len(a), 2), dtype=np.int64)
    count = 0
    for i in range(len(a)):
        if passes[i] and owner[nearest[i]] == i:
            pairs[count, 0], pairs[count, 1] = i, nearest[i]
            count += 1
    return pairs[:count]
