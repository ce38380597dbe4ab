"""From tracks to a lens: which focal length fits at all, then the whole lens, with what the stretches say against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vislam.calibration.self_calibration.adjust import (
    Piece,
    Prior,
    Shared,
    adjust,
    judged,
    scatter_px,
)
from vislam.calibration.self_calibration.segments import Segment
from vislam.calibration.self_calibration.start import placed_points, start_structure
from vislam.calibration.self_calibration.structure import READOUT, SHARED
from vislam.core.camera import Camera
from vislam.core.messages import Bools

_FACTORS = (0.64, 0.8, 1.0, 1.25, 1.56)
_SIGMA_PX = 0.5  # before residuals tell
_LEAST_SIGMA_PX = 0.05


def prior_of(camera: Camera) -> Prior:
    mean = np.array([0.0, 0.0, camera.cx, camera.cy, 0.0, 0.0, 0.0, 0.0, 0.0])
    centre = 0.04 * camera.width
    k = [0.5, 0.5, 0.01, 0.01] if camera.distortion == "radtan" else [0.3, 0.3, 0.3, 0.3]
    sigma = np.array([np.inf, np.inf, centre, centre, *k, 0.02])
    return Prior(mean, 1.0 / sigma**2, 1.0 / 0.01**2)


def only(*places: int) -> Bools:
    free = np.zeros(SHARED, dtype=np.bool_)
    free[list(places)] = True
    return free


def begun(segments: Sequence[Segment], camera: Camera) -> list[Piece]:
    pieces = []
    for segment in segments:
        found = start_structure(segment, camera)
        if found is not None:
            pieces.append(Piece(segment, found[0], np.isfinite(segment.pixels[:, :, 0]) & found[1]))
    return pieces


def replaced(piece: Piece, camera: Camera) -> Piece:
    found = placed_points(piece.segment, camera, piece.at.R, piece.at.centre, piece.at.origin)
    if found is None:
        return piece
    at, known = found
    return Piece(piece.segment, at, np.isfinite(piece.segment.pixels[:, :, 0]) & known)
