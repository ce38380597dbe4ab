import cv2
import numpy as np
import pytest

from vislam.core.camera import Camera
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, transform_points
from vislam.sim.scene import paint
from vislam.sim.scene.bake import bake
from vislam.sim.scene.furniture import ceiling, floor, wall
from vislam.sim.scene.render import Renderer
from vislam.sim.scene.scene import SceneBuilder
from vislam.sim.worlds.table import camera
from worlds.recordings import frame_seconds

SEED = np.random.SeedSequence(3)
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along x


def looking(position, yaw: float, pitch: float = 0.0) -> np.ndarray:
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    T = np.eye(4)
    T[:3, :3] = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ LEVEL
    )
    T[:3, 3] = position
    return T


def room() -> SceneBuilder:
    world = SceneBuilder()
    corners = [(-3.0, 2.0), (3.0, 2.0), (3.0, -2.0), (-3.0, -2.0)]
    for k in range(4):
        wall(world, corners[k], corners[(k + 1) % 4], 2.5, paint.brick(), 60.0)
    floor(world, (-3.0, -2.0), (3.0, 2.0), paint.concrete(), 60.0)
    ceiling(world, (-3.0, -2.0), (3.0, 2.0), 2.5, paint.plaster((200, 200, 200)), 40.0)
    world.box((1.5, 0.8), 0.0, (0.8, 0.6, 1.1), 0.5, paint.wood(), texels_per_m=80.0)
    world.cylinder((1.2, -0.7), 0.3, 0.35, 0.9, paint.tiles((90, 120, 200), 0.1, 0.06), texels_per_m=80.0)
    world.lamp((0.0, 0.0, 2.3), 3.0, (1.0, 1.0, 1.0))
    return world


def slab(origin, rays, low, high):
    """Return entry and exit of rays [N, 3] into an axis-aligned box."""
    with np.errstate(divide="ignore"):
        near, far = (low - origin) / rays, (high - origin) / rays
    return np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)


@pytest.mark.parametrize("pose", [looking((-2.0, 0.1, 1.2), 0.0, 0.2), looking((-0.3, -1.5, 1.9), 0.6, 0.45)])
def test_depth_is_that_of_the_geometry(pose):
    scene = bake(room(), SEED)
    cam = camera(320)
    _, depth = Renderer(cam).render(scene, pose)
    columns, rows = np.meshgrid(np.arange(cam.width), np.arange(cam.height))
    rays_cam = cam.unproject(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    rays, origin = rays_cam @ pose[:3, :3].T, pose[:3, 3]
    expected = slab(origin, rays, np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.5]))[1]
    turn = np.array([[np.cos(0.5), np.sin(0.5), 0], [-np.sin(0.5), np.cos(0.5), 0], [0, 0, 1.0]])
    enter, leave = slab(
        turn @ (origin - [1.5, 0.8, 0.0]), rays @ turn.T, np.array([-0.4, -0.3, 0.0]), np.array([0.4, 0.3, 1.1])
    )
    expected = np.where((enter <= leave) & (enter > 0), np.minimum(expected, enter), expected)
    # A cylinder is a circle cut with a slab of heights.
    o, d = origin[:2] - [1.2, -0.7], rays[:, :2]
    a, b, c = (d * d).sum(axis=1), d @ o, o @ o - 0.35**2
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - a * c)
        z_low, z_high = np.sort(np.stack([(0.3 - origin[2]) / rays[:, 2], (1.2 - origin[2]) / rays[:, 2]]), axis=0)
        enter, leave = np.maximum((-b - root) / a, z_low), np.minimum((-b + root) / a, z_high)
        inside = (enter <= leave) & (enter > 0)
        from_below = inside & (rays[:, 2] > 0) & (enter == z_low)  # has no bottom: never seen from above
    assert not from_below.any()
    expected = np.where(inside, np.minimum(expected, enter), expected).reshape(depth.shape)
    np.testing.assert_allclose(depth, expected, rtol=2e-6)
    assert inside.sum() > 500


