"""Cameras from views of a board: truth within honest sigmas, every kind of source, and refusals."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from vislam.calibration.cameras.board import Board, View
from vislam.calibration.cameras.camera import choose_lens
from vislam.calibration.cameras.lens import Model, direction_sigma_px, fit_lens, parameters_of
from vislam.calibration.cameras.views import choose, live_images
from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array
from vislam.datasets.camera_files import read_cameras
from vislam.hw.health import Health
from vislam.hw.source import CapturedImage
from worlds.board import BOARD, CHESSBOARD, DOUBLE, FISHEYE, WEBCAM, pose, pose_around, see
from worlds.calibration import calibrate, refusal

SIGMA_PX = 0.2


def seen(camera: Camera, rng: np.random.Generator, count: int, half_rad: float | None = None) -> list[View]:
    """Views as ideal corners with white noise, without rendering; within `half_rad` of the axis, before it if None."""
    x, y = np.meshgrid(np.arange(1, BOARD.columns), np.arange(1, BOARD.rows))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * BOARD.square_m
    views = []
    while len(views) < count:
        T = pose(rng, camera, BOARD) if half_rad is None else pose_around(rng, camera, BOARD, half_rad)
        pixels = camera.project(points @ T[:3, :3].T + T[:3, 3])
        inside = camera.contains(pixels, 5.0)
        if inside.sum() < 12:
            continue
        pixels = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
        views.append(View(f"view {len(views)}", points[inside], pixels[inside]))
    return views


def size_of(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


SLANTED = replace(WEBCAM, skew_px=6.0)


@pytest.mark.parametrize(
    ("camera", "model", "skew"),
    [(WEBCAM, "radtan", False), (FISHEYE, "equidistant", False), (SLANTED, "radtan", True), (WEBCAM, "radtan", True),
     (replace(FISHEYE, skew_px=-4.0), "equidistant", True)],
)  # fmt: skip
def test_errors_are_as_large_as_their_sigmas(camera: Camera, model: Model, skew: bool) -> None:
    ratios = []
    for seed in range(12):
        fit = fit_lens(seen(camera, np.random.default_rng(seed), 12), size_of(camera), model, skew)
        ratios.append((fit.values - parameters_of(camera, skew)) / fit.sigmas)
        assert fit.names[4] == ("s" if skew else "k1")
        assert fit.rms_px == pytest.approx(np.sqrt(2.0) * SIGMA_PX, rel=0.1)
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.25


def test_sigmas_agree_with_those_of_opencv() -> None:
    views = seen(WEBCAM, np.random.default_rng(5), 20)
    fit = fit_lens(views, size_of(WEBCAM), "radtan")
    points = [view.points_m.astype(np.float32)[:, None] for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    found = cv2.calibrateCameraExtended(points, pixels, size_of(WEBCAM), np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3)
    K, k, sigmas = found[1], np.ravel(found[2]), np.ravel(found[5])
    assert parameters_of(fit.camera)[:4] == pytest.approx([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], rel=1e-4)
    assert fit.camera.coefficients == pytest.approx(k[:4], abs=1e-3)
    assert fit.sigmas / np.sqrt(fit.grouping) == pytest.approx(sigmas[:8], rel=0.1)


def test_a_view_that_is_wrong_as_a_whole_widens_the_sigmas_and_corners_that_are_wrong_are_left_out() -> None:
    rng = np.random.default_rng(7)
    views = seen(WEBCAM, rng, 20)
    good = fit_lens(views, size_of(WEBCAM), "radtan")
    stretched = [
        replace(view, points_m=view.points_m * np.array([1.0 + rng.normal(0.0, 0.01), 1.0, 1.0])) for view in views
    ]
    bent = fit_lens(stretched, size_of(WEBCAM), "radtan")
    assert bent.grouping > 3.0 > good.grouping
    spoiled = [replace(view, pixels=view.pixels.copy()) for view in views]
    for view in spoiled[:10]:
        view.pixels[3] += 25.0
    robust = fit_lens(spoiled, size_of(WEBCAM), "radtan")
    assert robust.outliers >= 10
    assert np.all(np.abs(parameters_of(robust.camera) - parameters_of(WEBCAM)) < 5.0 * robust.sigmas)


def test_rays_are_least_sure_where_no_corner_was_seen() -> None:
    views = seen(WEBCAM, np.random.default_rng(2), 30)
    left = [
        View(view.name, view.points_m[keep], view.pixels[keep])
        for view in views
        if (keep := view.pixels[:, 0] < 380.0).sum() > 12
    ]
    fit = fit_lens(left, size_of(WEBCAM), "radtan")
    grid = direction_sigma_px(fit, 9, 7)
    assert np.nanmean(grid[:, -1]) > 1.5 * np.nanmean(grid[:, 2])
    errors = np.abs(fit.camera.project(WEBCAM.unproject(np.array([[100.0, 240.0]]))) - [100.0, 240.0])
    assert errors.max() < 5.0


def test_views_are_chosen_for_what_they_add() -> None:
    views = seen(WEBCAM, np.random.default_rng(2), 12)
    again = [replace(view, name=f"{view.name} again", pixels=view.pixels + 0.1) for view in views]
    chosen = choose(views + again, size_of(WEBCAM), 12)
    assert len({view.name.removesuffix(" again") for view in chosen}) == 12
    assert len(choose([views[0]] * 5, size_of(WEBCAM), 12)) == 1
    assert choose([], size_of(WEBCAM), 3) == []


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of rendered images, one of them damaged and one without a board."""
    folder = tmp_path_factory.mktemp("pictures")
    rng = np.random.default_rng(3)
    for k in range(13):
        cv2.imwrite(str(folder / f"{k:02d}.png"), see(WEBCAM, BOARD, pose(rng, WEBCAM, BOARD), rng))
    (folder / "13.png").write_bytes((folder / "00.png").read_bytes()[:5000])
    cv2.imwrite(str(folder / "14.png"), np.full((480, 640), 90, dtype=np.uint8))
    return folder


