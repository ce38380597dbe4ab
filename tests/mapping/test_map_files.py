import json
import struct
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from needs import missing
from vislam.core.errors import DataError
from vislam.mapping import _open3d
from vislam.mapping._open3d import load_open3d
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.cloud.surfels import Surfels
from vislam.mapping.formats.gaussians import write_gaussians
from vislam.mapping.formats.mesh_files import write_glb, write_obj
from vislam.mapping.formats.pcd import write_pcd
from vislam.mapping.formats.ply import read_ply, read_ply_mesh, read_ply_rows, write_ply
from vislam.mapping.mapper import Mapper
from vislam.mapping.mesh.atlas import TexturedMesh
from vislam.mapping.octree.octomap_io import read_octree
from vislam.mapping.pictures.of_map import write_pictures
from worlds.box import CONFIG, RIG, keyframe, pose


def some_points(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-5, 5, (count, 3)).astype(np.float32), rng.integers(0, 256, (count, 3)).astype(np.uint8)


def read_pcd(path):
    rows = np.frombuffer(path.read_bytes().partition(b"DATA binary\n")[2], "<f4, <f4, <f4, u1, u1, u1, u1")
    return np.stack([rows[f"f{k}"] for k in range(3)], axis=1), np.stack([rows[f"f{k}"] for k in (5, 4, 3)], axis=1)


@pytest.mark.parametrize(("write", "read"), [(write_pcd, read_pcd), (write_ply, read_ply)])
@pytest.mark.parametrize("count", [0, 1, 65_537, 140_000])
def test_what_was_written_is_read_back(tmp_path, count, write, read):
    points, colors = some_points(count)
    write(tmp_path / "a", points, colors)
    got_points, got_colors = read(tmp_path / "a")
    np.testing.assert_array_equal(got_points, points)
    np.testing.assert_array_equal(got_colors, colors)


def test_open3d_reads_our_clouds(tmp_path):
    open3d, reason = load_open3d()
    if open3d is None:
        missing(reason)
    points, colors = some_points(70_000)
    write_pcd(tmp_path / "a.pcd", points, colors)
    write_ply(tmp_path / "a.ply", points, colors, extra={"nx": points[:, 0], "ny": points[:, 1], "nz": points[:, 2]})
    for name in ("a.pcd", "a.ply"):
        cloud = open3d.io.read_point_cloud(str(tmp_path / name))
        np.testing.assert_allclose(np.asarray(cloud.points), points, atol=1e-6)
        np.testing.assert_allclose(np.asarray(cloud.colors) * 255, colors, atol=0.51)
    np.testing.assert_allclose(np.asarray(cloud.normals), points, atol=1e-6)


