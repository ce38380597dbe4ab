"""AprilTags as witnesses of a place: a keyframe that sees a tag again is where the tag hangs.

Without a known size a tag only selects keyframes to compare; with one, its four corners also give the relative pose
where there is too little else to match. Pose by IPPE (Collins and Bartoli, IJCV 2014), which yields two solutions for a
plane: where both fit the corners, none is taken.
"""

import cv2
import numpy as np

from vislam.config import LoopConfig
from vislam.core.camera import Camera
from vislam.core.geometry import invert, se3_adjoint, skew
from vislam.core.memory import TagSighting
from vislam.core.messages import Array, Frame
from vislam.loop.candidates import Candidate
from vislam.loop.verification import Verification
from vislam.vision.features import are_used, find_tags

_CORNER_SIGMA_PX = 0.5  # 0.1 to 0.6 px measured on rendered tags of 88 down to 30 px
_MIN_SIDE_PX = 30.0  # smaller tags are read, but their corners are off by more
_MIN_CHI2_APART = 25.0  # of the two solutions' residuals; nearer, and noise may decide between them


def sight_tags(frame: Frame, camera: Camera, config: LoopConfig) -> tuple[TagSighting, ...]:
    """Return the tags that cam0 of a frame sees; one that is seen twice in an image is ambiguous and left out."""
    if config.tags == "off" or not frame.images:
        return ()
    ids, corners_px = find_tags(frame.images[0], config.tags, _MIN_SIDE_PX)
    sightings = []
    for tag_id, corners in zip(ids.tolist(), corners_px, strict=True):
        if (mask := frame.mask(0)) is not None and not are_used(mask, corners).all():
            continue
        side_px = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
        if side_px < _MIN_SIDE_PX or np.count_nonzero(ids == tag_id) > 1:
            continue
        T, covariance = None, None
        if config.tag_size_m is not None:
            T, covariance = _tag_pose(camera, corners, config.tag_size_m) or (None, None)
        sightings.append(TagSighting(tag_id, side_px, T, covariance))
    return tuple(sightings)


def _tag_pose(camera: Camera, corners_px: Array, size_m: float) -> tuple[Array, Array] | None:
    """Return T_cam_tag [4, 4] and its covariance [6, 6]; None where the corners fit two poses."""
    xy = camera.normalise(corners_px)
    if not np.isfinite(xy).all():
        return None
    half = size_m / 2.0
    corners_m = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    found, rotations, translations, errors = cv2.solvePnPGeneric(
        corners_m, xy, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    sigma = _CORNER_SIGMA_PX * 2.0 / (camera.fx + camera.fy)
    chi2 = np.ravel(errors) ** 2 * corners_m[:, :2].size / sigma**2  # OpenCV gives the root mean square
    if not found or (len(chi2) > 1 and chi2[1] - chi2[0] < _MIN_CHI2_APART):
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotations[0])[0], np.ravel(translations[0])
    J = np.vstack([_corner_jacobian(T, corner) for corner in corners_m])
    return T, np.asarray(np.linalg.inv(J.T @ J) * sigma**2, dtype=np.float64)


def _corner_jacobian(T_cam_tag: Array, corner_m: Array) -> Array:
    """Return d(x/z, y/z) / d(perturbation of the tag) [2, 6]."""
    x, y, z = T_cam_tag[:3, :3] @ corner_m + T_cam_tag[:3, 3]
    by_point = np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]])
    return np.asarray(by_point @ T_cam_tag[:3, :3] @ np.hstack([-skew(corner_m), np.eye(3)]), dtype=np.float64)


class TagBook:
    """Which keyframes saw which tags."""

    def __init__(self) -> None:
        self._sightings: dict[int, tuple[TagSighting, ...]] = {}  # by keyframe
        self._seen_in: dict[int, list[int]] = {}  # by tag

    @property
    def is_empty(self) -> bool:
        """Whether no tag was seen so far."""
        return not self._sightings

    def of(self, keyframe_id: int) -> tuple[TagSighting, ...]:
        """Return what a keyframe saw."""
        return self._sightings.get(keyframe_id, ())

    def add(self, keyframe_id: int, sightings: tuple[TagSighting, ...]) -> None:
        """Take note of what a keyframe saw."""
        if sightings:
            self._sightings[keyframe_id] = sightings
        for sighting in sightings:
            self._seen_in.setdefault(sighting.tag_id, []).append(keyframe_id)

    def candidates(self, keyframe_id: int, newest_id: int, count: int) -> list[Candidate]:
        """Return at most `count` keyframes up to `newest_id` that saw a tag of this one; who saw one largest first."""
        wanted = {sighting.tag_id for sighting in self._sightings.get(keyframe_id, ())}
        sides: dict[int, float] = {}
        for tag_id in sorted(wanted):
            old = [k for k in self._seen_in[tag_id] if k <= newest_id]
            best = max(old, key=lambda k: (self._side_px(k, tag_id), -k), default=None)
            if best is not None:
                sides[best] = max(sides.get(best, 0.0), self._side_px(best, tag_id))
        order = sorted(sides, key=lambda k: (-sides[k], k))
        return [Candidate(k, "tag", 1.0) for k in order[:count]]

    def verify(self, from_id: int, to_id: int, T_body_cam: Array, config: LoopConfig) -> Verification | None:
        """Return the relative pose of two keyframes by the best tag that both saw; None where none gives poses."""
        pairs = [
            (min(a.side_px, b.side_px), a, b)
            for a in self._sightings.get(from_id, ())
            for b in self._sightings.get(to_id, ())
            if a.tag_id == b.tag_id and a.T_cam_tag is not None and b.T_cam_tag is not None
        ]
        if not pairs:
            return None
        _, a, b = max(pairs, key=lambda pair: pair[0])
        assert a.T_cam_tag is not None and a.covariance is not None
        assert b.T_cam_tag is not None and b.covariance is not None
        carry = se3_adjoint(T_body_cam @ b.T_cam_tag)
        floor_rad = np.deg2rad(config.sigma_floor_deg)
        floor = np.diag([floor_rad**2] * 3 + [config.sigma_floor_m**2] * 3)
        covariance = np.asarray(carry @ (a.covariance + b.covariance) @ carry.T + floor)
        return Verification(
            reason="", matches=4, inliers=4, supporters=4,
            T_a_b=T_body_cam @ a.T_cam_tag @ invert(T_body_cam @ b.T_cam_tag),
            covariance=0.5 * (covariance + covariance.T),
            sigma_m=float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])),
        )  # fmt: skip

    def _side_px(self, keyframe_id: int, tag_id: int) -> float:
        return next(s.side_px for s in self._sightings[keyframe_id] if s.tag_id == tag_id)
