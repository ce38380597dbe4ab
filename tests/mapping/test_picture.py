import numpy as np
import pytest

from vislam.mapping.cloud.cloud import Cloud
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.octree.occupancy import OccupancyMap
from vislam.mapping.pictures.picture import Line, Style, render_cloud, render_mesh, render_octree

SIZE = (320, 180)
RED, BLUE, GREEN = (200, 0, 0), (0, 0, 200), (0, 160, 0)


def plate(height_m, color, half_m=1.0):
    x, y = np.meshgrid(np.arange(-half_m, half_m, 0.02), np.arange(-half_m, half_m, 0.02))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m)]).astype(np.float32)
    return Cloud(points, np.tile(np.array(color, np.uint8), (len(points), 1)))


def joined(*clouds):
    return Cloud(np.concatenate([c.points_m for c in clouds]), np.concatenate([c.colors for c in clouds]))


def share(image, color):
    return float((np.abs(image.astype(int) - color).max(axis=2) < 60).mean())


def octree_of(cloud, repeats=2):
    grid = OccupancyMap(0.1)
    for _ in range(repeats):
        grid.insert(cloud.points_m + 0.01, np.array([0.0, 0.0, 5.0]))
    return grid.octree()


def test_a_surface_is_closed_and_fills_the_picture():
    image = render_cloud(plate(0.0, RED), style=Style(size=SIZE, floor_grid=False))
    assert image.shape == (180, 320, 3)
    assert image.dtype == np.uint8
    assert share(image, RED) > 0.35
    red = np.abs(image.astype(int) - RED).max(axis=2) < 60
    rows = np.flatnonzero(red.any(axis=1))
    for row in rows[3:-3]:
        columns = np.flatnonzero(red[row])
        assert red[row, columns[0] + 3 : columns[-1] - 2].all()  # no holes; the border is ragged


def test_nearer_things_hide_farther_ones_whatever_their_order():
    below, above = plate(0.0, RED), plate(0.5, BLUE, 0.5)
    style = Style(size=SIZE, elevation_deg=80.0, azimuth_deg=-90.0, floor_grid=False)
    first, second = render_cloud(joined(below, above), style=style), render_cloud(joined(above, below), style=style)
    assert share(first, BLUE) > 0.05
    assert np.abs(first.astype(int) - second).max() <= 1
    assert share(render_cloud(below, style=style), BLUE) == 0.0


def test_the_ceiling_is_cut_away():
    room = joined(plate(0.0, RED), plate(2.5, BLUE))
    path = Line(np.array([[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]), GREEN)
    assert share(render_cloud(room, style=Style(size=SIZE)), BLUE) > 0.1
    assert share(render_cloud(room, style=Style(size=SIZE, ceiling_m=2.0)), BLUE) == 0.0
    assert share(render_cloud(room, [path], Style(size=SIZE)), BLUE) == 0.0  # half a metre above the path


def test_lines_are_drawn_and_shine_through_where_hidden():
    style = Style(size=SIZE, azimuth_deg=-90.0, ceiling_m=3.0)
    across = np.column_stack([np.linspace(-0.8, 0.8, 50), np.zeros(50), np.full(50, 0.3)])
    shown = render_cloud(plate(0.0, RED), [Line(across, GREEN, 4.0, marks_ends=False)], style)
    hidden = render_cloud(plate(0.6, RED), [Line(across, GREEN, 4.0, marks_ends=False)], style)
    assert share(shown, GREEN) > 0.01
    assert share(hidden, GREEN) < 0.2 * share(shown, GREEN)
    assert np.abs(hidden.astype(int) - render_cloud(plate(0.6, RED), [], style)).max() > 20


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.6, 0.8)])
def test_any_direction_can_be_up(up):
    room = joined(plate(0.0, RED), plate(2.5, BLUE))
    axis = np.array(up)
    other = np.cross(axis, [1.0, 0.0, 0.0])
    turned = room.points_m @ np.stack([[1.0, 0.0, 0.0], other, axis])
    style = Style(size=SIZE, up=up, ceiling_m=1.0)
    image = render_cloud(Cloud(turned.astype(np.float32), room.colors), style=style)
    assert share(image, RED) > 0.2
    assert share(image, BLUE) == 0.0


