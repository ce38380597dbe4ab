"""`LoopDetector`: places seen before, by hand: images in, relative poses or the reason why there is none out."""

from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np

from vislam.config import LoopConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.geometry import transform_points
from vislam.core.messages import Array, Frame, ImageF32, ImageU8, Keyframe
from vislam.loop.verification import Verifier
from vislam.loop.view import View, make_view
from vislam.loop.words import PlaceDatabase
from vislam.vision.features import describe

_FEATURES = 800  # per image
_NOT_SEEN_M = 0.1  # depth below is none


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """An image that was added before and looks like the one asked about, and what geometry measured of the two."""

    id: int  # of the older image, as `LoopDetector.add` returned it
    likeness: float  # 0..1 of appearance alone
    T_old_new: Array | None  # [4, 4] body to body; a unit direction without scale; None: refused
    covariance: Array | None  # [6, 6] rotation, then translation, perturbed on the side of the newer image
    has_scale: bool  # depth of one of the two was known
    inliers: int  # matches that agree with the pose
    reason: str  # why there is no pose

    def __repr__(self) -> str:
        if self.T_old_new is None:
            return f"Loop(image {self.id}, likeness {self.likeness:.2f}: refused, {self.reason})"
        x, y, z = self.T_old_new[:3, 3]
        where = f"at ({x:.3f}, {y:.3f}, {z:.3f}) {'m' if self.has_scale else 'without scale'}"
        return f"Loop(image {self.id}, likeness {self.likeness:.2f}: {where}, {self.inliers} inliers)"


class LoopDetector:
    """Recognises places: `add` an image, `query` with another one for those like it and the motions between.

        detector = LoopDetector(camera)
        detector.add(image, depth_m)
        for loop in detector.query(other_image, other_depth_m):
            print(loop.id, loop.T_old_new, loop.reason)

    Appearance (a bag of words over ORB features) ranks the images, geometry measures the motion or refuses. Its words
    are trained again on the images as they grow in number, in a thread that `close`, or the end of a `with`, ends.
    """

    def __init__(
        self, camera: Camera, T_body_cam: Array | None = None, config: LoopConfig | None = None, seed: int = 0
    ) -> None:
        """Start empty; poses are those of the body on which the camera sits at T_body_cam [4, 4], else of the camera.

        Raises DataError when the vocabulary that `config` names cannot be used.
        """
        self._config = config or LoopConfig()
        self._rig = Rig((camera,), (np.eye(4) if T_body_cam is None else T_body_cam,))
        self._places = PlaceDatabase(self._config, seed)
        self._verifier = Verifier(self._config, self._rig, seed)
        self._views: list[View] = []

    def __len__(self) -> int:
        """Return how many images were added."""
        return len(self._views)

    def __repr__(self) -> str:
        camera, features = self._rig.cameras[0], sum(len(view.xy) for view in self._views)
        return f"LoopDetector({len(self)} images of {camera.width} x {camera.height} px, {features} features)"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()

    def add(self, image: ImageU8, depth_m: ImageF32 | None = None) -> int:
        """Take a grey image [H, W], with depth [H, W] in metres where it is known (0 or NaN: not); return its id.

        Raises DataError for another shape or type.
        """
        view = self._view(image, depth_m)
        self._views.append(view)
        self._places.add(view)
        return view.id

    def query(self, image: ImageU8, depth_m: ImageF32 | None = None, count: int = 3) -> list[Loop]:
        """Return the `count` images that look most like this one, best first; it is not added. Raises as `add`."""
        view = self._view(image, depth_m)
        loops = []
        for k, likeness in zip(*self._places.query(view, count, np.empty(0, dtype=np.int64)), strict=True):
            found = self._verifier.verify(self._views[k], view)
            loops.append(Loop(k, likeness, found.T_a_b, found.covariance, found.has_scale, found.inliers, found.reason))
        return loops

    def close(self) -> None:
        """End the training that is under way, if any."""
        self._places.close()

    def _view(self, image: ImageU8, depth_m: ImageF32 | None) -> View:
        camera = self._rig.cameras[0]
        for name, array in (("image", image), ("depth", depth_m)):
            if array is not None and np.shape(array) != (camera.height, camera.width):
                asked = f"{name} [{camera.height}, {camera.width}] as its camera has it"
                raise DataError(f"asked for a grey {asked}, got {list(np.shape(array))}; convert or resize it")
        if image.dtype != np.uint8:
            raise DataError(f"asked for an image of 8 bits (uint8), got {image.dtype}; convert it")
        pixels, descriptors = describe(image, _FEATURES)
        points = None
        if depth_m is not None:
            x, y = np.round(pixels).astype(np.int64).T
            z = depth_m[y, x].astype(np.float64)
            z[~(z > _NOT_SEEN_M)] = np.nan
            points = transform_points(self._rig.T_body_cams[0], camera.unproject(pixels) * z[:, None])
        n = len(self._views)
        return make_view(Keyframe(n, n, Frame(n, n, (image,)), pixels, descriptors, points), self._rig)
