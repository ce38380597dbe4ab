import json
import re
import shutil
import subprocess
import tracemalloc
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyoctomap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needs import missing
from vislam.cli import run_verb
from vislam.core.errors import DataError
from vislam.mapping.octree.occupancy import Octree
from vislam.mapping.octree.octomap_io import encode_bt, encode_ot, read_octree


def sample_map(seed=11, scans=3):
    rng = np.random.default_rng(seed)
    grid = Octree(0.1)
    for _ in range(scans):
        origin = rng.uniform(-0.5, 0.5, 3)
        grid.insert(origin + rng.uniform(-2, 2, (300, 3)), origin)
    return grid


@pytest.fixture
def bt_bytes():
    return encode_bt(sample_map().max_likelihood_leaves())


def test_round_trip(tmp_path, bt_bytes):
    octree = sample_map().max_likelihood_leaves()
    path = tmp_path / "a.bt"
    path.write_bytes(bt_bytes)
    back = read_octree(path)
    assert back.resolution_m == octree.resolution_m
    np.testing.assert_array_equal(back.starts, octree.starts)
    np.testing.assert_array_equal(back.levels, octree.levels)
    np.testing.assert_array_equal(back.log_odds, octree.log_odds)
    assert encode_bt(back) == bt_bytes


def test_reads_a_map_of_octomap_itself(data_root):
    path = data_root / "octomap" / "geb079.bt"
    octree = read_octree(path)
    content = path.read_bytes()
    assert octree.resolution_m == 0.08
    data = content.index(b"data\n") + 5
    inner = (len(content) - data) // 2
    assert len(octree) == 532566 - inner  # the header's size counts leaves and inner nodes
    assert encode_bt(octree).endswith(content[data:])
    centres, _ = octree.centres_m()
    np.testing.assert_array_equal(octree.log_odds_at(centres[::97]), octree.log_odds[::97])


def run_tool(*command):
    if shutil.which(command[0]) is None:
        missing(f"no {command[0]}; install Debian's octomap-tools")
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=60, check=False)
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    return output


def test_octomaps_own_tools_draw_the_same_boxes(tmp_path, bt_bytes):
    path = tmp_path / "a.bt"
    path.write_bytes(bt_bytes)
    run_tool("bt2vrml", path)
    boxes = (tmp_path / "a.bt.wrl").read_text().count("Box")
    assert boxes == int((read_octree(path).log_odds >= 0).sum())


def test_octomaps_own_tools_find_no_difference(tmp_path, bt_bytes):
    (tmp_path / "a.bt").write_bytes(bt_bytes)
    (tmp_path / "ours.ot").write_bytes(encode_ot(sample_map().max_likelihood_leaves()))
    (tmp_path / "other.ot").write_bytes(encode_ot(sample_map().leaves()))  # the same voxels, less sure
    run_tool("convert_octree", tmp_path / "a.bt", tmp_path / "converted.ot")
    same = run_tool("compare_octrees", tmp_path / "ours.ot", tmp_path / "converted.ot")
    different = run_tool("compare_octrees", tmp_path / "ours.ot", tmp_path / "other.ot")
    divergence = re.compile(r"KLD[^\d-]*([-+.\deE]+)")
    assert float(divergence.search(same)[1]) == 0.0
    assert float(divergence.search(different)[1]) > 0.0


def test_an_empty_map_is_a_valid_file(tmp_path):
    path = tmp_path / "empty.bt"
    path.write_bytes(encode_bt(Octree(0.05).max_likelihood_leaves()))
    assert b"size 0\n" in path.read_bytes()
    octree = read_octree(path)
    assert len(octree) == 0
    assert np.isnan(octree.log_odds_at(np.zeros((1, 3)))).all()


@pytest.mark.parametrize("kind", ["bt", "ot"])
def test_every_truncation_is_an_error(tmp_path, kind):
    octree = sample_map().max_likelihood_leaves()
    content = encode_bt(octree) if kind == "bt" else encode_ot(octree)
    path = tmp_path / f"cut.{kind}"
    data = content.index(b"data\n") + 5
    for length in [*range(0, data + 12), *range(data + 12, len(content), 101), len(content) - 1, len(content) - 2]:
        path.write_bytes(content[:length])
        with pytest.raises(DataError):
            read_octree(path)


