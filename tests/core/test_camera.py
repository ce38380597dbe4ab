import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.core.camera import Camera, Rig, rectify
from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp, transform

EUROC = Camera(
    752, 480, 458.654, 457.296, 367.215, 248.375, 0.0, "radtan", (-0.28340811, 0.07395907, 0.00019359, 1.7e-05)
)
FR1 = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, 0.0, "radtan", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
FISHEYE = Camera(512, 512, 190.9, 190.9, 254.9, 256.8, 0.0, "equidistant", (0.0034, 0.0007, -0.002, 0.0002))
SKEWED = Camera(640, 480, 500.0, 480.0, 320.0, 240.0, 3.5, "radtan", (-0.2, 0.05, 0.001, -0.002))
AZURE = Camera(
    1280, 720, 605.0, 604.8, 638.9, 366.2, 0.0, "rational", (0.494, -2.649, 8e-4, -4e-4, 1.537, 0.374, -2.472, 1.464)
)
WIDE = Camera(640, 400, 280.0, 280.0, 320.0, 200.0, 0.0, "rational", (2.1, 0.4, 1e-4, -2e-4, 0.01, 2.4, 1.0, 0.06))
IDEAL = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
CAMERAS = {"euroc": EUROC, "fr1": FR1, "fisheye": FISHEYE, "skewed": SKEWED, "ideal": IDEAL} | {
    "azure": AZURE, "wide": WIDE,
    "ucm": Camera(640, 480, 260.0, 261.0, 318.0, 243.0, 0.0, "ucm", (0.6,)),
    "eucm": Camera(640, 480, 260.0, 261.0, 318.0, 243.0, 0.0, "eucm", (0.62, 1.1)),
    "ds": Camera(640, 480, 260.0, 261.0, 318.0, 243.0, -0.7, "ds", (-0.2, 0.58)),
    "omni": Camera(640, 480, 260.0, 261.0, 318.0, 243.0, 0.0, "omni", (1.4, -0.1, 0.02, 1e-3, -1e-3)),
}  # fmt: skip
every_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def points_in_view(camera, seed, count=100):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([0, 0], [camera.width, camera.height], (count, 2))
    rays = camera.unproject(pixels)
    keep = np.isfinite(rays).all(axis=1)
    return rays[keep] * rng.uniform(0.3, 30.0, (int(keep.sum()), 1)), pixels[keep]


@pytest.mark.parametrize("camera", [EUROC, FR1, IDEAL, AZURE, WIDE])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_projection_agrees_with_opencv(camera, seed):
    points, _ = points_in_view(camera, seed)
    k = np.array(camera.coefficients) if camera.coefficients else np.zeros(4)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, k)
    assert np.allclose(camera.project(points), expected.reshape(-1, 2), atol=1e-6)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_equidistant_projection_agrees_with_opencv(seed):
    points, _ = points_in_view(FISHEYE, seed)
    expected, _ = cv2.fisheye.projectPoints(
        points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), FISHEYE.K, np.array(FISHEYE.coefficients)
    )
    assert np.allclose(FISHEYE.project(points), expected.reshape(-1, 2), atol=1e-6)


@every_camera
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_unprojection_inverts_projection(camera, seed):
    points, pixels = points_in_view(camera, seed)
    assert len(points) > 80  # the fisheye's corners look behind the image plane
    assert np.allclose(camera.project(points), pixels, atol=1e-7)
    assert np.allclose(camera.unproject(camera.project(points)), points / points[:, 2:], atol=1e-6)


@every_camera
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_projection_jacobian_matches_finite_differences(camera, seed):
    points, _ = points_in_view(camera, seed, 30)
    analytic = camera.project_jacobian(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        numeric = (camera.project(points + step) - camera.project(points - step)) / 2e-6
        assert np.allclose(analytic[:, :, axis], numeric, atol=1e-3, rtol=1e-4)


small = st.floats(-0.6, 0.6)
rational = st.tuples(small, small, st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), small, small, small, small)


