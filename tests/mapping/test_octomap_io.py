import re
import shutil
import subprocess
import tracemalloc

import numpy as np
import pytest
from needs import missing

from vislam.errors import DataError
from vislam.mapping.occupancy import OccupancyMap
from vislam.mapping.octomap_io import encode_bt, encode_ot, read_bt


def sample_map(seed=11, scans=3):
    rng = np.random.default_rng(seed)
    grid = OccupancyMap(0.1)
    for _ in range(scans):
        origin = rng.uniform(-0.5, 0.5, 3)
        grid.insert(origin + rng.uniform(-2, 2, (300, 3)), origin)
    return grid


@pytest.fixture
def bt_bytes():
    return encode_bt(sample_map().max_likelihood_octree())


def test_round_trip(tmp_path, bt_bytes):
    octree = sample_map().max_likelihood_octree()
    path = tmp_path / "a.bt"
    path.write_bytes(bt_bytes)
    back = read_bt(path)
    assert back.resolution_m == octree.resolution_m
    np.testing.assert_array_equal(back.starts, octree.starts)
    np.testing.assert_array_equal(back.levels, octree.levels)
    np.testing.assert_array_equal(back.log_odds, octree.log_odds)
    assert encode_bt(back) == bt_bytes


def test_reads_a_map_of_octomap_itself(data_root):
    path = data_root / "octomap" / "geb079.bt"
    octree = read_bt(path)
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
    assert boxes == int((read_bt(path).log_odds >= 0).sum())


def test_octomaps_own_tools_find_no_difference(tmp_path, bt_bytes):
    (tmp_path / "a.bt").write_bytes(bt_bytes)
    (tmp_path / "ours.ot").write_bytes(encode_ot(sample_map().max_likelihood_octree()))
    (tmp_path / "other.ot").write_bytes(encode_ot(sample_map().octree()))  # the same voxels, less sure
    run_tool("convert_octree", tmp_path / "a.bt", tmp_path / "converted.ot")
    same = run_tool("compare_octrees", tmp_path / "ours.ot", tmp_path / "converted.ot")
    different = run_tool("compare_octrees", tmp_path / "ours.ot", tmp_path / "other.ot")
    divergence = re.compile(r"KLD[^\d-]*([-+.\deE]+)")
    assert float(divergence.search(same)[1]) == 0.0
    assert float(divergence.search(different)[1]) > 0.0


def test_an_empty_map_is_a_valid_file(tmp_path):
    path = tmp_path / "empty.bt"
    path.write_bytes(encode_bt(OccupancyMap(0.05).max_likelihood_octree()))
    assert b"size 0\n" in path.read_bytes()
    octree = read_bt(path)
    assert len(octree) == 0
    assert np.isnan(octree.log_odds_at(np.zeros((1, 3)))).all()


def test_every_truncation_is_an_error(tmp_path, bt_bytes):
    path = tmp_path / "cut.bt"
    data = bt_bytes.index(b"data\n") + 5
    for length in [*range(0, data + 12), *range(data + 12, len(bt_bytes), 101), len(bt_bytes) - 1, len(bt_bytes) - 2]:
        path.write_bytes(bt_bytes[:length])
        with pytest.raises(DataError):
            read_bt(path)


def bt_file(data, size, head=b"# Octomap OcTree binary file\n", tree="OcTree", resolution="0.1"):
    return head + f"id {tree}\nsize {size}\nres {resolution}\ndata\n".encode() + data


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "start with"),
        (b"ply\n" * 100, "start with"),
        (b"# Octomap OcTree binary file\n" + b"# padding\n" * 10**5, "no 'data' line"),
        (bt_file(b"", 0, tree="ColorOcTree"), "ColorOcTree"),
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
        read_bt(path)


def test_random_bytes_neither_crash_nor_take_memory(tmp_path):
    rng = np.random.default_rng(5)
    path = tmp_path / "noise.bt"
    for count in (2, 64, 4096, 65536):
        path.write_bytes(bt_file(rng.integers(0, 256, count, dtype=np.uint8).tobytes(), 1))
        tracemalloc.start()
        with pytest.raises(DataError):
            read_bt(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100_000 + 80 * count


def test_huge_leaves_cost_nothing_until_taken_apart(tmp_path):
    path = tmp_path / "huge.bt"
    path.write_bytes(bt_file(b"\xaa\xaa", 9))  # eight occupied leaves: the whole key range
    octree = read_bt(path)
    assert (octree.log_odds_at(np.array([[0.0, 0.0, 0.0], [-3000.0, 3000.0, 1.0]])) > 0).all()
    with pytest.raises(DataError, match="voxels"):
        octree.occupied_voxels()


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_bt(tmp_path / "none.bt")