@pytest.fixture
def color_tree():
    """A ColorOcTree of OctoMap's own with coloured, white and pruned voxels, inner nodes up to date."""
    rng = np.random.default_rng(4)
    tree = pyoctomap.ColorOcTree(0.1)
    block = np.stack(np.meshgrid(*[np.arange(0.05, 0.8, 0.1)] * 3), axis=-1).reshape(-1, 3)
    for point in np.vstack([rng.uniform(-2, 2, (400, 3)), block]):
        tree.updateNode(point, bool(point[0] > -1.0))
        if point[1] > -1.0:
            tree.setNodeColor(tree.coordToKey(point), *rng.integers(0, 255, 3).tolist())
    tree.updateInnerOccupancy()
    tree.prune()
    return tree


def test_colour_trees_of_octomap_are_read_and_written_byte_for_byte(tmp_path, color_tree):
    path = tmp_path / "color.ot"
    color_tree.write(str(path))
    octree = read_octree(path)
    assert encode_ot(octree) == path.read_bytes()
    assert (octree.levels > 0).any()
    assert (octree.colors == 255).all(axis=1).any()
    for centre, value, color in zip(octree.centres_m()[0], octree.log_odds, octree.colors, strict=True):
        node = color_tree.search(centre)
        assert (node.getLogOdds(), node.getColor()) == (value, tuple(color.tolist()))


def test_the_binary_file_of_a_tree_for_colours_is_read(tmp_path):
    tree = pyoctomap.ColorOcTree(0.1)
    points = np.array([[1.05, 1.05, 1.05], [1.05, 2.05, 1.05], [-3.05, 0.05, 0.05]])
    for point, is_occupied in zip(points, (True, False, True), strict=True):
        tree.updateNode(point, is_occupied)
    tree.writeBinary(str(tmp_path / "a.bt"))
    octree = read_octree(tmp_path / "a.bt")
    assert len(octree) == 3
    assert (octree.log_odds_at(points) > 0).tolist() == [True, False, True]


def test_octomap_reads_our_colours(tmp_path):
    octree = sample_map().leaves()
    centres = octree.centres_m()[0]
    rng = np.random.default_rng(8)
    places, colors = np.repeat(centres[::2], 3, axis=0), rng.integers(0, 255, (3 * len(centres[::2]), 3), np.uint8)
    coloured = octree.with_colors(np.vstack([places, [[np.nan, 0.0, 0.0]]]), np.vstack([colors, [[1, 2, 3]]]))
    mean = colors.reshape(-1, 3, 3).sum(axis=1) // 3
    np.testing.assert_array_equal(coloured.colors[::2], mean)
    assert (coloured.colors[1::2] == 255).all()
    (tmp_path / "a.ot").write_bytes(encode_ot(coloured))
    theirs = pyoctomap.ColorOcTree(0.1).read(str(tmp_path / "a.ot"))
    for centre, color in zip(centres[:50], coloured.colors[:50], strict=True):
        assert theirs.search(centre).getColor() == tuple(color.tolist())
    theirs.write(str(tmp_path / "b.ot"))
    assert (tmp_path / "b.ot").read_bytes() == encode_ot(coloured)


