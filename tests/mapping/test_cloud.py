import numpy as np
import pytest

from needs import missing
from vislam.core.errors import DataError, StorageError
from vislam.mapping._open3d import load_open3d
from vislam.mapping.cloud.cloud import Cloud, VoxelAverage, voxel_filter, without_outliers
from vislam.mapping.formats.ply import read_ply, write_ply


def random_cloud(count, seed=0, reach=1.0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-reach, reach, (count, 3)).astype(np.float32)
    return Cloud(points, rng.integers(0, 256, (count, 3), dtype=np.uint8))


def test_voxel_filter_averages_position_and_colour():
    cloud = random_cloud(2000)
    groups = {}
    for point, color in zip(cloud.points_m, cloud.colors, strict=True):
        key = tuple(np.floor(point.astype(np.float64) / 0.25).astype(int))
        groups.setdefault(key, []).append(np.concatenate([point, color]).astype(np.float64))
    expected = np.array([np.mean(group, axis=0) for group in groups.values()])
    thin = voxel_filter(cloud, 0.25)
    np.testing.assert_allclose(thin.points_m, expected[:, :3], atol=1e-6)
    np.testing.assert_allclose(thin.colors, expected[:, 3:], atol=0.51)


def test_adding_in_pieces_is_adding_at_once():
    cloud = random_cloud(30000)
    whole, pieces = VoxelAverage(0.02), VoxelAverage(0.02)
    whole.add(cloud)
    for start in range(0, 30000, 777):
        pieces.add(Cloud(cloud.points_m[start : start + 777], cloud.colors[start : start + 777]))
    np.testing.assert_array_equal(whole.cloud().points_m, pieces.cloud().points_m)


def test_precise_points_weigh_more():
    average = VoxelAverage(1.0)
    points = np.array([[0.1, 0.5, 0.5], [0.9, 0.5, 0.5]], np.float32)
    average.add(Cloud(points, np.array([[0, 0, 0], [100, 0, 0]], np.uint8)), np.array([3.0, 1.0], np.float32))
    np.testing.assert_allclose(average.cloud().points_m, [[0.3, 0.5, 0.5]], atol=1e-6)
    assert average.cloud().colors.tolist() == [[25, 0, 0]]


def test_thinly_seen_cells_and_faint_voxels_are_left_out():
    average = VoxelAverage(0.1)
    surface = np.repeat([[0.05, 0.05, 0.05], [0.15, 0.05, 0.05]], 50, axis=0)
    blur = np.array([[0.05, 0.05, 0.25]] * 2)
    lonely = np.array([[5.0, 5.0, 5.0]])
    points = np.concatenate([surface, blur, lonely]).astype(np.float32)
    average.add(Cloud(points, np.zeros((len(points), 3), np.uint8)))
    assert len(average.cloud()) == 4
    np.testing.assert_allclose(average.cloud(2, 0.5).points_m, [[0.05, 0.05, 0.05], [0.15, 0.05, 0.05]], atol=1e-6)


def test_a_cloud_that_gets_too_large_gets_coarser_and_keeps_its_mean():
    average = VoxelAverage(0.01, max_points=500)
    cloud = random_cloud(20000)
    for start in range(0, 20000, 1000):
        average.add(Cloud(cloud.points_m[start : start + 1000], cloud.colors[start : start + 1000]))
    assert average.voxel_m > 0.01
    assert len(average.cloud()) <= 500
    assert np.abs(average.cloud().points_m.mean(axis=0)).max() < 0.1


def test_points_that_are_not_finite_are_left_out():
    points = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [1e30, 0.0, 0.0]], np.float32)
    assert len(voxel_filter(Cloud(points, np.zeros((4, 3), np.uint8)), 0.1)) == 1


def test_stray_points_are_outliers_and_a_wall_is_not():
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(0, 3, 4000), rng.uniform(0, 3, 4000), 0.005 * rng.normal(size=4000)])
    stray = rng.uniform([0, 0, 1.0], [3, 3, 3.0], (15, 3))
    points = np.concatenate([wall, stray]).astype(np.float32)
    kept = without_outliers(Cloud(points, np.zeros((4015, 3), np.uint8)), 2.5, 0.1)
    assert (kept.points_m[:, 2] > 0.5).sum() == 0
    assert len(kept) > 3900


def test_a_handful_of_points_passes_the_outlier_filter():
    cloud = random_cloud(5)
    assert len(without_outliers(cloud, 2.5, 0.1)) == 5
    assert len(without_outliers(random_cloud(0), 2.5, 0.1)) == 0


def test_open3d_reads_our_mesh(tmp_path):
    open3d, reason = load_open3d()
    if open3d is None:
        missing(reason)
    cloud = random_cloud(4)
    write_ply(tmp_path / "m.ply", cloud.points_m, cloud.colors, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "m.ply"))
    np.testing.assert_allclose(np.asarray(mesh.vertices), cloud.points_m, atol=1e-6)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors) * 255, cloud.colors, atol=0.51)
    assert np.asarray(mesh.triangles).tolist() == [[0, 1, 2], [0, 2, 3]]
    np.testing.assert_array_equal(read_ply(tmp_path / "m.ply")[0], cloud.points_m)


HEAD = b"ply\nformat binary_little_endian 1.0\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "header"),
        (b"ply", "header"),
        (b"solid stl\n" * 1000, "header"),
        (b"ply\n" + b"comment x\n" * 10**5, "header"),
        (b"ply\n" + b"x" * 10**6, "header"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n" + XYZ + b"end_header\n1 2 3\n", "binary"),
        (HEAD + b"end_header\n", "element vertex"),
        (HEAD + b"element face 3\nelement vertex 1\n" + XYZ + b"end_header\n", "element vertex"),
        (HEAD + b"element vertex -5\n" + XYZ + b"end_header\n", "element vertex"),
        (HEAD + b"element vertex " + b"9" * 400 + b"\n" + XYZ + b"end_header\n", "element vertex"),
        (HEAD + b"element vertex 999999999999\n" + XYZ + b"end_header\n", "is cut"),
        (HEAD + b"element vertex 2\n" + XYZ + b"end_header\n" + b"\x00" * 23, "is cut"),
        (HEAD + b"element vertex 1\nproperty float x\nend_header\n" + b"\x00" * 4, "lack"),
        (HEAD + b"element vertex 1\n" + XYZ + b"property float x\nend_header\n" + b"\x00" * 16, "property"),
        (HEAD + b"element vertex 1\n" + XYZ + b"property list uchar int q\nend_header\n" + b"\x00" * 99, "property"),
        (HEAD + b"element vertex 1\n" + XYZ + b"property\nend_header\n" + b"\x00" * 99, "property"),
    ],
)
def test_damaged_and_hostile_ply_files_are_errors(tmp_path, content, words):
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words):
        read_ply(path)


def test_a_full_disk_is_a_storage_error_and_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    first = random_cloud(10)
    write_ply(path, first.points_m, first.colors)
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("vislam.core.files.os.fsync", full)
    with pytest.raises(StorageError, match="No space left"):
        write_ply(path, first.points_m[:5], first.colors[:5])
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]