def test_the_verb_writes_files_of_three_kinds(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    answer = calibrate(capsys, "camera", pictures, "--out", out)
    assert answer["images"] == 14 and answer["unreadable"] == 1 and 11 <= answer["images_with_board"] <= 13
    truth = dict(zip(answer["parameters"], parameters_of(WEBCAM), strict=True))
    for name, value in answer["parameters"].items():
        assert abs(value - truth[name]) < 4.0 * answer["sigmas"][name]
    assert answer["sigmas"]["fx"] < 0.005 * 520.0
    cameras = [read_cameras(out / name)[0].camera for name in ("camchain.yaml", "camera.yaml", "camera_info.yaml")]
    assert cameras[0] == cameras[1] == replace(cameras[2], sigmas=cameras[0].sigmas)  # ROS's file has none
    assert cameras[0].sigmas.focal == pytest.approx(
        max(answer["sigmas"][f] / answer["parameters"][f] for f in ("fx", "fy"))
    )
    assert cameras[0].fx == answer["parameters"]["fx"]
    assert len(answer["views"]) == len({*answer["views"]}) and all(v["rms_px"] < 1.0 for v in answer["views"].values())
    picture = cv2.imread(str(out / "camera.png"))
    assert picture is not None and picture.std() > 10.0


def test_the_skew_is_found_where_it_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "slanted"
    folder.mkdir()
    rng = np.random.default_rng(4)
    for k in range(12):
        cv2.imwrite(str(folder / f"{k:02d}.png"), see(SLANTED, BOARD, pose(rng, SLANTED, BOARD), rng))
    answer = calibrate(capsys, "camera", folder, "--out", tmp_path / "with", "--skew")
    assert abs(answer["parameters"]["s"] - 6.0) < 4.0 * answer["sigmas"]["s"] < 3.0
    assert any("differs from zero" in said for said in answer["statements"])
    names = ("camchain.yaml", "camera.yaml", "camera_info.yaml")
    assert {read_cameras(tmp_path / "with" / name)[0].camera.skew_px for name in names} == {answer["parameters"]["s"]}
    with pytest.raises(AssertionError, match="focal length would be known to"):  # refused rather than told wrong
        calibrate(capsys, "camera", folder, "--out", tmp_path / "without")


def test_a_lens_of_195_degrees_is_calibrated_by_the_model_that_views_speak_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out, rng = tmp_path / "wide", tmp_path / "out", np.random.default_rng(1)
    folder.mkdir()
    for k in range(20):
        cv2.imwrite(str(folder / f"{k:02d}.png"), see(DOUBLE, BOARD, pose_around(rng, DOUBLE, BOARD, 1.65), rng))
    answer = calibrate(capsys, "camera", folder, "--out", out)
    assert answer["rms_px"] < 0.3 and answer["model"] in ("ds", "eucm")
    assert answer["criterion"]["radtan"] > 1000.0 and abs(answer["criterion"]["ds"]) < 10.0
    camera = read_cameras(out / "camchain.yaml")[0].camera
    pixels = rng.uniform([0.0, 0.0], [639.0, 479.0], (500, 2))
    rays = DOUBLE.bearings(pixels)
    within = rays[:, 2] > np.cos(np.deg2rad(97.0))
    assert (rays[within, 2] < 0.0).sum() > 20  # behind the camera
    off = camera.project(rays[within]) - pixels[within]
    assert np.abs(off - np.median(off, axis=0)).max() < 1.0
    assert not (out / "camera_info.yaml").exists()  # ROS has no such lens
    assert any("ROS has no such lens" in said for said in answer["statements"])


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("ucm", (0.6,)), ("eucm", (0.62, 1.15)), ("ds", (-0.25, 0.56)), ("omni", (1.4, -0.3, 0.02, 1e-3, -1e-3))],
)
def test_lenses_over_spheres_are_found_behind_the_camera_too(model: Model, coefficients: tuple[float, ...]) -> None:
    camera = replace(DOUBLE, distortion=model, coefficients=coefficients)
    views = seen(camera, np.random.default_rng(3), 20, half_rad=1.65)
    fit = fit_lens(views, size_of(camera), model)
    assert fit.rms_px == pytest.approx(np.sqrt(2.0) * SIGMA_PX, rel=0.1)
    assert np.all(np.abs(fit.values - parameters_of(camera)) < 4.0 * fit.sigmas)
    assert 0.1 < fit.sigmas[0] < 1.0
    _, chosen, criterion = choose_lens(views, size_of(camera))
    assert criterion[model] < 10.0 < criterion["radtan"] and len(chosen.camera.coefficients) <= len(coefficients)


