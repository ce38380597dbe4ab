"""Observations found again by the patch of one keyframe, warped to how each other one should see it.

Tracks that are handed on from keyframe to keyframe drift, and all of a point drift together: that is what biased a
focal length most. Once structure and lens are known roughly, every view can be matched against the same patch
(Klein and Murray, ISMAR 2007; inverse compositional, Baker and Matthews, IJCV 2004).
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.calibration.self_calibration.adjust import Piece, Shared
from vislam.calibration.self_calibration.segments import Segment
from vislam.calibration.self_calibration.structure import Structure
from vislam.core.camera import Camera
from vislam.core.messages import Array, ImageU8

Indices = NDArray[np.int64]

_SIDE = 17  # px, of a patch
_STEPS = 10
_LEAST_LIKENESS = 0.8  # correlation of grey values
_FURTHEST_PX = 3.0  # from where the track was: further, it is another corner
_FLATTEST = 2.0  # (grey levels / px)^2


def found_again(piece: Piece, shared: Shared, images: Sequence[ImageU8]) -> Segment:
    """Return the stretch with pixels matched against one patch per point; those that look different are left out."""
    segment, at, camera = piece.segment, piece.at, shared.camera
    seen = np.einsum("nji,nmj->nmi", at.R, at.ray[None] - at.rho[None, :, None] * at.centre[:, None])
    home = _homes(piece)
    pixels = np.full_like(segment.pixels, np.nan)
    for k, image in enumerate(images):
        points = np.flatnonzero(piece.kept[k] & (home != k)).astype(np.int64)
        stay = np.flatnonzero(piece.kept[k] & (home == k))
        pixels[k, stay] = segment.pixels[k, stay]
        if not len(points):
            continue
        warp = _warps(camera, at, seen, home, points, k)
        here = segment.pixels[home[points], points]
        templates = np.empty((len(points), _SIDE, _SIDE))
        for h in np.unique(home[points]).tolist():
            of = home[points] == h
            templates[of] = _sampled(images[h], here[of], warp[of])
        pixels[k, points] = _aligned(templates, image, segment.pixels[k, points])
    return replace(segment, pixels=pixels)


def _homes(piece: Piece) -> Indices:
    """Return the keyframe in the middle of those that see a point [m]."""
    order = np.cumsum(piece.kept, axis=0)
    return np.argmax(order >= (order[-1] + 1) // 2, axis=0).astype(np.int64)


def _warps(camera: Camera, at: Structure, seen: Array, home: Indices, points: Indices, k: int) -> Array:
    """Return how pixels about a point at home move [N, 2, 2] with those in keyframe k, if it is flat and faces home."""
    h = home[points]
    at_home = camera.project_jacobian(seen[h, points])[:, :, :2]
    turned = np.einsum("ji,njl->nil", at.R[k], at.R[h][:, :, :2])
    here = camera.project_jacobian(seen[k, points]) @ turned
    return np.asarray(at_home @ np.linalg.pinv(here))


def _sampled(image: ImageU8, centres: Array, warps: Array) -> Array:
    """Return patches [N, S, S] about pixels [N, 2], their offsets warped by [N, 2, 2]."""
    half = _SIDE // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    offsets = np.stack([u, v], axis=-1).astype(np.float64)
    at = (centres[:, None, None] + np.einsum("nij,vuj->nvui", warps, offsets)).astype(np.float32)
    flat = at.reshape(-1, _SIDE, 2)
    patches = cv2.remap(image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(patches, dtype=np.float64).reshape(-1, _SIDE, _SIDE)


def _aligned(templates: Array, image: ImageU8, start: Array) -> Array:
    """Return where [N, 2] the image looks like templates [N, S, S], from a start [N, 2]; NaN where nowhere near."""
    window = np.outer(np.hanning(_SIDE + 2)[1:-1], np.hanning(_SIDE + 2)[1:-1])
    window /= window.sum()
    T, scale = _normalised(templates, window)
    gradients = np.stack([np.gradient(T, axis=2), np.gradient(T, axis=1)], axis=1)
    H = np.einsum("niuv,njuv,uv->nij", gradients, gradients, window)
    flat = np.linalg.eigvalsh(H)[:, 0] * scale**2 < _FLATTEST
    H[flat] = np.eye(2)
    same = np.tile(np.eye(2), (len(T), 1, 1))
    at = start.copy()
    likeness = np.zeros(len(T))
    for _ in range(_STEPS):
        patch, _ = _normalised(_sampled(image, at, same), window)
        likeness = np.einsum("nuv,nuv,uv->n", T, patch, window)
        step = np.linalg.solve(H, np.einsum("niuv,nuv,uv->ni", gradients, T - patch, window)[:, :, None])[:, :, 0]
        at = at + np.clip(step, -1.0, 1.0)
    near = np.linalg.norm(at - start, axis=1) < _FURTHEST_PX
    inside = (at > _SIDE // 2).all(axis=1) & (at < np.array(image.shape[::-1]) - 1 - _SIDE // 2).all(axis=1)
    at[~(near & inside & ~flat & (likeness > _LEAST_LIKENESS))] = np.nan
    return at


def _normalised(patches: Array, window: Array) -> tuple[Array, Array]:
    """Return patches [N, S, S] of mean zero and deviation one, and the deviation [N] that they had."""
    mean = np.einsum("nuv,uv->n", patches, window)
    centred = patches - mean[:, None, None]
    deviation = np.sqrt(np.maximum(np.einsum("nuv,nuv,uv->n", centred, centred, window), 1e-6))
    return centred / deviation[:, None, None], deviation
