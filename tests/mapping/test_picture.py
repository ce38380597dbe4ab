import numpy as np

from vislam.mapping.cloud.cloud import Cloud
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.octree.occupancy import Octree
from vislam.mapping.pictures.picture import Line, render_cloud, render_mesh, render_octree

SIZE = (320, 180)
RED, BLUE, GREEN = (200, 0, 0), (0, 0, 200), (0, 160, 0)


def plate(height_m, color, half_m=1.0):
    x, y = np.meshgrid(np.arange(-1.5 * half_m, 1.5 * half_m, 0.02), np.arange(-half_m, half_m, 0.02))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m)]).astype(np.float32)
    return Cloud(points, np.tile(np.array(color, np.uint8), (len(points), 1)))


def joined(*clouds):
    return Cloud(np.concatenate([c.points_m for c in clouds]), np.concatenate([c.colors for c in clouds]))


def share(image, color):
    return float((np.abs(image.astype(int) - color).max(axis=2) < 60).mean())


def test_a_surface_is_closed_and_fills_the_picture():
    image = render_cloud(plate(0.0, RED), size=SIZE)
    assert image.shape == (180, 320, 3)
    assert image.dtype == np.uint8
    red = np.abs(image.astype(int) - RED).max(axis=2) < 60
    assert red.mean() > 0.35
    rows = np.flatnonzero(red.any(axis=1))
    for row in rows[3:-3]:
        columns = np.flatnonzero(red[row])
        assert red[row, columns[0] + 3 : columns[-1] - 2].all()  # no holes; the border is ragged


def test_nearer_things_hide_farther_ones_whatever_their_order():
    below, above = plate(0.0, RED), plate(0.5, BLUE, 0.5)
    first, second = render_cloud(joined(below, above), size=SIZE), render_cloud(joined(above, below), size=SIZE)
    assert share(first, BLUE) > 0.05
    assert np.abs(first.astype(int) - second).max() <= 1
    hidden = render_cloud(joined(plate(0.0, BLUE, 0.5), plate(0.5, RED)), size=SIZE)
    assert share(hidden, BLUE) < 0.01


def test_the_ceiling_above_a_path_is_cut_away():
    room = joined(plate(0.0, RED), plate(2.5, BLUE))
    path = Line(np.array([[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]), GREEN)
    assert share(render_cloud(room, size=SIZE), BLUE) > 0.1
    assert share(render_cloud(room, [path], SIZE), BLUE) == 0.0


def test_lines_are_drawn_and_shine_through_where_hidden():
    across = Line(np.column_stack([np.linspace(-0.8, 0.8, 50), np.zeros(50), np.full(50, 0.3)]), GREEN, 4.0, False)
    shown = render_cloud(plate(0.0, RED), [across], SIZE)
    hidden = render_cloud(plate(0.6, RED), [across], SIZE)
    assert share(shown, GREEN) > 0.01
    assert share(hidden, GREEN) < 0.2 * share(shown, GREEN)
    assert np.abs(hidden.astype(int) - render_cloud(plate(0.6, RED), size=SIZE)).max() > 20


def test_voxels_show_height_by_colour():
    grid = Octree(0.1)
    for _ in range(2):
        grid.insert(joined(plate(0.0, RED), plate(1.0, RED, 0.4)).points_m + 0.01, np.array([0.0, 0.0, 5.0]))
    image = render_octree(grid.leaves(), size=SIZE)
    drawn = (image < 250).any(axis=2)
    assert drawn.mean() > 0.2
    warm = (image[..., 0].astype(int) > image[..., 2].astype(int) + 60) & drawn
    cold = (image[..., 2].astype(int) > image[..., 0].astype(int) + 60) & drawn
    assert np.flatnonzero(warm.any(axis=1)).mean() < np.flatnonzero(cold.any(axis=1)).mean()  # high is red and up


def test_a_mesh_is_drawn_with_its_colours():
    cloud = plate(0.0, BLUE)
    image = render_mesh(Mesh(cloud.points_m, cloud.colors, np.zeros((0, 3), np.int32)), size=SIZE)
    assert share(image, BLUE) > 0.3


def test_pictures_are_the_same_every_time():
    cloud, path = joined(plate(0.0, RED), plate(0.4, BLUE, 0.3)), Line(np.array([[-1.0, 0, 0.5], [1.0, 0, 0.5]]), GREEN)
    first, second = (render_cloud(cloud, [path], SIZE) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_empty_maps_and_broken_lines_still_give_a_picture():
    nothing = Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    broken = np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, 1.0]])
    lines = [Line(points, RED) for points in (np.zeros((0, 3)), broken, np.zeros((1, 3)))]
    for image in (
        render_cloud(nothing, lines, SIZE),
        render_cloud(nothing, [], SIZE),
        render_octree(Octree(0.1).leaves(), lines, SIZE),
        render_cloud(Cloud(np.ones((1, 3), np.float32), np.full((1, 3), 9, np.uint8)), [], SIZE),
    ):
        assert image.shape == (180, 320, 3)
        assert (image == 255).mean() > 0.5


def test_points_that_are_no_places_are_left_out():
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e30, 0, 0], [0, -3e38, 0]], np.float32)
    damage = Cloud(bad, np.full((5, 3), 9, np.uint8))
    whole = render_cloud(plate(0.0, RED), size=SIZE)
    np.testing.assert_array_equal(render_cloud(joined(plate(0.0, RED), damage), size=SIZE), whole)
    assert render_cloud(damage, size=SIZE).shape == (180, 320, 3)