@given(coefficients=rational, seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_rational_lenses_agree_with_opencv_and_never_give_a_wrong_ray(coefficients, seed):
    """Of any coefficients, not of lenses alone: a pixel has the ray that gives it back, or none."""
    camera = Camera(640, 480, 400.0, 410.0, 319.5, 239.5, 0.0, "rational", coefficients)
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1.2, 1.2, (50, 2)), np.ones(50)])
    pixels = camera.project(points)
    seen = np.isfinite(pixels).all(axis=1)
    assert seen.any()
    expected, _ = cv2.projectPoints(points[seen], np.zeros(3), np.zeros(3), camera.K, np.array(coefficients))
    assert np.allclose(pixels[seen], expected.reshape(-1, 2), rtol=1e-9, atol=1e-6)
    rays = camera.unproject(rng.uniform(-200, 900, (50, 2)))
    there = np.isfinite(rays).all(axis=1)
    assert np.isfinite(camera.project(rays[there])).all()
    again = camera.unproject(pixels[seen])
    found = np.isfinite(again).all(axis=1)
    assert np.allclose(camera.project(again[found]), pixels[seen][found], atol=1e-5)


@pytest.mark.parametrize("camera", [AZURE, WIDE], ids=["azure", "wide"])
def test_every_pixel_of_a_rational_lens_has_its_ray(camera):
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 41), np.linspace(0, camera.height - 1, 31))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    assert np.allclose(camera.project(camera.unproject(pixels)), pixels, atol=1e-6)


def test_beyond_the_pole_of_a_rational_lens_there_is_no_image():
    pole = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, 0.0, "rational", (0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0))
    at = np.array([[0.5, 0.0, 1.0], [1.0, 0.0, 1.0], [1.5, 0.0, 1.0]])
    assert np.isfinite(pole.project(at)).all(axis=1).tolist() == [True, False, False]
    assert pole.unproject(pole.project(at[:1]))[0] == pytest.approx(at[0])
    same = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, 0.0, "rational", (-0.1, 0.01, 1e-3, 2e-3, 0.02, 0.0, 0.0, 0.0))
    brown = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, 0.0, "radtan", (-0.1, 0.01, 1e-3, 2e-3, 0.02))
    points, pixels = points_in_view(brown, 4)
    assert np.allclose(same.project(points), brown.project(points), rtol=0.0, atol=1e-10)
    assert np.allclose(same.normalise(pixels), brown.normalise(pixels), rtol=0.0, atol=1e-9)


def test_points_without_an_image_are_nan_not_wrong():
    behind = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])
    for camera in CAMERAS.values():
        assert np.isnan(camera.project(behind)).all()
    barrel = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, 0.0, "radtan", (-0.3, 0.0, 0.0, 0.0))
    beyond_the_fold = np.array([[3.0, 0.0, 1.0]])
    assert np.isnan(barrel.project(beyond_the_fold)).all()
    assert np.isnan(IDEAL.normalise(np.array([[np.nan, 3.0], [np.inf, 1.0]]))).all()


@pytest.mark.parametrize(("camera", "most"), [(EUROC, 2), (AZURE, 3)], ids=["euroc", "azure"])
def test_undistorted_image_agrees_with_opencv(camera, most):
    size = (camera.width, camera.height)
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, size[::-1], dtype=np.uint8), (0, 0), 3)
    expected = cv2.undistort(image, camera.K, np.array(camera.coefficients))
    maps = camera.resampling_maps(np.linalg.inv(camera.K), np.eye(3), size)
    got = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    assert np.abs(got.astype(int) - expected).max() <= most  # OpenCV rounds its maps to 1/32 px


def test_an_image_of_another_size_is_refused():
    with pytest.raises(DataError, match="640x480 but the calibration is for 752x480"):
        EUROC.check_image(np.zeros((480, 640), np.uint8))