def test_octree_cubes_show_height_by_colour():
    octree = octree_of(joined(plate(0.0, RED), plate(1.0, RED, 0.4)))
    image = render_octree(octree, style=Style(size=SIZE, floor_grid=False))
    drawn = (image < 250).any(axis=2)
    assert drawn.mean() > 0.2
    warm = (image[..., 0].astype(int) > image[..., 2].astype(int) + 60) & drawn
    cold = (image[..., 2].astype(int) > image[..., 0].astype(int) + 60) & drawn
    assert np.flatnonzero(warm.any(axis=1)).mean() < np.flatnonzero(cold.any(axis=1)).mean()  # high is red and up


def room_seen_from_inside():
    """A floor and four walls with their octree; the wall at y = -1, seen from inside only, is blue."""
    along, up = (grid.ravel() for grid in np.meshgrid(np.arange(-1.0, 1.0, 0.02), np.arange(0.0, 1.2, 0.02)))
    sides = [(along, np.full(along.size, y), up) for y in (-1.0, 1.0)]
    sides += [(np.full(along.size, x), along, up) for x in (-1.0, 1.0)]
    walls = np.concatenate([np.column_stack(side) for side in sides]).astype(np.float32)
    floor = plate(0.0, RED).points_m
    colors = np.where(np.arange(len(walls))[:, None] < along.size, BLUE, RED)
    cloud = Cloud(
        np.concatenate([walls, floor]), np.concatenate([colors, np.tile(RED, (len(floor), 1))]).astype(np.uint8)
    )
    grid = OccupancyMap(0.1)
    for eye in ([0.0, 0.0, 0.6], [0.5, 0.5, 0.9], [-0.5, -0.5, 0.9]):
        grid.insert(cloud.points_m, np.array(eye))
    return cloud, grid.octree()


def test_near_walls_open_the_view_into_the_room():
    cloud, octree = room_seen_from_inside()
    style = Style(size=SIZE, azimuth_deg=-90.0, elevation_deg=30.0, floor_grid=False)
    assert share(render_cloud(cloud, style=style), BLUE) > 0.1
    assert share(render_cloud(cloud, style=style, octree=octree), BLUE) < 0.005
    from_behind = Style(size=SIZE, azimuth_deg=90.0, elevation_deg=30.0, floor_grid=False)
    assert share(render_cloud(cloud, style=from_behind, octree=octree), BLUE) > 0.1
    image = render_octree(octree, style=style)
    floor = image[SIZE[1] // 2 : -20, SIZE[0] // 2]  # the lower middle looks past the near wall onto the floor
    assert (floor[:, 2].astype(int) > floor[:, 0].astype(int) + 40).mean() > 0.5


def test_a_mesh_is_drawn_with_its_colours():
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    mesh = Mesh(corners, np.tile(np.array(BLUE, np.uint8), (4, 1)), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    assert share(render_mesh(mesh, style=Style(size=SIZE)), BLUE) > 0.3


def test_pictures_are_the_same_every_time():
    cloud, path = joined(plate(0.0, RED), plate(0.4, BLUE, 0.3)), Line(np.array([[-1.0, 0, 0.5], [1.0, 0, 0.5]]), GREEN)
    first, second = (render_cloud(cloud, [path], Style(size=SIZE, background="dark")) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_empty_maps_and_broken_lines_still_give_a_picture():
    nothing = Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    lines = [
        Line(np.zeros((0, 3)), RED),
        Line(np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, 1.0]]), RED),
        Line(np.zeros((1, 3)), RED),
    ]
    for image in (
        render_cloud(nothing, lines, Style(size=SIZE)),
        render_cloud(nothing, [], Style(size=SIZE)),
        render_octree(OccupancyMap(0.1).octree(), lines, Style(size=SIZE)),
        render_cloud(Cloud(np.ones((1, 3), np.float32), np.full((1, 3), 9, np.uint8)), [], Style(size=SIZE)),
    ):
        assert image.shape == (180, 320, 3)
        assert (image == 255).mean() > 0.5


def test_points_that_are_no_places_are_left_out():
    style = Style(size=SIZE, floor_grid=False)
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e30, 0, 0], [0, -3e38, 0]], np.float32)
    broken = joined(plate(0.0, RED), Cloud(bad, np.full((5, 3), 9, np.uint8)))
    np.testing.assert_array_equal(render_cloud(broken, style=style), render_cloud(plate(0.0, RED), style=style))
    only_bad = Cloud(bad, np.full((5, 3), 9, np.uint8))
    assert render_cloud(only_bad, style=style).shape == (180, 320, 3)