def test_of_a_lens_that_radtan_explains_no_other_is_taken() -> None:
    model, fit, criterion = choose_lens(seen(WEBCAM, np.random.default_rng(0), 16), size_of(WEBCAM))
    assert model == "radtan" and fit.camera.distortion == "radtan" and min(criterion.values()) == 0.0


def test_a_video_and_a_live_camera_do_as_well(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = [cv2.imread(str(pictures / f"{k:02d}.png"), cv2.IMREAD_GRAYSCALE) for k in range(3)]
    path = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (640, 480))
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    assert "3 of 3 images show the board" in refusal(capsys, "camera", path, "--out", tmp_path / "out")

    class Source:
        index = 0

        def read(self, timeout_s: float) -> CapturedImage | None:
            self.index += 1
            return CapturedImage(0, self.index, images[self.index % 3]) if self.index < 4 else None

        def health(self) -> Health:
            return Health(0)

        def counters(self) -> dict[str, int]:
            return {}

        def close(self) -> None: ...

    times = iter(np.arange(0.0, 100.0, 0.1))
    live = live_images(Source(), 0.5, lambda: float(next(times)))
    assert BOARD.find(next(live)[1], "live") is not None
    with pytest.raises(DataError, match="gives no images"):
        list(live_images(Source(), 5.0, lambda: float(next(times))))


def test_a_chessboard_is_found_where_it_is() -> None:
    rng = np.random.default_rng(11)
    T = pose(rng, WEBCAM, CHESSBOARD, 0.3)
    T[:3, 3] += T[:3, 2] * 0.0 + np.array([0.0, 0.0, 0.25])
    view = CHESSBOARD.find(see(WEBCAM, CHESSBOARD, T, rng), "c")
    assert view is not None and len(view.points_m) == 40
    expected = WEBCAM.project(view.points_m @ T[:3, :3].T + T[:3, 3])
    turned = WEBCAM.project((np.array([0.27, 0.18, 0.0]) - view.points_m) @ T[:3, :3].T + T[:3, 3])
    errors = [np.abs(view.pixels - e).max() for e in (expected, turned)]
    assert min(errors) < 0.6  # a 9 x 6 board looks the same upside down


