"""Pictures on a mesh: every triangle shows what a view that sees it saw there."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.mesh.atlas import textured
from vislam.mapping.mesh.posed import PosedView

K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
SIZE = (320, 240)
SHIELD = (0.05, 0.25, -0.1, 0.1)  # xmin, xmax, ymin, ymax of a red plate
SHIELD_Z_M = 0.5  # over the wall, which is at z = 0


def pattern(x, y):
    """The wall's colours [..., 3], smooth."""
    return np.stack([128 + 100 * np.sin(9 * x), 128 + 100 * np.cos(7 * y), 128 + 100 * np.sin(5 * (x + y))], -1)


def eye(x, y, z=1.2):
    """T_map_view of a camera that looks straight at the wall."""
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = x, y, z
    return T


def view(T, with_shield=False):
    """Render the wall, and the plate before it."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u, float)], -1) @ T[:3, :3].T
    depth = np.full(u.shape, T[2, 3])
    at = T[:3, 3] + rays * depth[..., None]
    colors = pattern(at[..., 0], at[..., 1])
    if with_shield:
        near = T[:3, 3] + rays * (T[2, 3] - SHIELD_Z_M)
        a, b, c, d = SHIELD
        hit = (near[..., 0] > a) & (near[..., 0] < b) & (near[..., 1] > c) & (near[..., 1] < d)
        depth[hit], colors[hit] = T[2, 3] - SHIELD_Z_M, (255, 0, 0)
    return PosedView(depth.astype(np.float32), np.round(colors).astype(np.uint8), K, T, 5.0)


def wall(step=0.02, half=0.8):
    """Triangles of the wall, grey."""
    n = int(2 * half / step) + 1
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float32)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.column_stack([i, i + 1, i + n]), np.column_stack([i + 1, i + n + 1, i + n])])
    return Mesh(points, np.full((len(points), 3), 77, np.uint8), triangles.astype(np.int32))


def shown(result):
    """What the atlas shows at the middle of every textured triangle [M, 3], and where that is [M, 3]."""
    uv = result.uv[result.triangles].mean(axis=1) * result.atlas.shape[1::-1] - 0.5
    colors = cv2.remap(result.atlas, uv[:, 0].astype(np.float32), uv[:, 1].astype(np.float32), cv2.INTER_LINEAR)
    return colors.reshape(-1, 3).astype(float), result.points_m[result.triangles].mean(axis=1)


@pytest.mark.parametrize("size_px", [1024, 200])
def test_every_triangle_shows_what_is_there(size_px):
    views = [view(eye(-0.2, 0.0)), view(eye(0.2, 0.05, 1.0))]
    result = textured(wall(), lambda: iter(views), size_px)
    assert max(result.atlas.shape[:2]) <= size_px
    colors, places = shown(result)
    assert len(places) > 4000
    assert np.abs(colors - pattern(places[:, 0], places[:, 1])).max() < (6 if size_px == 1024 else 20)
    triangles = len(result.triangles) + len(result.rest.triangles)
    assert triangles == len(wall().triangles)
    assert (result.rest.colors == 77).all()


def test_what_stands_before_a_surface_is_not_painted_on_it():
    views = [view(eye(0.0, 0.0), with_shield=True), view(eye(0.45, 0.0), with_shield=True)]
    result = textured(wall(), lambda: iter(views), 1024)
    colors, places = shown(result)
    ratio = colors / pattern(places[:, 0], places[:, 1])
    assert (np.abs(ratio / np.median(ratio, axis=0) - 1.0) < 0.05).mean() > 0.9
    # what the first one cannot see behind the plate, the second sees
    behind = (abs(places[:, 0] - 0.2) < 0.05) & (abs(places[:, 1]) < 0.05)
    assert behind.any()


def test_pictures_of_other_exposure_leave_no_seam():
    views = [view(eye(-0.3, 0.0)), view(eye(0.25, 0.0))]
    factor = np.array([0.7, 0.8, 0.6])
    dim = replace(views[1], colors=np.round(views[1].colors * factor).astype(np.uint8))
    colors, places = shown(textured(wall(), lambda: iter([views[0], dim]), 1024))
    ratio = colors / pattern(places[:, 0], places[:, 1])
    left, right = (np.median(ratio[side], axis=0) for side in (places[:, 0] < -0.2, places[:, 0] > 0.2))
    assert np.abs(right / left - 1.0).max() < 0.03 < np.abs(factor - 1.0).min()


def test_what_is_overexposed_is_shown_by_another_picture():
    near, far = view(eye(0.0, 0.0)), view(eye(0.05, 0.0, 1.5))
    burnt = near.colors.copy()
    burnt[100:140, 140:180] = 255
    colors, places = shown(textured(wall(), lambda: iter([replace(near, colors=burnt), far]), 1024))
    middle = (abs(places[:, :2]) < 0.05).all(axis=1)
    assert np.abs(colors - pattern(places[:, 0], places[:, 1]))[middle].max() < 12


def test_twice_is_the_same_bytes_and_the_nearest_view_wins():
    views = [view(eye(0.0, 0.0, 2.0)), view(eye(0.0, 0.0, 0.8))]
    other = replace(views[0], colors=np.roll(views[0].colors, 1, axis=2))
    first, again = (textured(wall(half=0.2), lambda: iter([other, views[1]]), 512) for _ in range(2))
    assert first.atlas.tobytes() == again.atlas.tobytes()
    assert first.uv.tobytes() == again.uv.tobytes()
    colors, places = shown(first)
    ratio = colors / pattern(places[:, 0], places[:, 1])
    assert (np.abs(ratio / np.median(ratio, axis=0) - 1.0) < 0.05).mean() > 0.9


def test_without_a_view_that_sees_it_there_is_none():
    away = eye(0.0, 0.0)
    away[:3, :3] = np.eye(3)  # looks away from the wall
    blind = PosedView(np.full(SIZE[::-1], 1.0, np.float32), np.zeros((*SIZE[::-1], 3), np.uint8), K, away, 5.0)
    assert textured(wall(), lambda: iter([]), 512) is None
    assert textured(wall(), lambda: iter([blind]), 512) is None
    assert textured(wall(), lambda: iter([view(eye(0.0, 0.0))]), 4) is None  # no picture is that small
