"""Pictures that explain loop decisions: both images of a candidate side by side, with the matches between them."""

import re
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.files import replacing, storage
from vislam.core.messages import Array, ImageU8, LoopDecision
from vislam.loop import LoopRow
from vislam.pipeline.steps import KeyframeStep

FOLDER = "loops"
_WIDTH_PX = 300  # of one image
_THUMBNAIL_QUALITY = 60
_QUALITY = 75
_MAX_THUMBNAIL_BYTES = 64 * 2**20  # 8,000 keyframes or so; the oldest are forgotten first
_MAX_MATCHED = 20_000  # candidates whose matches are kept: 13 MB
_ACCEPTED = 12  # pictures of each kind
_OTHERS = 12
_PER_REASON = 4
_COLORS = {"accepted": (90, 190, 60), "pending": (60, 180, 230), "rejected": (70, 70, 220)}  # BGR


class LoopGallery:
    """Keeps thumbnails while a run goes on, and writes the pairs most worth seeing when all is decided."""

    def __init__(self) -> None:
        """Start empty."""
        self._thumbnails: dict[int, tuple[NDArray[np.uint8], float]] = {}  # JPEG and its scale, oldest first
        self._bytes = 0
        self._matches: deque[tuple[int, NDArray[np.float32]]] = deque(maxlen=_MAX_MATCHED)
        self._candidates = 0

    def skip(self, candidates: int) -> None:
        """Leave out candidates of an earlier process, whose pictures are gone."""
        self._candidates += candidates

    def add(self, step: KeyframeStep) -> None:
        """Remember a keyframe's picture, and the matches of its candidates; those come in the order of loops.csv."""
        keyframe = step.odometry.packet.keyframe
        frame = keyframe.frame
        if frame.images:
            self._keep(keyframe.id, frame.images[0])
        for candidate in step.candidates:
            if candidate.matches_px is not None:
                self._matches.append((self._candidates, candidate.matches_px.astype(np.float32)))
            self._candidates += 1

    def _keep(self, keyframe_id: int, image: ImageU8) -> None:
        scale = _WIDTH_PX / image.shape[1]
        small = cv2.resize(image, (_WIDTH_PX, max(round(image.shape[0] * scale), 1)), interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY])[1]
        self._thumbnails[keyframe_id] = (jpeg, scale)
        self._bytes += jpeg.nbytes
        while self._bytes > _MAX_THUMBNAIL_BYTES:
            oldest = next(iter(self._thumbnails))
            self._bytes -= self._thumbnails.pop(oldest)[0].nbytes

    def write(self, out: Path, rows: Sequence[LoopRow]) -> list[tuple[LoopRow, Path]]:
        """Write the pictures of chosen candidates into a folder of the run; return each with its path.

        `rows` are all candidates with their final decisions. Chosen are the accepted ones that moved the map most, and
        of the others those that came closest to being accepted, of each keyframe one, of each reason a few.
        """
        matches = dict(self._matches)
        known = [
            k
            for k, row in enumerate(rows)
            if k in matches and row.from_id in self._thumbnails and row.to_id in self._thumbnails
        ]
        written = []
        for place, k in enumerate(chosen(rows, known)):
            row = rows[k]
            path = out / FOLDER / f"{place:02d}_{row.from_id}_{row.to_id}_{row.decision}.jpg"
            picture = self._draw(row, matches[k].astype(np.float64))
            with storage(path):
                path.parent.mkdir(exist_ok=True)
                with replacing(path) as file:
                    file.write(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())
            written.append((row, path))
        return written

    def _draw(self, row: LoopRow, matches_px: Array) -> ImageU8:
        """Return the two images side by side, the older one left, with lines between what was matched."""
        images = [self._thumbnails[keyframe_id] for keyframe_id in (row.from_id, row.to_id)]
        pair = [cv2.cvtColor(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE), cv2.COLOR_GRAY2BGR) for jpeg, _ in images]
        picture = np.hstack(pair)
        scale, color = images[0][1], _COLORS[row.decision]
        for x_a, y_a, x_b, y_b in matches_px[np.isfinite(matches_px).all(axis=1)] * scale:
            a, b = (round(x_a * 16), round(y_a * 16)), (round((x_b + pair[0].shape[1]) * 16), round(y_b * 16))
            cv2.line(picture, a, b, color, 1, cv2.LINE_AA, 4)
            for end in (a, b):
                cv2.circle(picture, end, 2 * 16, color, 1, cv2.LINE_AA, 4)
        return np.asarray(picture, dtype=np.uint8)


def chosen(rows: Sequence[LoopRow], known: Sequence[int]) -> list[int]:
    """Return which of the known rows are shown, as indices: accepted ones first, each kind in order of interest."""

    def moved(k: int) -> tuple[float, float, int]:
        return (-np.nan_to_num(rows[k].moved_max_m), -rows[k].inliers, k)

    def close(k: int) -> tuple[float, float, int]:
        return (-np.nan_to_num(rows[k].supporters), -rows[k].inliers, k)

    accepted = sorted((k for k in known if rows[k].decision == LoopDecision.ACCEPTED), key=moved)
    others = sorted((k for k in known if rows[k].decision != LoopDecision.ACCEPTED), key=close)
    taken = {(rows[k].from_id, rows[k].to_id) for k in accepted}  # pending first, accepted later: is shown there
    reasons: Counter[str] = Counter()
    shown: list[int] = []
    for k in others:
        kind = re.sub(r"\d+(\.\d+)?", "…", rows[k].reason)
        if (rows[k].from_id, rows[k].to_id) in taken or reasons[kind] == _PER_REASON or len(shown) == _OTHERS:
            continue
        if any(rows[k].to_id == rows[other].to_id for other in shown):
            continue
        reasons[kind] += 1
        shown.append(k)
    return _one_per_keyframe(rows, accepted)[:_ACCEPTED] + shown


def _one_per_keyframe(rows: Sequence[LoopRow], order: Sequence[int]) -> list[int]:
    seen: dict[int, int] = {}
    for k in order:
        seen.setdefault(rows[k].to_id, k)
    return list(seen.values())