def test_a_gaussian_lies_on_its_surface(tmp_path):
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(50, 3))
    normals[0] = (0.0, 0.0, -1.0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points, colors = some_points(50)
    none = np.zeros(50, np.int64)
    confidence = np.linspace(0.1, 30.0, 50)
    write_gaussians(
        tmp_path / "a.ply",
        Surfels(points, normals, colors, 0.02 * np.ones(50), confidence, none, none, none, none, none), 0.02,
    )  # fmt: skip
    got = read_ply_rows(tmp_path / "a.ply")
    R = Rotation.from_quat(np.column_stack([got[f"rot_{i}"] for i in (1, 2, 3, 0)])).as_matrix()
    np.testing.assert_allclose(R[:, :, 2], normals, atol=1e-6)
    np.testing.assert_allclose(np.exp(got["scale_0"]), 0.01, rtol=1e-6)
    np.testing.assert_allclose(np.exp(got["scale_2"]), 0.002 / np.sqrt(confidence), rtol=1e-5)
    for i in range(3):
        np.testing.assert_allclose((0.28209479 * got[f"f_dc_{i}"] + 0.5) * 255, colors[:, i], atol=1e-3)


def test_extra_properties_do_not_hide_the_rest(tmp_path):
    points, colors = some_points(10)
    write_ply(tmp_path / "a.ply", points, colors, extra={"radius": points[:, 0], "confidence": points[:, 1]})
    got_points, got_colors = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(got_points, points)
    np.testing.assert_array_equal(got_colors, colors)
    assert b"property float radius\nproperty float confidence\nend_header" in (tmp_path / "a.ply").read_bytes()


def square():
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0.5], [-1, 1, 0.5]], np.float32)
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]], np.uint8)
    return Mesh(points, colors, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def write_mesh(path):
    mesh = square()
    write_ply(path, mesh.points_m, mesh.colors, mesh.triangles)
    return mesh


def test_a_mesh_is_read_back(tmp_path):
    mesh = write_mesh(tmp_path / "a.ply")
    for got, wrote in zip(read_ply_mesh(tmp_path / "a.ply"), (mesh.points_m, mesh.colors, mesh.triangles), strict=True):
        np.testing.assert_array_equal(got, wrote)
        assert got.dtype == wrote.dtype


def test_what_fills_holes_is_marked_in_every_format(tmp_path):
    mesh = replace(square(), filled=1)
    write_ply(tmp_path / "a.ply", mesh.points_m, mesh.colors, mesh.triangles, filled=1)
    np.testing.assert_array_equal(read_ply_mesh(tmp_path / "a.ply")[2], mesh.triangles)
    assert (tmp_path / "a.ply").read_bytes()[-1] == 1  # of the last triangle
    assert b"property uchar filled" in (tmp_path / "a.ply").read_bytes()
    write_obj(tmp_path / "a.obj", mesh)
    assert (tmp_path / "a.obj").read_text().endswith("g seen\nf 1 2 3\ng filled\nf 1 3 4\n")
    write_glb(tmp_path / "a.glb", mesh)
    data = (tmp_path / "a.glb").read_bytes()
    seen, closes = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])["meshes"][0]["primitives"]
    assert "extras" not in seen
    assert closes["extras"] == {"filled": True}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"element face 2", b"element face 3", "is cut"),
        (b"element face 2", b"element face " + b"9" * 12, "is cut"),
        (b"element face 2", b"element face " + b"9" * 50, "element face COUNT"),
        (b"element face 2", b"element face -2", "element face COUNT"),
        (b"element face 2\nproperty list uchar int vertex_indices\n", b"", "element face COUNT"),
        (b"list uchar int", b"list uchar uint", "element face COUNT"),
        (struct.pack("<B3i", 3, 0, 2, 3), struct.pack("<B3i", 3, 0, 2, 4), "not a triangle"),
        (struct.pack("<B3i", 3, 0, 2, 3), struct.pack("<B3i", 3, 0, -1, 3), "not a triangle"),
        (struct.pack("<B3i", 3, 0, 2, 3), struct.pack("<B3i", 4, 0, 2, 3), "not a triangle"),
    ],
)
def test_damaged_and_hostile_meshes_are_errors(tmp_path, old, new, words):
    path = tmp_path / "a.ply"
    write_mesh(path)
    whole = path.read_bytes()
    assert whole.count(old) == 1
    path.write_bytes(whole.replace(old, new))
    with pytest.raises(DataError, match=words):
        read_ply_mesh(path)


@pytest.mark.parametrize(
    ("read", "write"),
    [
        (read_ply, lambda path: write_ply(path, *some_points(20))),
        (read_ply_mesh, write_mesh),
    ],
)
def test_any_damage_is_an_error_or_another_cloud_or_mesh(tmp_path, read, write):
    path = tmp_path / "file"
    write(path)
    whole = path.read_bytes()

    @settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.integers(0, len(whole) - 1), st.binary(max_size=6), st.integers(0, len(whole)))
    def damage(place, put, length):
        path.write_bytes((whole[:place] + put + whole[place + len(put) :])[:length])
        try:
            points, colors, *meshed = read(path)
        except DataError:
            return
        assert points.shape == colors.shape
        assert points.nbytes <= 12 * len(whole)
        assert all(triangles.size == 0 or triangles.max() < len(points) for triangles in meshed)

    damage()