def test_scaled_camera_sees_the_same_rays():
    _, pixels = points_in_view(EUROC, 3)
    half = EUROC.scaled(0.5)
    assert np.allclose(half.normalise((pixels + 0.5) * 0.5 - 0.5), EUROC.normalise(pixels), atol=1e-9)


def test_impossible_calibrations_are_refused():
    with pytest.raises(DataError, match="finite with positive focal"):
        Camera(640, 480, float("nan"), 500, 320, 240)
    with pytest.raises(DataError, match="takes"):
        Camera(640, 480, 500, 500, 320, 240, 0.0, "radtan", (0.1,))
    with pytest.raises(DataError, match=r"rational distortion takes \(8,\) coefficients, got 5"):
        Camera(640, 480, 500, 500, 320, 240, 0.0, "rational", (0.1,) * 5)
    with pytest.raises(DataError, match="not a rigid transform"):
        Rig((IDEAL,), (2.0 * np.eye(4),))


def test_rectified_points_share_a_row_and_disparity_gives_depth():
    left_pose = transform(so3_exp(np.array([0.01, -0.02, 0.03])), np.array([0.0, 0.1, 0.0]))
    offset = transform(so3_exp(np.array([-0.02, 0.01, 0.005])), np.array([0.11, 0.002, -0.003]))
    rig = Rig((EUROC, SKEWED), (left_pose, left_pose @ offset))
    stereo = rectify(rig)
    assert stereo.baseline_m == pytest.approx(np.linalg.norm(offset[:3, 3]), abs=1e-9)
    rng = np.random.default_rng(5)
    rectified = np.column_stack([rng.uniform(-0.3, 0.3, 50), rng.uniform(-0.25, 0.25, 50), np.ones(50)])
    rectified *= rng.uniform(1.0, 8.0, (50, 1))
    first = rectified @ stereo.R_rect_cam0  # R^T p
    second = (first - rig.T_cam0_cam1[:3, 3]) @ rig.T_cam0_cam1[:3, :3]
    u = stereo.K[0, 0] * rectified[:, 0] / rectified[:, 2] + stereo.K[0, 2]
    v = stereo.K[1, 1] * rectified[:, 1] / rectified[:, 2] + stereo.K[1, 2]
    disparity = stereo.K[0, 0] * stereo.baseline_m / rectified[:, 2]
    for maps, camera, points, columns in (
        (stereo.maps0, EUROC, first, u),
        (stereo.maps1, SKEWED, second, u - disparity),
    ):
        inside = (columns > 1) & (columns < stereo.size[0] - 2) & (v > 1) & (v < stereo.size[1] - 2)
        assert inside.sum() > 20
        args = (columns[inside].astype(np.float32), v[inside].astype(np.float32), cv2.INTER_LINEAR)
        looked_up = np.column_stack([cv2.remap(m, *args).ravel() for m in maps])
        assert np.abs(looked_up - camera.project(points[inside])).max() < 0.05
    with pytest.raises(DataError, match="two cameras"):
        rectify(Rig((EUROC,), (np.eye(4),)))
    with pytest.raises(DataError, match="swap the cameras"):
        rectify(Rig((EUROC, SKEWED), (left_pose @ offset, left_pose)))
    with pytest.raises(DataError, match="same place"):
        rectify(Rig((EUROC, SKEWED), (left_pose, left_pose @ transform(offset[:3, :3], np.zeros(3)))))


@pytest.mark.parametrize("margin_px", [0.0, 5.0])
def test_an_image_ends_at_the_middle_of_its_last_pixels(margin_px):
    low, high = np.full(2, margin_px), np.array([IDEAL.width, IDEAL.height]) - 1.0 - margin_px
    for axis in (0, 1):
        out = 0.01 * np.eye(2)[axis]
        asked = np.array([low, high, low - out, high + out, np.full(2, np.nan)])
        assert IDEAL.contains(asked, margin_px).tolist() == [True, True, False, False, False]