def test_the_printed_board_has_its_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answer = calibrate(capsys, "board", "--out", tmp_path / "b", "--square-mm", 25)
    assert answer["paper"] == "a4"
    page = np.asarray(Image.open(tmp_path / "b/board.png"))
    assert Image.open(tmp_path / "b/board.png").info["dpi"] == pytest.approx((300, 300), abs=0.1)
    view = Board("charuco", 9, 6, 0.025, 0.01875, "5X5_100").find(page, "page")
    assert view is not None and len(view.points_m) == 40
    apart = np.linalg.norm(view.pixels[-1] - view.pixels[0]) / 300.0 * 0.0254
    assert apart == pytest.approx(np.linalg.norm(view.points_m[-1] - view.points_m[0]), rel=1e-3)
    assert (tmp_path / "b/board.pdf").read_bytes().startswith(b"%PDF")
    twice = calibrate(capsys, "board", "--out", tmp_path / "c", "--square-mm", 25)
    assert twice == answer
    assert (tmp_path / "c/board.pdf").read_bytes() == (tmp_path / "b/board.pdf").read_bytes()
    assert "another --paper" in refusal(
        capsys, "board", "--square-mm", 60, "--paper", "a4", "--out", tmp_path / "d", code=2
    )
    assert "no paper" in refusal(capsys, "board", "--square-mm", 160, "--out", tmp_path / "d", code=2)


@pytest.mark.parametrize(
    "board",
    [("charuco", 2, 6, 0.03, 0.02, "5X5_100"), ("charuco", 9, 6, 0.03, 0.03, "5X5_100"),
     ("charuco", 9, 6, 0.03, 0.02, "9X9_1"), ("charuco", 30, 30, 0.03, 0.02, "5X5_100")],
)  # fmt: skip
def test_boards_that_cannot_be_are_refused(board: tuple[str, int, int, float, float, str]) -> None:
    with pytest.raises(UsageError):
        Board(*board)  # type: ignore[arg-type]


def render(folder: Path, poses: list[Array]) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k, T in enumerate(poses):
        cv2.imwrite(str(folder / f"{k:02d}.png"), see(WEBCAM, BOARD, T, rng))
    return folder


def test_refusals(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ("--out", tmp_path / "out")
    assert "neither PNG nor JPEG" in refusal(capsys, "camera", _folder(tmp_path / "empty", "mav0/imu0"), *out)
    assert "show the board" in refusal(capsys, "camera", pictures, "--dictionary", "4X4_50", *out)
    rng = np.random.default_rng(1)
    near = pose(rng, WEBCAM, BOARD, 0.5)
    same = render(tmp_path / "same", [near] * 8)
    assert "1 of them differ" in refusal(capsys, "camera", same, *out)
    slanted = [pose(rng, WEBCAM, BOARD, 0.5) for _ in range(8)]
    for T in slanted:
        T[:3, 3] = np.array([-0.13, -0.09, 0.62]) + 0.02 * rng.normal(size=3)
    assert "has seen corners" in refusal(capsys, "camera", render(tmp_path / "far", slanted), *out)
    flat = [np.eye(4) for _ in range(9)]
    for k, T in enumerate(flat):
        T[:3, 3] = [-0.135 + 0.06 * (k % 3 - 1), -0.09 + 0.05 * (k // 3 - 1), 0.28]
    assert "faces the camera" in refusal(capsys, "camera", render(tmp_path / "flat", flat), *out)
    other = tmp_path / "sizes"
    other.mkdir()
    for k, shape in enumerate(((48, 64), (64, 48))):
        cv2.imwrite(str(other / f"{k}.png"), np.zeros(shape, dtype=np.uint8))
    assert "one size at a time" in refusal(capsys, "camera", other, *out)
    assert not list((tmp_path / "out").glob("*"))


def _folder(root: Path, inside: str) -> Path:
    (root / inside).mkdir(parents=True)
    return root
