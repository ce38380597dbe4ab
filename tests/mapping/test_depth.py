import zlib

import cv2
import numpy as np
import pytest

from vislam.config import MapConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp, transform, transform_points
from vislam.core.memory import PackedScan
from vislam.mapping.cloud.store import KeyframeStore, Scan
from vislam.mapping.depth.extract import DenseStereo
from vislam.mapping.depth.image import filter_depth, rgbd_view, scan_points, surface_points
from worlds.box import CAMERA, CONFIG, RIG, T_BODY_CAM0, depth_image, pose

VIEW = rgbd_view(RIG, CONFIG)
FLAT = np.full((120, 160), 2.0, np.float32)


def filtered(depth_m):
    return filter_depth(depth_m, CONFIG.pixel_step, VIEW, CONFIG)


def test_points_project_back_onto_their_pixels_through_the_distortion():
    depth = filtered(depth_image(pose(0)))
    points, pixels = surface_points(depth, VIEW, np.eye(4))
    width = VIEW.size[0]
    kept = np.column_stack([pixels % width, pixels // width]) * CONFIG.pixel_step
    points_cam = transform_points(np.linalg.inv(T_BODY_CAM0), points.astype(np.float64))
    np.testing.assert_allclose(CAMERA.project(points_cam), kept, atol=1e-2)
    np.testing.assert_allclose(points_cam[:, 2], depth.ravel()[pixels] * VIEW.unit_m, atol=1e-5)
    assert len(points) > 1000


def test_depth_is_kept_to_the_unit_that_tum_uses():
    exact = (np.arange(120 * 160).reshape(120, 160) % 50 * 0.0002 + 1.0).astype(np.float32)
    stored = filtered(exact)
    np.testing.assert_allclose(stored * 0.0002, exact[::2, ::2], atol=1e-6)


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf, -1.0, 0.1])
def test_invalid_and_near_depth_is_left_out(bad):
    depth = FLAT.copy()
    depth[40:80, 60:100] = bad
    stored = filtered(depth)
    assert (stored[20:40, 30:50] == 0).all()
    assert (stored[:15] > 0).all()


def test_both_sides_of_an_edge_are_left_out_and_slopes_are_not():
    depth = FLAT.copy()
    depth[:, 80:] = 3.0
    stored = filtered(depth)
    reach = CONFIG.edge_px
    columns = 2 * np.arange(80)
    beside = (columns >= 80 - reach) & (columns < 80 + reach)
    assert (stored[:, beside] == 0).all()
    assert (stored[:, ~beside] > 0).all()
    slope = (2.0 * 1.01 ** np.arange(160) * np.ones((120, 1))).astype(np.float32)  # 1 % per pixel: a wall at 50 degrees
    assert (filtered(np.minimum(slope, 9.0))[:, :60] > 0).all()


def test_speckles_are_left_out_and_large_surfaces_are_not():
    depth = np.zeros((120, 160), np.float32)
    depth[10:14, 10:14] = 1.5  # 4 kept pixels
    depth[40:100, 40:100] = 1.5
    stored = filtered(depth)
    assert (stored[:10] == 0).all()
    assert (stored > 0).sum() == 30 * 30


def test_speckle_size_counts_connected_pixels_only():
    depth = np.zeros((120, 160), np.float32)
    depth[::4, ::4] = 1.5  # many pixels, none beside another on the kept grid
    assert (filtered(depth) == 0).all()


def test_far_points_only_clear_the_way_to_the_range_limit():
    far = np.full((120, 160), 9.0, np.float32)
    stored = filtered(far)
    assert len(surface_points(stored, VIEW, np.eye(4))[0]) == 0
    points, origin = scan_points(stored, VIEW, pose(2), 0.05)
    distances = np.linalg.norm(points - origin, axis=1)
    np.testing.assert_allclose(distances, VIEW.max_range_m + 0.1, atol=1e-4)
    np.testing.assert_allclose(origin, (pose(2) @ T_BODY_CAM0)[:3, 3])


@pytest.mark.parametrize("shape", [(60, 80), (121, 200), (120, 160, 3)])
def test_depth_of_another_size_is_refused(shape):
    with pytest.raises(DataError, match="register depth"):
        filtered(np.ones(shape, np.float32))


def test_stored_scans_come_back_exactly_and_small():
    depth = filtered(depth_image(pose(1)))
    store = KeyframeStore(depth.shape[::-1])
    colors = np.full((*depth.shape, 3), (200, 30, 10), np.uint8)
    store.add(4, 17, Scan(depth, None, colors))
    back = store.scan(4)
    np.testing.assert_array_equal(back.depth, depth)
    np.testing.assert_allclose(back.colors.astype(int), colors, atol=4)  # JPEG
    assert (store.t_ns(4), store.ids, 4 in store, 5 in store) == (17, [4], True, False)
    assert 0 < store.nbytes < depth.nbytes
    with pytest.raises(DataError, match="already"):
        store.add(4, 18, Scan(depth, None, colors))


def test_sparse_scans_come_back_exactly():
    store, rng = KeyframeStore((320, 240)), np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (50, 3), dtype=np.uint8)
    store.add(0, 0, Scan(None, points, colors))
    np.testing.assert_array_equal(store.scan(0).points_body_m, points)
    np.testing.assert_array_equal(store.scan(0).colors, colors)
    np.testing.assert_array_equal(store.geometry(0).points_body_m, points)


