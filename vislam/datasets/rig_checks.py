"""How what several cameras show fits their places: epipolar lines of a pair, and what should look alike nowhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from vislam.core.camera import Rig
from vislam.core.findings import Finding
from vislam.core.geometry import invert, skew
from vislam.core.messages import Array, ImageU8

_MATCH_RATIO = 0.8
_EPIPOLAR_LIMIT_PX = 2.0
_MIN_MATCHES = 60  # of a pair, over all frames
_MIN_ON_LINE = 0.5
_ALIKE = 60.0  # matches per frame that two cameras have which see the same; such as do not have about ten by chance


def judged_cameras(rig: Rig, frames: Sequence[tuple[ImageU8, ...]]) -> list[Finding]:
    """Return what images of some frames say of the cameras' places; frames without images are passed over.

    Raises DataError where the first pair sits at one place.
    """
    frames = [images for images in frames if images]
    found = [_judged_pair(rig, [(images[0], images[1]) for images in frames])] if rig.is_stereo else []
    for one, other in combinations(range(len(rig.cameras)), 2):
        cameras, T_body_cams = zip(*((rig.cameras[k], rig.T_body_cams[k]) for k in (one, other)), strict=True)
        if Rig(cameras, T_body_cams).is_stereo:
            continue
        pairs = [images for images in frames if len(images) > other and images[one].size and images[other].size]
        alike = sum(len(_match(images[one], images[other])) for images in pairs) / max(len(pairs), 1)
        if alike > _ALIKE:
            text = f"cam{one} and cam{other} show the same ({alike:.0f} matches a frame), which their places rule out"
            step = "check T_BS of both, and that neither has the other's images"
            found.append(Finding("error", text, f"cam{other}", step))
    for camera in rig.further:
        if not any(finding.where == f"cam{camera}" for finding in found):
            found.append(Finding("ok", "makes no pair with cam0: tracks of its own", f"cam{camera}"))
    return found


def _judged_pair(rig: Rig, pairs: Sequence[tuple[ImageU8, ImageU8]]) -> Finding:
    facts = epipolar_facts(rig, pairs)
    what = f"stereo: {100 * facts.on_line:.0f} % of {facts.matches} matches lie on their epipolar line"
    if facts.matches < _MIN_MATCHES:
        return Finding("warning", f"stereo: only {facts.matches} matches, too few to judge", "cam1", "more texture")
    if facts.fits:
        return Finding("ok", what, "cam1")
    is_off = facts.on_line < _MIN_ON_LINE
    what += ": the extrinsics do not fit" if is_off else ", but behind the cameras"
    return Finding("error", what, "cam1", _tried(rig, pairs) or "check T_BS of both cameras, or calibrate them again")


def _tried(rig: Rig, pairs: Sequence[tuple[ImageU8, ImageU8]]) -> str:
    """Return which of the usual mistakes would explain that a pair does not fit, as what to do then."""
    cameras, (T0, T1) = rig.cameras[:2], rig.T_body_cams[:2]
    exchanged = Rig(cameras[::-1], (T1, T0))
    tries = (
        ("write the inverse of both T_BS", Rig(cameras, (invert(T0), invert(T1)))),
        ("write the inverse of cam1's pose in cam0", Rig(cameras, (T0, T0 @ invert(rig.T_cam0_cam1)))),
        ("swap their images", exchanged),
    )
    if any(epipolar_facts(rig, [pair]).fits for pair in pairs):
        count = sum(epipolar_facts(exchanged, [pair]).fits for pair in pairs)
        return f"swap their images in {count} of {len(pairs)} frames looked at" if count else ""
    found = ((step, epipolar_facts(tried, pairs)) for step, tried in tries)
    return ", or ".join(f"{step} ({100 * facts.on_line:.0f} % fit then)" for step, facts in found if facts.fits)


@dataclass(frozen=True, slots=True)
class EpipolarFacts:
    """How matched features of stereo pairs fit the extrinsics."""

    matches: int
    on_line: float  # fraction of matches within 2 px of their epipolar line
    in_front: float  # fraction of those that lie in front of both cameras

    @property
    def fits(self) -> bool:
        """Whether most are where the extrinsics have them."""
        return min(self.on_line, self.in_front) >= _MIN_ON_LINE


def epipolar_facts(rig: Rig, pairs: Iterable[tuple[ImageU8, ImageU8]]) -> EpipolarFacts:
    """Match ORB features between the cameras and compare with the epipolar geometry of the rig.

    Raises DataError where both cameras sit at one place.
    """
    rig.check_baseline()
    T_cam1_cam0 = invert(rig.T_cam0_cam1)
    R, t = T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3]
    E = skew(t) @ R
    matches, on_line, in_front = 0, 0, 0
    for left, right in pairs:
        pixels = _match(left, right)
        first, second = rig.cameras[0].unproject(pixels[:, :2]), rig.cameras[1].unproject(pixels[:, 2:])
        usable = np.all(np.isfinite(np.hstack([first, second])), axis=1)
        first, second = first[usable], second[usable]
        lines1, lines0 = first @ E.T, second @ E
        slope = np.sum(lines1[:, :2] ** 2, axis=1) + np.sum(lines0[:, :2] ** 2, axis=1)
        sampson_px = np.abs(np.sum(second * lines1, axis=1)) / np.sqrt(np.maximum(slope, 1e-18)) * rig.cameras[0].fx
        close = sampson_px < _EPIPOLAR_LIMIT_PX
        matches += len(first)
        on_line += int(close.sum())
        in_front += _count_in_front(first[close] @ R.T, second[close], t)
    return EpipolarFacts(matches, on_line / max(matches, 1), in_front / max(on_line, 1))


def _match(left: ImageU8, right: ImageU8) -> Array:
    """Return matched pixels [N, 4] (left x, y, right x, y) that pass the ratio test."""
    orb = cv2.ORB.create(nfeatures=800)
    points0, descriptors0 = orb.detectAndCompute(left, None)
    points1, descriptors1 = orb.detectAndCompute(right, None)
    if descriptors0 is None or descriptors1 is None or len(points1) < 2:
        return np.empty((0, 4))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors0, descriptors1, k=2)
    good = [m[0] for m in pairs if len(m) == 2 and m[0].distance < _MATCH_RATIO * m[1].distance]
    return np.array([[*points0[m.queryIdx].pt, *points1[m.trainIdx].pt] for m in good]).reshape(-1, 4)


def _count_in_front(rays0: Array, rays1: Array, t: Array) -> int:
    """Count points with positive depth on both rays: least squares of depth0 * ray0 + t = depth1 * ray1, cam1 axes."""
    a, b, c = np.sum(rays0**2, axis=1), np.sum(rays0 * rays1, axis=1), np.sum(rays1**2, axis=1)
    d, e = rays0 @ t, rays1 @ t
    # times the determinant a c - b b, which is never negative and near zero for points far away: those count as seen
    depth0, depth1 = b * e - c * d, a * e - b * d
    far = (a * c - b * b) < 1e-6 * a * c
    return int(np.count_nonzero(far | ((depth0 > 0.0) & (depth1 > 0.0))))