def halves(rng, height, width, ppm):
    image = np.zeros((height, width, 3), dtype=np.uint8)
    image[:, : width // 2] = (0, 0, 255)  # red on the left
    image[:, width // 2 :] = (255, 0, 0)
    image[: height // 4] = (0, 255, 0)  # green at the top
    return image


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.4])
def test_pictures_are_neither_mirrored_nor_upside_down(yaw):
    box, drum = SceneBuilder(ambient=1.0), SceneBuilder(ambient=1.0)
    box.box((0.0, 0.0), 0.0, (1.0, 1.0, 1.0), yaw + np.pi, halves)  # one side looks at the camera
    # The picture begins at angle zero: seen from -x its middle (angle pi) faces the camera.
    drum.cylinder((0.0, 0.0), 0.0, 0.6, 1.0, halves)
    for builder, direction in ((box, yaw), (drum, 0.0)):
        pose = looking((-3.0 * np.cos(direction), -3.0 * np.sin(direction), 0.5), direction)
        color, depth = Renderer(camera(160)).render(bake(builder, SEED), pose)
        blue, green, red = (color[:, :, c] * (depth > 0) > 60 for c in range(3))
        columns, rows = np.meshgrid(np.arange(160), np.arange(120))
        assert columns[red & ~green & ~blue].mean() < columns[blue & ~green & ~red].mean() - 8
        assert rows[green].mean() < rows[red].mean() - 8


def test_nothing_is_black_and_has_no_depth():
    builder = SceneBuilder()
    builder.box((0.0, 0.0), 0.0, (0.2, 0.2, 0.2), 0.0, paint.wood())
    color, depth = Renderer(camera(160)).render(bake(builder, SEED), looking((-3.0, 0.0, 1.0), np.pi))
    assert not color.any()
    assert not depth.any()


def test_painting_does_not_depend_on_the_number_of_threads():
    one, three = bake(room(), SEED, threads=1), bake(room(), SEED, threads=3)
    np.testing.assert_array_equal(one.texels, three.texels)
    other = bake(room(), np.random.SeedSequence(4))
    assert np.mean(other.texels != one.texels) > 0.5


def test_light_is_dimmer_in_the_shadow():
    builder = SceneBuilder(ambient=0.1)
    floor(builder, (-2.0, -2.0), (2.0, 2.0), lambda rng, h, w, ppm: np.full((h, w, 3), 200, np.uint8), 50.0)
    builder.box((0.4, 0.0), 0.5, (0.5, 0.5, 0.1), 0.0, paint.wood())
    builder.lamp((0.4, 0.0, 2.0), 2.0, (1.0, 1.0, 1.0))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 0.45)  # below the box, looking down
    color, _ = Renderer(camera(160)).render(bake(builder, SEED), T)
    cam = camera(160)
    shaded, lit = cam.project(transform_points(invert(T), np.array([[0.25, 0.0, 0.0], [-0.25, 0.0, 0.0]]))).astype(int)
    assert color[shaded[1], shaded[0], 1] < 0.75 * color[lit[1], lit[0], 1]


def test_a_distortion_that_folds_is_refused():
    folding = Camera(160, 120, 60.0, 60.0, 79.5, 59.5, distortion="radtan", coefficients=(-0.6, 0.0, 0.0, 0.0))
    with pytest.raises(UsageError, match="distortion"):
        Renderer(folding)


def test_two_views_agree_on_colour(painted):
    world = painted("handheld-room", image_noise=False, depth_noise=False, exposure_changes=False)
    i, j = 200, 203
    a, b = world.render(i), world.render(j)
    poses = world.truth().T_world_body @ world.rig.T_body_cams[0]
    cam = world.rig.cameras[0]
    columns, rows = np.meshgrid(np.arange(0, 640, 3), np.arange(0, 480, 3))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    points = cam.unproject(pixels.astype(float)) * a.depth_m[pixels[:, 1], pixels[:, 0]][:, None]
    there = transform_points(invert(poses[j]) @ poses[i], points)
    target = cam.project(there)
    keep = np.isfinite(target[:, 0])
    keep[keep] &= cam.contains(target[keep], 3)
    maps = target[keep].astype(np.float32)[None]
    seen_depth = cv2.remap(b.depth_m, maps, None, cv2.INTER_NEAREST)[0]
    seen = cv2.remap(b.images[0], maps, None, cv2.INTER_CUBIC)[0].astype(float)
    visible = np.abs(seen_depth - there[keep, 2]) < 0.02
    own = a.images[0][pixels[keep, 1], pixels[keep, 0]].astype(float)
    assert visible.mean() > 0.8
    assert np.median(np.abs(seen - own)[visible]) < 2.5
    # As a control: the same pixels without the motion agree far less.
    still = b.images[0][pixels[keep, 1], pixels[keep, 0]].astype(float)
    assert np.median(np.abs(still - own)[visible]) > 4.0


@pytest.mark.parametrize(("name", "index"), [("handheld-room", 300), ("workshop-cart", 400), ("corridor-loop", 500)])
def test_features_are_tracked_to_a_fraction_of_a_pixel(painted, name, index):
    world, exact = painted(name, rig="rgbd"), painted(name, rig="rgbd", depth_noise=False)
    a, b = world.render(index), world.render(index + 1)
    poses = world.truth().T_world_body @ world.rig.T_body_cams[0]
    cam = world.rig.cameras[0]
    corners = cv2.goodFeaturesToTrack(a.images[0], 600, 0.01, 10).reshape(-1, 2)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(a.images[0], b.images[0], corners, None)
    back, _, _ = cv2.calcOpticalFlowPyrLK(b.images[0], a.images[0], tracked, None)
    nearest = np.round(corners).astype(int)
    points = cam.unproject(corners.astype(float)) * exact.render(index).depth_m[nearest[:, 1], nearest[:, 0]][:, None]
    true = cam.project(transform_points(invert(poses[index + 1]) @ poses[index], points))
    good = (status[:, 0] > 0) & (np.linalg.norm(back - corners, axis=1) < 0.5) & np.isfinite(true[:, 0])
    error = np.linalg.norm(tracked - true, axis=1)[good]
    assert good.sum() > 200
    assert np.median(error) < 0.15


