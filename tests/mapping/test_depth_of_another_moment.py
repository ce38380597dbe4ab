"""Depth images that were taken beside their image are put where the image sees them."""

from collections.abc import Callable

import numpy as np
import pytest

from vislam.config import MapConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, se3_exp
from vislam.core.messages import Array, Frame, Keyframe
from vislam.mapping.depth.extract import ScanExtractor
from vislam.mapping.depth.moment import DepthAtImage
from vislam.vision.depth_surface import DepthSurface, SurfaceMaker

PLAIN = Camera(160, 120, 130.0, 128.0, 80.0, 59.0)
BENT = Camera(160, 120, 130.0, 128.0, 80.0, 59.0, distortion="radtan", coefficients=(-0.25, 0.06, 0.001, -0.002))
TURNED = se3_exp(np.array([0.02, -0.04, 0.03, 0.02, 0.01, -0.015]))


def drawn(camera: Camera, T_world_cam: Array) -> Array:
    """Return the exact depth [H, W] of a slanted wall, and of another 1.5 m before it on the left."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]))
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    towards = rays @ R.T
    far, near = np.array([0.3, 0.1, 1.0]), np.array([-0.2, 0.0, 1.0])
    z_far, z_near = (3.0 - far @ t) / (towards @ far), (1.5 - near @ t) / (towards @ near)
    hit = t + z_near[:, None] * towards
    return np.where(hit[:, 0] < -0.2, z_near, z_far).reshape(camera.height, camera.width)


@pytest.mark.parametrize("camera", [PLAIN, BENT])
def test_depth_is_where_the_image_sees_it(camera: Camera) -> None:
    depth_m = drawn(camera, TURNED).astype(np.float32)
    seen = DepthAtImage(camera)(depth_m, TURNED)
    truth = drawn(camera, np.eye(4))
    known = seen > 0.0
    assert known.mean() > 0.9
    # but for the border of the nearer wall, and to the pixel that depth is read at
    off = np.abs(seen - truth)[known]
    assert np.quantile(off, 0.95) < 0.008
    assert np.quantile(np.abs(depth_m - truth)[known], 0.95) > 0.05


SWEEP = np.array([0.03, 0.05, -0.02, 0.01, -0.01, 0.02])  # 3.5 degrees from the first to the last row


def row_by_row(camera: Camera, of: Callable[[Camera, Array], Array]) -> Array:
    """Return what rows see that are taken one after the other."""
    poses = [se3_exp((row / (camera.height - 1.0) - 0.5) * SWEEP) for row in range(camera.height)]
    return np.array([of(camera, T)[row] for row, T in enumerate(poses)])


@pytest.mark.parametrize("camera", [PLAIN, BENT])
def test_rows_that_were_taken_one_after_the_other_are_put_where_the_middle_one_sees_them(camera: Camera) -> None:
    depth_m = row_by_row(camera, drawn).astype(np.float32)
    truth = drawn(camera, np.eye(4))
    seen = DepthAtImage(camera)(depth_m, np.eye(4), SWEEP)
    known = seen > 0.0
    assert known.mean() > 0.9
    assert np.median(np.abs(seen - truth)[known]) < 0.3 * np.median(np.abs(depth_m - truth)[known])


def painted(camera: Camera, T_world_cam: Array) -> Array:
    """Return the grey image [H, W] of walls with waves on them, that `drawn` has the depth of."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    points = camera.unproject(np.column_stack([u.ravel(), v.ravel()])) * drawn(camera, T_world_cam).reshape(-1, 1)
    x, y = (points @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])[:, :2].T
    return (128.0 + 100.0 * np.sin(9.0 * x) * np.cos(8.0 * y)).reshape(u.shape).astype(np.uint8)


@pytest.mark.parametrize("camera", [PLAIN, BENT])
def test_colours_of_rows_are_put_there_too(camera: Camera) -> None:
    image, truth = row_by_row(camera, painted).astype(np.uint8), painted(camera, np.eye(4))
    depth_m = drawn(camera, np.eye(4)).astype(np.float32)

    def off(seen: Array) -> float:
        return float(np.mean(np.abs(seen.astype(float) - truth)[8:-8, 8:-8]))

    assert off(DepthAtImage(camera).colors(image, depth_m, SWEEP)) < 0.2 * off(image)


def test_surfaces_of_rows_are_those_of_the_walls() -> None:
    depth_m = row_by_row(PLAIN, drawn).astype(np.float32)
    made = SurfaceMaker(PLAIN, 0.3, 9.0, 0.001).make(depth_m)
    near, far = np.array([-0.2, 0.0, 1.0]) / 1.5, np.array([0.3, 0.1, 1.0]) / 3.0

    def off(surface: DepthSurface) -> tuple[float, float]:
        points, planes, _ = surface.surface
        at = [np.abs(points @ wall - 1.0) / np.linalg.norm(wall) for wall in (near, far)]
        facing = [np.linalg.norm(planes - wall, axis=-1) for wall in (near, far)]
        return float(np.nanmedian(np.minimum(*at))), float(np.nanmedian(np.minimum(*facing)))

    (at, facing), (at_first, facing_first) = off(made.at_once(SWEEP)), off(made)
    assert at < 0.1 * at_first
    assert facing < 0.2 * facing_first


def test_depth_of_the_same_moment_stays() -> None:
    depth_m = drawn(BENT, np.eye(4)).astype(np.float32)
    depth_m[10:20, 30:50] = np.nan
    seen = DepthAtImage(BENT)(depth_m, np.eye(4))
    assert np.allclose(seen, np.nan_to_num(depth_m), atol=1e-6)


def test_what_depth_did_not_see_stays_unknown() -> None:
    depth_m = drawn(PLAIN, TURNED).astype(np.float32)
    depth_m[:, :80] = 0.0
    seen = DepthAtImage(PLAIN)(depth_m, TURNED)
    assert not seen[:, :70].any() and (seen[:, 80:140] > 0.0).mean() > 0.95
    away = DepthAtImage(PLAIN)(depth_m, se3_exp(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0])))
    assert not away.any()


def test_two_calls_give_the_same_bytes() -> None:
    depth_m = drawn(BENT, TURNED).astype(np.float32)
    assert DepthAtImage(BENT)(depth_m, TURNED).tobytes() == DepthAtImage(BENT)(depth_m, TURNED).tobytes()


def test_the_scan_of_a_keyframe_has_the_depth_of_its_image() -> None:
    rig = Rig((BENT,), (np.eye(4),), has_depth=True)
    image = np.full((120, 160), 90, np.uint8)
    frame = Frame(0, 0, (image,), depth_m=drawn(BENT, TURNED).astype(np.float32))

    def scan(T_image_depth: Array | None) -> Array:
        keyframe = Keyframe(0, 0, frame, np.empty((0, 2)), np.empty((0, 32), np.uint8), None, T_image_depth)
        extractor = ScanExtractor(MapConfig(), rig)
        found = extractor.extract(keyframe)
        assert found is not None and found.depth is not None
        return found.depth * extractor.view.unit_m

    step = MapConfig().pixel_step
    truth = drawn(BENT, np.eye(4))[::step, ::step]

    def off(depth: Array) -> float:
        return float(np.median(np.abs(depth - truth)[depth > 0.0]))

    assert off(scan(TURNED)) < 0.005 and off(scan(None)) > 0.02
    assert off(scan(np.asarray(invert(TURNED)))) > off(scan(TURNED))
