"""One camera of a rig as the one whose image is followed: while cam0 is covered, stereo goes on with cam1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert
from vislam.core.messages import Array, Frame, ImageU8
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


def stereo_views(rig: Rig, config: FrontEndConfig) -> tuple[View, View]:
    """Return the first two cameras of a rig, each with the other for depth."""
    swapped = Rig((rig.cameras[1], rig.cameras[0]), (rig.T_body_cams[1], rig.T_body_cams[0]))
    return (
        View(rig.cameras[0], rig.T_body_cams[0], StereoDepth(rig, config)),
        View(rig.cameras[1], rig.T_body_cams[1], StereoDepth(swapped, config), is_swapped=True),
    )


def sees(image: ImageU8, config: FrontEndConfig) -> bool:
    """Return whether an image shows enough to start from: a covered camera's does not."""
    wanted = config.min_start_corners
    corners = detect_corners(
        image, wanted, config.cell_px, config.min_distance_px, np.empty((0, 2)), config.min_corner_response
    )
    return len(corners) >= wanted