@pytest.mark.parametrize("insertion", ["discretised", "full"])
def test_a_coloured_map_is_that_of_octomap_byte_for_byte(tmp_path, insertion):
    """Each occupied leaf of OctoMap's own tree of the same points gets the mean colour of the points in it."""
    rng = np.random.default_rng(9)
    ours, theirs = Octree(0.1), pyoctomap.ColorOcTree(0.1)
    points = np.round(rng.uniform(-0.45, 0.45, (4000, 3)), 2).astype(np.float32) + np.float32(0.004)
    colors = rng.integers(0, 256, points.shape).astype(np.uint8)
    for scan in [points[:300], *[points] * 6]:  # often enough for most to be clamped, and pruned
        ours.insert(scan, np.zeros(3), 2.0, insertion)
        theirs.insertPointCloud(
            scan.astype(np.float64), np.zeros(3), max_range=2.0, discretize=insertion == "discretised"
        )
    coloured = ours.leaves()
    assert ((coloured.log_odds >= 0.0) & (coloured.levels > 0)).any()
    is_occupied = coloured.log_odds_at(points) >= 0.0
    coloured = coloured.with_colors(points[is_occupied], colors[is_occupied])
    for centre, edge in zip(*coloured.centres_m(), strict=True):
        inside = is_occupied & (np.abs(points - centre) < 0.5 * edge).all(axis=1)
        if inside.any():
            mean = colors[inside].astype(int).sum(axis=0) // inside.sum()
            theirs.setNodeColor(theirs.coordToKey(centre), *mean.tolist())
    theirs.updateInnerOccupancy()
    theirs.write(str(tmp_path / "theirs.ot"))
    assert encode_ot(coloured) == (tmp_path / "theirs.ot").read_bytes()


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.booleans())
def test_any_octree_survives_writing_and_reading(seed, count, is_coloured):
    rng = np.random.default_rng(seed)
    grid = Octree(0.1)
    grid.insert(rng.uniform(-1, 1, (count, 3)) ** 3 * 1000, np.array([500.0, 0.0, 0.0]), 3.0, "full")
    octree = grid.leaves()
    if is_coloured:
        octree = octree.with_colors(octree.centres_m()[0], rng.integers(0, 256, (len(octree), 3)).astype(np.uint8))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.ot"
        path.write_bytes(encode_ot(octree))
        back = read_octree(path)
    np.testing.assert_array_equal(back.starts, octree.starts)
    np.testing.assert_array_equal(back.levels, octree.levels)
    np.testing.assert_array_equal(back.log_odds, octree.log_odds)
    assert (back.colors is None) == (not is_coloured)
    assert encode_ot(back) == encode_ot(octree)


@settings(max_examples=200)
@given(st.binary(max_size=400), st.sampled_from(["bt", "ot"]), st.sampled_from(["OcTree", "ColorOcTree"]))
def test_whatever_follows_a_header_is_read_or_refused(data, kind, tree):
    title = b"# Octomap OcTree binary file\n" if kind == "bt" else b"# Octomap OcTree file\n"
    sizes = {len(data) // 5, len(data) // 8, 1}
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{kind}"
        for size in sizes:
            path.write_bytes(bt_file(data, size, title, tree))
            try:
                octree = read_octree(path)
            except DataError:
                continue
            assert (np.diff(octree.starts) > 0).all()
            assert np.isfinite(octree.log_odds).all()


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(0, 255), st.booleans())
def test_a_changed_byte_never_does_worse_than_an_error(place, value, is_binary):
    octree = sample_map(scans=1).leaves()
    content = bytearray(encode_bt(octree) if is_binary else encode_ot(octree))
    content[place % len(content)] = value
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(content)
        try:
            back = read_octree(path)
        except DataError:
            return
    assert len(back) <= len(content)


def bt_file(data, size, head=b"# Octomap OcTree binary file\n", tree="OcTree", resolution="0.1"):
    return head + f"id {tree}\nsize {size}\nres {resolution}\ndata\n".encode() + data


def ot_file(data, size, **changes):
    return bt_file(data, size, b"# Octomap OcTree file\n", **changes)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "start with"),
        (b"ply\n" * 100, "start with"),
        (b"# Octomap OcTree binary file\n" + b"# padding\n" * 10**5, "no 'data' line"),
        (bt_file(b"", 0, tree="CountingOcTree"), "CountingOcTree"),
        (ot_file(b"\0" * 4, 1), "ends inside"),
        (ot_file(b"\0" * 5, 1, tree="ColorOcTree"), "ends inside"),
        (ot_file(b"\0" * 7, 1), "bytes follow"),
        (ot_file(b"", 3), "ends inside"),
        (ot_file(b"\0\0\0\0\1" * 40, 40), "16th level"),
        (ot_file(b"\0\0\0\0\1" * 4, 4), "ends inside"),
        (ot_file(b"\0\0\0\0\0" * 2, 2), "bytes follow"),
        (ot_file(b"\0\0\xc0\x7f\0", 1), "finite"),
        (bt_file(b"", 0, resolution="-1"), "impossible header"),
        (bt_file(b"", 0, resolution="nan"), "impossible header"),
        (bt_file(b"", "many"), "'res' or 'size'"),
        (bt_file(b"\x03\x00" * 40, 40), "16th level"),
        (bt_file(b"\x01\x00" * 2, 4), "bytes follow"),
        (bt_file(b"\x01\x00", 10**12), "promises"),
    ],
)
def test_damaged_and_hostile_files_are_errors(tmp_path, content, words):
    path = tmp_path / "bad.bt"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words):
        read_octree(path)