def test_noise_bounds_the_memory_of_a_keyframe():
    store, rng = KeyframeStore((320, 240)), np.random.default_rng(0)
    noise = rng.integers(0, 65536, (240, 320)).astype(np.uint16)
    store.add(0, 0, Scan(noise, None, rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)))
    assert store.nbytes < 1.1 * (noise.nbytes + noise.size * 3)
    np.testing.assert_array_equal(store.scan(0).depth, noise)


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


DEPTH, COLORS = np.full((240, 320), 1000, np.uint16), np.full((240, 320, 3), 90, np.uint8)


@pytest.mark.parametrize(
    ("packed", "words"),
    [
        (PackedScan(0, b"\0\x11", b"", png(COLORS)), "320 x 240"),
        (PackedScan(0, png(DEPTH)[:-300], b"", png(COLORS)), "320 x 240"),
        (PackedScan(0, png(DEPTH[:100]), b"", png(COLORS)), "320 x 240"),
        (PackedScan(0, png(DEPTH.astype(np.uint8)), b"", png(COLORS)), "320 x 240"),
        (PackedScan(0, png(COLORS), b"", png(COLORS)), "320 x 240"),
        (PackedScan(0, png(DEPTH)[:16] + b"\xff" * 8 + png(DEPTH)[24:], b"", png(COLORS)), "320 x 240"),
        (PackedScan(0, png(DEPTH), b"", b""), "colours"),
        (PackedScan(0, png(DEPTH), b"", b"no image"), "colours"),
        (PackedScan(0, png(DEPTH), b"", png(COLORS[:50])), "colours"),
        (PackedScan(0, b"", b"no zlib", b""), "unpacked"),
        (PackedScan(0, b"", zlib.compress(bytes(25)), bytes(6)), "cut"),
        (PackedScan(0, b"", zlib.compress(bytes(24)), bytes(7)), "colours"),
        (PackedScan(0, b"", zlib.compress(bytes(10**7)), bytes(6)), "colours"),
        (PackedScan(0, "text", b"", b""), "bytes"),
    ],
)
def test_damaged_stored_scans_are_errors(packed, words):
    store = KeyframeStore((320, 240))
    with pytest.raises(DataError, match=f"keyframe 3 is damaged.*{words}"):
        store.put(3, packed)
        store.scan(3)


def stereo_images(rig, distance_m, seed=2):
    """Both images of a fronto-parallel textured plane at a distance in front of cam0."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (1600, 1600)).astype(np.float32), (0, 0), 4.0)
    texture = np.clip((texture - texture.mean()) * 8 + 128, 0, 255)
    images = []
    for camera, T in zip(rig.cameras, rig.T_body_cams, strict=True):
        T_cam0_cam = np.linalg.inv(rig.T_body_cams[0]) @ T
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float)) @ T_cam0_cam[:3, :3].T
        on_plane = T_cam0_cam[:3, 3] + rays * ((distance_m - T_cam0_cam[2, 3]) / rays[:, 2])[:, None]
        place = (on_plane[:, :2] * 300 + 800).astype(np.float32).reshape(camera.height, camera.width, 2)
        images.append(cv2.remap(texture, place, None, cv2.INTER_LINEAR).astype(np.uint8))
    return images


@pytest.mark.parametrize("distance_m", [1.0, 2.0])
def test_dense_stereo_finds_a_plane_through_distortion_and_tilt(distance_m):
    camera = Camera(376, 240, 230.0, 229.0, 185.0, 121.0, 0.0, "radtan", (-0.28, 0.07, 0.0002, 0.00002))
    T_cam0_cam1 = transform(so3_exp(np.array([0.01, -0.02, 0.015])), np.array([0.11, 0.002, -0.003]))
    rig = Rig((camera, camera), (T_BODY_CAM0, T_BODY_CAM0 @ T_cam0_cam1))
    config = MapConfig(stereo_scale=1.0)
    stereo = DenseStereo(rig, config)
    depth_m, _ = stereo.match(*stereo_images(rig, distance_m))
    depth = filter_depth(depth_m, 1, stereo.view, config)
    points, _ = surface_points(depth, stereo.view, np.eye(4))
    points_cam0 = transform_points(np.linalg.inv(T_BODY_CAM0), points.astype(np.float64))
    assert len(points) > 0.5 * depth.size
    assert abs(np.median(points_cam0[:, 2]) - distance_m) < 0.01 * distance_m
    assert np.percentile(np.abs(points_cam0[:, 2] - distance_m), 95) < 0.03 * distance_m
    again, _ = DenseStereo(rig, config).match(*stereo_images(rig, distance_m))
    np.testing.assert_array_equal(again, depth_m)


def test_stereo_range_ends_where_depth_gets_uncertain():
    camera = Camera(376, 240, 230.0, 230.0, 188.0, 120.0)
    near = Rig((camera, camera), (np.eye(4), transform(np.eye(3), np.array([0.1, 0.0, 0.0]))))
    config = MapConfig(stereo_scale=1.0, stereo_disparity_sigma_px=0.3, stereo_max_sigma_m=0.15)
    view = DenseStereo(near, config).view
    error_m = view.max_range_m**2 * 0.3 / (view.K[0, 0] * 0.1)
    np.testing.assert_allclose(error_m, 0.15, rtol=1e-6)