def test_glb_holds_the_mesh_with_its_colours(tmp_path):
    mesh = square()
    write_glb(tmp_path / "a.glb", mesh)
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, json_length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    text = json.loads(data[20 : 20 + json_length])
    binary = data[28 + json_length :]
    assert struct.unpack("<I4s", data[20 + json_length : 28 + json_length]) == (len(binary), b"BIN\0")
    assert [view["byteOffset"] % 4 for view in text["bufferViews"]] == [0, 0, 0]
    dtypes = {5126: "<f4", 5121: "u1", 5125: "<u4"}
    parts = [
        np.frombuffer(binary, dtypes[text["accessors"][i]["componentType"]],
                      view["byteLength"] // np.dtype(dtypes[text["accessors"][i]["componentType"]]).itemsize,
                      view["byteOffset"])
        for i, view in enumerate(text["bufferViews"])
    ]  # fmt: skip
    np.testing.assert_array_equal(parts[0].reshape(-1, 3), mesh.points_m)
    np.testing.assert_array_equal(parts[1].reshape(-1, 4)[:, :3], mesh.colors)
    np.testing.assert_array_equal(parts[2].reshape(-1, 3), mesh.triangles)
    matrix = np.array(text["nodes"][0]["matrix"]).reshape(4, 4).T
    assert (matrix @ [0, 0, 1, 0]).tolist() == [0, 1, 0, 0]  # up is up