@pytest.mark.parametrize("size", [0, 1, 10**12])
@pytest.mark.parametrize("is_coloured", [False, True])
def test_another_number_of_nodes_in_the_header_of_an_ot_is_stated_and_the_tree_is_read(
    tmp_path, caplog, capsys, size, is_coloured
):
    octree = sample_map().leaves()
    if is_coloured:
        octree = octree.with_colors(octree.centres_m()[0], np.full((len(octree), 3), 7, np.uint8))
    content = encode_ot(octree)
    nodes = int(re.search(rb"size (\d+)", content)[1])
    path = tmp_path / "a.ot"
    path.write_bytes(content.replace(b"size %d" % nodes, b"size %d" % size))
    assert encode_ot(read_octree(path)) == content
    assert f"the header states {size} nodes, the tree has {nodes}" in caplog.text
    caplog.clear()
    assert run_verb(["map", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["leaves"] == len(octree)
    assert str(path) in caplog.text
    path.write_bytes(content)
    caplog.clear()
    read_octree(path)
    assert caplog.text == ""


def test_octomap_reads_an_ot_by_its_nodes_too(tmp_path):
    content = encode_ot(sample_map().leaves())
    (tmp_path / "a.ot").write_bytes(re.sub(rb"size \d+", b"size 2", content))
    pyoctomap.OcTree(0.1).read(str(tmp_path / "a.ot")).write(str(tmp_path / "b.ot"))
    assert (tmp_path / "b.ot").read_bytes() == content


def test_random_bytes_neither_crash_nor_take_memory(tmp_path):
    rng = np.random.default_rng(5)
    path = tmp_path / "noise.bt"
    for count, write in ((2, bt_file), (64, bt_file), (65536, bt_file), (5 * 4096, ot_file), (5 * 65536, ot_file)):
        path.write_bytes(write(rng.integers(0, 256, count, dtype=np.uint8).tobytes(), count // 5))
        tracemalloc.start()
        with pytest.raises(DataError):
            read_octree(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100_000 + 80 * count


def test_huge_leaves_cost_nothing_until_taken_apart(tmp_path):
    path = tmp_path / "huge.bt"
    path.write_bytes(bt_file(b"\xaa\xaa", 9))  # eight occupied leaves: the whole key range
    octree = read_octree(path)
    assert (octree.log_odds_at(np.array([[0.0, 0.0, 0.0], [-3000.0, 3000.0, 1.0]])) > 0).all()
    with pytest.raises(DataError, match="voxels"):
        octree.occupied_voxels()


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_octree(tmp_path / "none.bt")


def test_the_map_verb_tells_what_a_file_holds(tmp_path, bt_bytes, capsys):
    path = tmp_path / "a.bt"
    path.write_bytes(bt_bytes)
    octree = read_octree(path)
    assert run_verb(["map", str(path), "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    assert (info["resolution_m"], info["leaves"]) == (0.1, len(octree))
    voxels = len(octree.occupied_voxels())
    assert abs(info["occupied_m3"] - voxels * 0.1**3) < 1e-3
    centre = octree.centres_m()[0][np.flatnonzero(octree.log_odds >= 0)[0]]
    assert run_verb(["map", str(path), "--json", "--query", *map(str, centre)]) == 0
    place = json.loads(capsys.readouterr().out)
    assert (place["state"], place["probability"], place["nearest_obstacle_m"]) == ("occupied", 0.971, 0.0)
    assert run_verb(["map", str(path), "--query", "90", "0", "0", "--info"]) == 0
    out = capsys.readouterr().out
    assert "state: unknown" in out
    assert "nearest_obstacle_m: None" in out
    assert "leaves: " in out
    path.write_bytes(bt_bytes[:-2])
    assert run_verb(["map", str(path)]) == 3
    assert "damaged" in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--query", "nan", "0", "0"], ["--query", "0", "0", "0", "--level", "17"]])
def test_the_map_verb_refuses_what_makes_no_sense(tmp_path, bt_bytes, capsys, options):
    (tmp_path / "a.bt").write_bytes(bt_bytes)
    assert run_verb(["map", str(tmp_path / "a.bt"), *options]) == 2
    assert capsys.readouterr().err.startswith("vislam: ")