def test_every_row_of_a_rolling_shutter_is_seen_from_its_own_pose(painted):
    options = {"image_width_px": 160, "image_noise": False, "depth_noise": False, "exposure_changes": False}
    rolling = painted("handheld-room", readout_s=0.03, **options)
    index = 180
    frame = rolling.render(index)
    renderer = Renderer(rolling.rig.cameras[0])
    stamp_s = frame_seconds(rolling)[index]
    for row in (0, 31, 60, 97, 119):
        t_s = stamp_s + 0.03 * ((row + 0.5) / 120 - 0.5)
        pose = rolling.spline.at(np.array([t_s])).T_world_body[0] @ rolling.rig.T_body_cams[0]
        _, depth = renderer.render(rolling.scene, pose)
        np.testing.assert_allclose(frame.depth_m[row], depth[row], rtol=1e-6)
    steady = painted("handheld-room", **options).render(index)
    assert np.abs(steady.depth_m[0] - frame.depth_m[0]).max() > 1e-3


def test_blur_softens_moving_images_and_not_resting_ones(painted):
    options = {"image_width_px": 160, "image_noise": False, "exposure_changes": False}
    sharp, blurred = painted("handheld-room", **options), painted("handheld-room", exposure_s=0.03, **options)

    def sharpness(image):
        return float(np.abs(cv2.Laplacian(image, cv2.CV_32F)).mean())

    rates = np.linalg.norm(sharp.spline.at(frame_seconds(sharp)).rate_body_rad_s, axis=1)
    fast = int(np.argmax(rates))
    assert sharpness(blurred.render(fast).images[0]) < 0.8 * sharpness(sharp.render(fast).images[0])
    assert np.abs(blurred.render(0).images[0].astype(int) - sharp.render(0).images[0]).max() <= 1


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("cart-drive", {"exposure_s": 0.008}),  # as it has by itself
        ("handheld-room", {"exposure_s": 0.03, "rig": "mono"}),
        ("handheld-room", {"exposure_s": 0.02, "readout_s": 0.02, "rig": "mono"}),
    ],
)
def test_blur_is_that_of_sharp_images_averaged_over_the_exposure(painted, name, options):
    world = painted(name, image_width_px=320, image_noise=False, exposure_changes=False, **options)
    renderer, T_body_cam, moments = Renderer(world.rig.cameras[0]), world.rig.T_body_cams[0], 16
    errors, sharp_errors, seconds = [], [], frame_seconds(world)
    for index in np.linspace(20, world.frame_count - 20, 8)[::2].astype(int):
        t_s = seconds[index]
        rows_s = t_s + world.options.readout_s * ((np.arange(240) + 0.5) / 240 - 0.5)
        light = np.zeros((240, 320, 3))
        for moment in (np.arange(moments) + 0.5) / moments - 0.5:
            poses = world.spline.at(rows_s + moment * world.options.exposure_s).T_world_body @ T_body_cam
            light += renderer.render(world.scene, poses)[0].astype(float) ** 2 / moments
        sharp = renderer.render(world.scene, world.spline.at(rows_s).T_world_body @ T_body_cam)[0]
        expected = np.sqrt(light)
        errors.append(np.abs(world.render(int(index)).color - expected).mean())
        sharp_errors.append(np.abs(sharp - expected).mean())
    assert np.mean(errors) < 0.7 and max(errors) < 1.0  # grey levels; rounding to bytes alone makes a quarter of one
    assert max(sharp_errors) > 3.0 * errors[int(np.argmax(sharp_errors))]  # without blur, as a control


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_outline_is_blurred_as_far_as_it_moves(side):
    builder = SceneBuilder(ambient=1.0)
    builder.rectangle(
        (2.0, 0.0, 2.0), (0.0, -1.0, 0.0), (0.0, 0.0, -2.0), lambda rng, h, w, ppm: np.full((h, w, 3), 200, np.uint8)
    )
    scene, cam, moments = bake(builder, SEED), camera(320), 8
    shift_m = side * 10.0 * 2.0 / cam.fx  # ten pixels at two metres
    shutter = np.stack([looking((0.0, shift_m * ((k + 0.5) / moments - 0.5), 1.0), 0.0) for k in range(moments)])
    color, depth = Renderer(cam).render(scene, looking((0.0, 0.0, 1.0), 0.0), shutter)
    row, column = int(cam.cy), int(cam.cx)
    light = (color[row, :, 1].astype(float) / color[row, column + 30, 1]) ** 2
    width_px = np.interp([0.1, 0.9], light[column - 15 : column + 16], np.arange(31))
    assert np.diff(width_px)[0] == pytest.approx(0.8 * 10.0, abs=1.0)
    assert light[column - 15 : column + 16].sum() == pytest.approx(
        (depth[row, column - 15 : column + 16] > 0).sum(), abs=0.6
    )
