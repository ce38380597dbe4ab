"""One camera of a rig as the one whose image is followed: while cam0 is covered, stereo goes on with cam1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert
from vislam.core.messages import Array, Frame, ImageU8, Observations
from vislam.frontend.depth import DepthSensor
from vislam.frontend.stereo import StereoDepth
from vislam.vision.features import detect_corners
from vislam.vision.landmarks import move


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera, its place on the body, and what measures depth in its image."""

    camera: Camera
    T_body_cam: Array  # [4, 4]
    depth: DepthSensor
    is_swapped: bool = False  # whether it looks through cam1; cam0 then plays its part

    def of(self, frame: Frame) -> Frame:
        """Return the frame with this camera's image first; done twice, it is the frame again."""
        if not self.is_swapped or len(frame.images) < 2:
            return frame
        return replace(frame, images=(frame.images[1], frame.images[0], *frame.images[2:]))

    def carry(self, points: Array, covariances: Array, other: View) -> tuple[Array, Array]:
        """Return inverse-depth points [N, 3] of this camera as another sees them, and their covariances [N, 3, 3]."""
        return move(points, covariances, np.asarray(invert(self.T_body_cam) @ other.T_body_cam))

    def as_other_would(
        self, other: View, ids: NDArray[np.int64], xy: Array, means: Array, covariances: Array, gate_px: float
    ) -> Observations:
        """Return what another camera would see of tracks [N] that this one sees at `xy` [N, 2], to `gate_px`.

        The depth is that of landmarks `means` [N, 3] of the same instant, with covariances [N, 3, 3]; tracks whose
        place it does not tell so well are left out.
        """
        covariance = np.zeros_like(covariances)
        covariance[:, 2, 2] = covariances[:, 2, 2]
        points, covariance = self.carry(np.column_stack([xy, means[:, 2]]), covariance, other)
        pixels = other.camera.project(np.column_stack([points[:, :2], np.ones(len(points))]))
        told = other.camera.contains(pixels) & (other.camera.fx * spread(covariance) < gate_px)
        return Observations(ids[told], pixels[told])


def stereo_views(rig: Rig, config: FrontEndConfig) -> tuple[View, View]:
    """Return the first two cameras of a rig, each with the other for depth."""
    swapped = Rig((rig.cameras[1], rig.cameras[0]), (rig.T_body_cams[1], rig.T_body_cams[0]))
    return (
        View(rig.cameras[0], rig.T_body_cams[0], StereoDepth(rig, config)),
        View(rig.cameras[1], rig.T_body_cams[1], StereoDepth(swapped, config), is_swapped=True),
    )


def spread(covariances: Array) -> Array:
    """Return how far directions [N] scatter, of landmarks with covariances [N, 3, 3]."""
    return np.asarray(np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]))


def sees(image: ImageU8, config: FrontEndConfig) -> bool:
    """Return whether an image shows enough to start from: a covered camera's does not."""
    wanted = config.min_start_corners
    corners = detect_corners(
        image, wanted, config.cell_px, config.min_distance_px, np.empty((0, 2)), config.min_corner_response
    )
    return len(corners) >= wanted