def test_glb_with_a_picture_holds_both_parts_and_the_picture(tmp_path):
    mesh = square()
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)[: len(mesh.points_m)]
    atlas = np.zeros((16, 32, 3), np.uint8)
    atlas[..., 0] = 200  # red
    rest = Mesh(mesh.points_m[:3], mesh.colors[:3], np.array([[0, 1, 2]], np.int32))
    textured = TexturedMesh(mesh.points_m, uv, mesh.triangles, atlas, rest)
    write_glb(tmp_path / "a.glb", mesh, textured)
    data = (tmp_path / "a.glb").read_bytes()
    json_length = struct.unpack("<I", data[12:16])[0]
    text, binary = json.loads(data[20 : 20 + json_length]), data[28 + json_length :]
    assert struct.unpack("<I", data[8:12])[0] == len(data)
    assert text["buffers"][0]["byteLength"] == len(binary)
    pictured, coloured = text["meshes"][0]["primitives"]
    assert set(pictured["attributes"]) == {"POSITION", "TEXCOORD_0"}
    assert set(coloured["attributes"]) == {"POSITION", "COLOR_0"}
    assert "baseColorTexture" in text["materials"][pictured["material"]]["pbrMetallicRoughness"]
    assert "baseColorTexture" not in text["materials"][coloured["material"]]["pbrMetallicRoughness"]

    def rows(accessor, dtype, columns):
        view = text["bufferViews"][text["accessors"][accessor]["bufferView"]]
        part = np.frombuffer(binary, dtype, view["byteLength"] // np.dtype(dtype).itemsize, view["byteOffset"])
        return part.reshape(-1, columns)

    np.testing.assert_array_equal(rows(pictured["attributes"]["POSITION"], "<f4", 3), mesh.points_m)
    np.testing.assert_array_equal(rows(pictured["attributes"]["TEXCOORD_0"], "<f4", 2), uv)
    np.testing.assert_array_equal(rows(pictured["indices"], "<u4", 3), mesh.triangles)
    np.testing.assert_array_equal(rows(coloured["indices"], "<u4", 3), rest.triangles)
    view = text["bufferViews"][text["images"][0]["bufferView"]]
    jpeg = np.frombuffer(binary, np.uint8, view["byteLength"], view["byteOffset"])
    shown = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert shown.shape == atlas.shape
    assert np.abs(shown[..., ::-1].astype(int) - atlas).max() < 8


@pytest.mark.parametrize("name", ["a.glb", "a.obj"])
def test_open3d_reads_our_meshes(tmp_path, name):
    open3d, reason = load_open3d()
    if open3d is None:
        missing(reason)
    mesh = square()
    (write_glb if name.endswith("glb") else write_obj)(tmp_path / name, mesh)
    got = open3d.io.read_triangle_mesh(str(tmp_path / name))
    assert len(got.vertices) == 4
    assert len(got.triangles) == 2
    area = got.get_surface_area()
    assert area == pytest.approx(2.0 * np.hypot(2.0, 0.5), rel=1e-5)
    if name.endswith("obj"):
        np.testing.assert_allclose(np.asarray(got.vertices), mesh.points_m, atol=1e-4)


def room(products):
    mapper = Mapper(replace(CONFIG, products=products, surfel_m=0.05, mesh_voxel_m=0.05, poisson_depth=5), RIG)
    for k in range(8):
        mapper.add(keyframe(k), pose(k))
    return mapper


def test_every_product_is_a_file(tmp_path):
    if load_open3d()[0] is None:
        missing("open3d")
    products = ("cloud", "pcd", "octomap", "ot", "grid", "drive", "mesh", "glb", "obj", "poisson", "surfels", "splats")
    mapper, told = room(products), []
    written = mapper.export(tmp_path, told.append)
    assert tuple(told) == products
    assert set(written) == {*products, "grid_yaml", "drive_yaml"}
    assert mapper.notes == {}
    assert all(path.is_file() for path in written.values())
    np.testing.assert_array_equal(read_pcd(written["pcd"])[0], read_ply(written["cloud"])[0])
    plain, coloured = read_octree(written["octomap"]), read_octree(written["ot"])
    np.testing.assert_array_equal(coloured.occupied_voxels(), plain.occupied_voxels())
    shown = coloured.colors[(coloured.colors != 255).any(axis=1)]
    assert len(shown) > 0.5 * (coloured.log_odds >= 0.0).sum()
    assert np.abs(np.median(shown, axis=0) - [200, 0, 0]).max() <= 4
    surfels, _ = read_ply(written["surfels"])
    poisson, _ = read_ply(written["poisson"])
    for points in (surfels, poisson):
        distance = np.minimum(np.abs(points - [-2.5, -2, 0]), np.abs(points - [2.5, 2, 2.4])).min(axis=1)
        assert np.percentile(distance, 90) < 0.08
    again = room(products).export(tmp_path / "again")
    assert {name: path.read_bytes() for name, path in again.items()} == {
        name: path.read_bytes() for name, path in written.items()
    }


def test_cloud_mesh_and_octree_are_drawn(tmp_path):
    if load_open3d()[0] is None:
        missing("open3d")
    mapper = room(("cloud", "mesh"))
    mapper.export(tmp_path)
    path_m = np.array([pose(k)[:3, 3] for k in range(8)])
    pictures = {path.stem: cv2.imread(str(path)).astype(int) for path in write_pictures(mapper, tmp_path, path_m, True)}
    assert set(pictures) - {"picture_where_to_drive"} == {"picture_cloud", "picture_mesh", "picture_octree"}
    for name in ("picture_cloud", "picture_mesh"):  # the room's red
        blue, green, red = pictures[name].transpose(2, 0, 1)
        assert ((red > 100) & (green < 60) & (blue < 60)).mean() > 0.05
    write_pictures(mapper, tmp_path, path_m, False)  # what is coloured by height means nothing where z may not be up
    assert {path.stem for path in tmp_path.glob("*.png")} == {"picture_cloud", "picture_mesh"}


def test_without_open3d_only_meshes_are_missing_and_said(tmp_path, monkeypatch):
    def absent(_):
        raise ImportError("No module named 'open3d'")

    monkeypatch.setattr(_open3d, "importlib", SimpleNamespace(import_module=absent))
    mapper = room(("cloud", "surfels", "mesh", "glb", "poisson", "drive"))
    assert set(mapper.export(tmp_path)) == {"cloud", "surfels", "drive", "drive_yaml"}
    assert set(mapper.notes) == {"mesh", "glb", "poisson"}
    assert all("open3d" in reason for reason in mapper.notes.values())


def test_an_empty_map_says_what_it_cannot_give(tmp_path):
    mapper = Mapper(replace(CONFIG, products=("surfels", "mesh", "poisson", "drive", "pcd")), RIG)
    assert set(mapper.export(tmp_path)) == {"drive", "drive_yaml", "pcd"}
    assert set(mapper.notes) == {"surfels", "mesh", "poisson"}


def test_one_stray_keyframe_far_away_costs_the_grids_and_nothing_else(tmp_path):
    mapper = room(("drive", "cloud", "octomap"))
    far = pose(0)
    far[:3, 3] += [1500.0, -1500.0, 0.0]
    mapper.add(keyframe(8), far)
    assert set(mapper.export(tmp_path)) == {"cloud", "octomap"}
    assert "coarser" in mapper.notes["drive"]
    assert [path.name for path in write_pictures(mapper, tmp_path, np.zeros((0, 3)), True)] != []
