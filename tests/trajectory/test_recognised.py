"""Files of trajectories as other tools write them: what they are taken for, and their numbers."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface
from scipy.spatial.transform import Rotation
from test_trajectory import smooth

from vislam.cli import run_verb
from vislam.core import DataError
from vislam.trajectory import (
    Trajectory,
    associate,
    coverage,
    evaluate,
    read_trajectory,
    read_tum,
    recognise,
    write_kitti,
    write_tum,
)

START_NS = 1_700_000_000_000_000_000
PATH = Trajectory(START_NS + np.arange(100) * 50_000_000, smooth(100).T_world_body)
ROWS = [
    (int(t), *T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
    for t, T in zip(PATH.t_ns, PATH.T_world_body, strict=True)
]


def tum(t: int, *v: float, separator: str = " ", unit: str = "s") -> str:
    stamp = {"s": f"{t // 10**9}.{t % 10**9:09d}", "ns": f"{t}.000000", "e": f"{t // 10**6}e-3"}[unit]
    return separator.join([stamp, *map(repr, map(float, v))])


def w_first(t: int, *v: float, rest: str = "", separator: str = ",") -> str:
    return separator.join([str(t), *(repr(float(x)) for x in (*v[:3], v[6], *v[3:6]))]) + rest


def w_first_seconds(t: int, *v: float) -> str:
    return w_first(t, *v).replace(str(t), f"{t // 10**9}.{t % 10**9:09d}", 1)


def angles(t: int, *v: float, unit: float = 1e3) -> str:
    turn = Rotation.from_quat(v[3:]).as_euler("ZYX", degrees=unit > 1.0)
    return ",".join(map(repr, [t, *(unit * x for x in v[:3]), *turn.tolist(), 7.0]))


def text(row: Callable[..., str], head: str = "", end: str = "\n") -> str:
    return head + end.join(row(*r) for r in ROWS) + end


ZEROS = ",0.1,0,0,"
FORMS = {
    "orbslam3": (text(lambda *r: tum(*r, unit="ns")), "ORB-SLAM3"),
    "scientific": (text(lambda *r: tum(*r, unit="e")), "TUM"),
    "mark of order, CRLF": ("\ufeff" + text(tum, "# timestamp tx ty tz qx qy qz qw\r\n", "\r\n"), "TUM"),
    "tabs": (text(lambda *r: tum(*r, separator="\t")), "TUM"),
    "commas": (text(lambda *r: tum(*r, separator=",")), "w last"),
    "semicolons": (text(lambda *r: tum(*r, separator=";")), "w last"),
    "a further column": (text(lambda *r: tum(*r) + " 7"), "1 further columns"),
    "vins": (text(lambda *r: w_first(*r, rest=ZEROS)), "VINS"),
    "vins loop": (text(lambda *r: w_first(*r, rest=",")), "w first"),
    "euroc": (text(lambda *r: w_first(*r, rest=",0" * 9)), "EuRoC"),
    "named": (text(w_first_seconds, "time,x,y,z,qw,qx,qy,qz\n"), "EuRoC, seconds"),
    "okvis": (
        text(
            lambda *r: tum(*r, separator=", ", unit="ns") + ", 1, 2, 3",
            "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_W_x, v_W_y, v_W_z\n",
        ),
        "by their names",
    ),
    "whole seconds and the rest": (
        text(
            lambda *r: f"9.0,{r[0] // 10**9},{r[0] % 10**9}," + tum(*r, separator=",").partition(",")[2],
            "Time,header.stamp.secs,header.stamp.nsecs,position.x,position.y,position.z,pose.qx,pose.qy,pose.qz,pose.qw\n",
        ),
        "by their names, seconds",
    ),
    "rostopic": (
        text(
            lambda *r: f"{r[0]},3,{r[0]},odom," + tum(*r, separator=",").partition(",")[2],
            "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,"
            "field.pose.position.y,field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,"
            "field.pose.orientation.z,field.pose.orientation.w\n",
        ),
        "by their names",
    ),
    "stamp and matrix": (
        "".join(
            f"{t} " + " ".join(map(repr, T[:3].ravel().tolist())) + "\n"
            for t, T in zip(PATH.t_ns, PATH.T_world_body, strict=True)
        ),
        "stamp and matrix",
    ),
    "angles and millimetres": (
        text(angles, "t_ns,x_mm,y_mm,z_mm,yaw_deg,pitch_deg,roll_deg,wz_rad_s\n"),
        "by their names, roll pitch yaw in degrees, positions times 0.001, nanoseconds",
    ),
    "radians": (
        text(lambda *r: angles(*r, unit=1.0), "# time [ns]; x (m); y; z; yaw[rad]; pitch[rad]; roll[rad]; v\n").replace(
            ",", ";"
        ),
        "roll pitch yaw in radians, nanoseconds",
    ),
    "a row of NaN": (text(tum) + f"{START_NS // 10**9 + 60} nan nan nan nan nan nan nan\n", "1 rows of NaN left out"),
}


@pytest.mark.parametrize("name", FORMS)
def test_each_form_gives_the_same_path_and_states_what_it_is(name: str, tmp_path: Path) -> None:
    path = tmp_path / "poses"
    path.write_text(FORMS[name][0], encoding="utf-8", newline="")
    found = recognise(path)
    assert FORMS[name][1] in found.taken_for
    assert found.trajectory.t_ns.tolist() == PATH.t_ns.tolist()
    np.testing.assert_allclose(found.trajectory.T_world_body, PATH.T_world_body, atol=1e-9)


def test_stamps_that_count_from_zero_are_nanoseconds_by_their_steps(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("".join(w_first(t - START_NS, *v) + "\n" for t, *v in ROWS))
    assert read_trajectory(path).t_ns.tolist() == (PATH.t_ns - START_NS).tolist()
    path.write_text("".join(tum(t - START_NS, *v) + "\n" for t, *v in ROWS))
    assert read_trajectory(path).t_ns.tolist() == (PATH.t_ns - START_NS).tolist()


def test_kitti_takes_times_beside_it_or_given_and_two_without_are_paired_by_rows(
    tmp_path: Path, capsys, monkeypatch
) -> None:
    for name in ("a.txt", "b.txt"):
        write_kitti(PATH, tmp_path / name)
    asked = ["eval", str(tmp_path / "a.txt"), "--reference"]
    assert run_verb([*asked, str(tmp_path / "b.txt")]) == 0
    assert "without times, 100 poses, taken for 10 a second" in capsys.readouterr().out
    write_tum(PATH, tmp_path / "true.tum")
    assert run_verb([*asked, str(tmp_path / "true.tum")]) == 3
    assert "--times FILE" in capsys.readouterr().err
    with pytest.raises(DataError, match=r"put times\.txt beside it"):
        read_trajectory(tmp_path / "a.txt")
    times = tmp_path / "stamps.txt"
    times.write_text("".join(f"{t * 1e-9:.3f}\n" for t in PATH.t_ns))
    assert run_verb([*asked, str(tmp_path / "true.tum"), "--times", str(times)]) == 0
    opened, open_ = [], os.open
    monkeypatch.setattr(os, "open", lambda path, *rest, **named: opened.append(path) or open_(path, *rest, **named))
    assert run_verb([*asked, str(tmp_path / "b.txt"), "--times", str(times)]) == 0
    assert opened.count(tmp_path / "a.txt") == opened.count(tmp_path / "b.txt") > 0, "a reference is read once"
    times.rename(tmp_path / "times.txt")
    assert read_trajectory(tmp_path / "a.txt").t_ns[3] == PATH.t_ns[3]


@pytest.mark.parametrize(
    ("row", "names"),
    [
        (lambda *r: w_first_seconds(*r).replace(",", " "), "t tx ty tz qw qx qy qz"),
        (lambda *r: tum(*r, unit="ns", separator=","), "t,tx,ty,tz,qx,qy,qz,qw"),
    ],
)
def test_a_quaternion_with_w_at_the_other_end_is_refused_by_its_rotations(
    row: Callable[..., str], names: str, tmp_path: Path, capsys
) -> None:
    odd, right = str(tmp_path / "odd"), str(tmp_path / "right")
    write_tum(PATH, Path(right))
    Path(odd).write_text(text(row))
    for estimate, truth in ((odd, right), (right, odd)):
        assert run_verb(["eval", estimate, "--reference", truth]) == 3
        assert "its quaternion's w at the other end; name the columns" in capsys.readouterr().err
    Path(odd).write_text(text(row, f"# {names}\n"))
    assert run_verb(["eval", odd, "--reference", right, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["odd"]["rpe_1s_deg"] < 1e-3


def test_what_evo_writes_is_read_and_judged_alike(tmp_path: Path) -> None:
    noise = np.random.default_rng(2).normal(0, 0.03, (100, 3))
    noisy = PATH.T_world_body.copy()
    noisy[:, :3, 3] += noise
    pair = {"truth": PATH, "estimate": Trajectory(PATH.t_ns + 4_000_000, noisy)}
    theirs = {}
    for name, trajectory in pair.items():
        write_tum(trajectory, tmp_path / name)
        theirs[name] = file_interface.read_tum_trajectory_file(str(tmp_path / name))
        file_interface.write_tum_trajectory_file(str(tmp_path / name), theirs[name])
    ours = evaluate(read_trajectory(tmp_path / "estimate"), read_trajectory(tmp_path / "truth"), association="nearest")
    truth, estimate = sync.associate_trajectories(theirs["truth"], theirs["estimate"], max_diff=0.025)
    estimate.align(truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth, estimate))
    assert ours["matched"] == truth.num_poses == 100
    assert ours["ate_rmse_m"] == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"PK\x03\x04rest", "zip archive, as evo saves results"),
        (b"\x1f\x8b\x08", "gzip"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"\xff\xfet\x00", "UTF-16"),
        (b"1 2 3\n", "3 numbers in which no pose is found"),
        (b"1 2 3 4 5 6 7\n", "put the time before each"),
        (b"1 2 3 4 5 6 7 8 9 10 11 12\n", "12 numbers, a 3x4 matrix"),
        (b"1 2 3 4 5 6 7 8 9 10 11 12 13\n", "13 numbers"),
        (b"1 0 0 0 0 0 0 1\n2 0 0 0 0 0\n", "poses:2: 6 columns, where the first row has 8"),
        (b"time,x,y,z\n", "no poses"),
        (b'{"poses": [1, 2]}', "is JSON; save its poses as text"),
        (b"<!DOCTYPE html><html>404</html>\n", "a web page or XML, perhaps in place of the file"),
        (b"1,5 0,0 0,0 0,0 0,0 0,0 0,0 1,0\n", "poses:1: .*commas stand for decimal points"),
        (b"1,5;0,0;0,0;0,0;0,0;0,0;0,0;1,0\n", "poses:1: .*commas stand for decimal points"),
        (b"timestamp,latitude,longitude,altitude\n1,48,11,500\n", "latitude and longitude .* no metres; convert them"),
        (b"# time lat lon alt\n1 48 11 500\n", "latitude and longitude .* no metres; convert them"),
        (b"frame,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n", "no column is a time, the first is 'frame'; put the time"),
        (b"a,b,c\nd,e,f\n", "could not convert"),
        (b"t,x,y,z,roll,pitch,yaw\n1,0,0,0,0,0,0\n", "roll, pitch, yaw: which rotation .* roll_deg, pitch_deg"),
        (b"t,x,y,z,roll_deg,pitch_deg,yaw_rad\n1,0,0,0,0,0,0\n", "roll_deg, pitch_deg, yaw_rad: which rotation"),
        (b"# t x y z rx ry rz\n1 0 0 0 0 0 0\n", "rx, ry, rz: which rotation"),
        (b"t,x,y,z,qx,qy,qz\n1,0,0,0,0,0,0\n", "qx, qy, qz: which rotation"),
        (b"# t x y theta\n1 0 0 0\n", "one column of each x, y, z is wanted; it names x, y"),
        (b"t,pose0.position.x,pose0.position.y,pose0.position.z,pose1.position.x\n1,0,0,0,0\n", "names pose0.*pose1"),
        (b"simTime,x,y,z,roll,pitch,yaw\n1,0,0,0,0,0,0\n", "roll, pitch, yaw: which rotation"),
        (b"t,x_ft,y_ft,z_ft\n1,0,0,0\n", "x_ft, y_ft, z_ft are not all metres"),
        (b"1403636579763555,1,2,3,0.1,0.2,0.3\n", "7 numbers whose last four are no quaternion"),
        (b"1 0 0 0 0 0 0 1\n2 0 nan 0 0 0 0 1\n", "poses:2: NaN"),
        (b"1 nan nan nan nan nan nan nan\n", "only 1 rows of NaN"),
        (b"1 0 0 0 0 0 0 1\n2 0 0 0 0 0\n3 0 0 0 0 0 0 1", "poses:2: 6 columns, where the first row has 8"),
        (b"1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1 9", "poses:2: 9 columns, where the first row has 8"),
        (b"timestamp,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0\n", "poses:2: 7 columns, where the header has 8"),
    ],
)
def test_what_is_no_trajectory_is_named_for_what_it_is(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "poses"
    path.write_bytes(data)
    with pytest.raises(DataError, match=message):
        recognise(path)


def test_rows_out_of_order_are_sorted_and_a_cut_line_is_left_out_which_is_stated(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    rows = [f"{t} {10 * t} 0 0 0 0 .6 .8" for t in (1, 3, 2, 4, 5)]
    path.write_text("\n".join([*rows, "6 60 0 0"]))
    found = recognise(path)
    assert found.taken_for.endswith(
        "; 5 poses over 4.0 s; last line cut short, left out; time goes back 1 times: sorted"
    )
    np.testing.assert_array_equal(found.trajectory.positions_m[:, 0], [10, 20, 30, 40, 50])
    path.write_text("\n".join(rows))  # a last line without end, but with all numbers, is whole
    assert "5 poses" in recognise(path).taken_for and "cut" not in recognise(path).taken_for


def test_quoted_fields_and_comments_in_any_encoding_are_read(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    names = ",".join(f'"{name}"' for name in ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    rows = "".join(f'"{t}","{t}.5","0","0","0","0",".6",".8"\n' for t in range(1, 5))
    path.write_bytes(f"# Gerät\n{names}\n{rows}".encode("latin-1"))
    np.testing.assert_array_equal(recognise(path).trajectory.positions_m[:, 0], [1.5, 2.5, 3.5, 4.5])


@pytest.mark.parametrize("names", ["timestamp(s) q p v bg ba cam_imu_dt num_cam etc",
                                   "timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot cam0_trans ... "
                                   "imu_model dw da tg wtoI atoI etc",
                                   "timestamp(s) qx qy qz qw px py pz vx vy vz etc"])  # fmt: skip
def test_states_of_openvins_are_read_by_their_names(names: str, tmp_path: Path) -> None:
    path = tmp_path / "state_estimate.txt"
    numbers = " ".join(["0.25"] * 12)
    path.write_text(f"# {names}\n" + "".join(f"{t}.5 0 0 .6 .8 {t} 2 3 {numbers}\n" for t in range(1, 9)))
    found = recognise(path)
    assert found.taken_for.startswith("columns by their names, seconds; 8 poses over 7.0 s")
    np.testing.assert_array_equal(found.trajectory.positions_m[1], [2, 2, 3])
    np.testing.assert_allclose(
        found.trajectory.T_world_body[0, :3, :3], Rotation.from_quat([0, 0, 0.6, 0.8]).as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize("turn", ["", " 0 0 0 0", " 0 0 0 1", " 1 0 0 0", " nan nan nan nan"])
def test_positions_only_give_no_rotation_and_no_relative_errors(turn: str, tmp_path: Path, capsys) -> None:
    path = tmp_path / "gps.txt"
    path.write_text("".join(f"{t * 1e-9:.2f} {x!r} {y!r} {z!r}{turn}\n" for t, x, y, z, *_ in ROWS))
    truth = read_trajectory(path)
    assert not truth.has_rotation
    entry = evaluate(PATH, truth)
    assert entry["ate_rmse_m"] < 1e-6
    assert [entry[key] for key in ("rotation_rmse_deg", "rpe_1s_m", "rpe_1s_deg")] == [None] * 3
    assert {values["m"] for values in entry["rpe_segments"].values()} == {None}
    write_tum(truth, tmp_path / "again.tum")  # as a run does
    assert not read_tum(tmp_path / "again.tum").has_rotation
    write_tum(PATH, tmp_path / "estimate.tum")
    assert run_verb(["eval", str(tmp_path / "estimate.tum"), "--reference", str(path)]) == 0
    assert "positions only" in capsys.readouterr().out
    assert run_verb(["eval", str(tmp_path / "estimate.tum"), "--reference", str(path), "--align", "first"]) == 2


def test_a_slow_truth_is_compared_next_to_its_own_poses() -> None:
    noise = np.random.default_rng(4).normal(0, 0.02, (600, 3))
    fine = smooth(600, period_ns=100_000_000)
    noisy = fine.T_world_body.copy()
    noisy[:, :3, 3] += noise
    estimate = Trajectory(fine.t_ns, noisy)
    slow = smooth(60, period_ns=1_000_000_000)
    entry = evaluate(estimate, slow)
    assert (entry["matched"], entry["total"], entry["coverage"]) == (60, 60, 1.0)
    assert entry["at"] == "reference"
    assert entry["ate_rmse_m"] == pytest.approx(0.02 * np.sqrt(3), rel=0.15)
    assert len(associate(estimate, slow, max_gap_s=0.5)) == 60  # of equal stamps
    shifted = Trajectory(slow.t_ns + 30_000_000, slow.T_world_body)
    assert len(associate(estimate, shifted)) == 60
    with pytest.raises(DataError, match=r"every 0\.1 s, the reference every 1 s, and 0\.5 s apart is the limit"):
        evaluate(estimate, shifted, max_gap_s=0.5)
    assert len(associate(estimate, shifted, "nearest")) == 60
    assert len(associate(estimate, shifted, "nearest", 0.01)) == 0


@pytest.mark.parametrize("period_s", [0.005, 1.0, 2.0, 60.0])
def test_a_trajectory_covers_itself(period_s: float) -> None:
    one = smooth(50, period_ns=round(period_s * 1e9))
    assert coverage(one, one) == 1.0
    holed = Trajectory(np.delete(one.t_ns, np.s_[10:40]), np.delete(one.T_world_body, np.s_[10:40], axis=0))
    assert coverage(holed, holed) == 1.0
    assert coverage(holed, one) == (1.0 if period_s < 0.03 else pytest.approx(18 / 49))
    assert evaluate(one, one)["matched"] == 50


def test_the_table_states_what_was_done_in_80_columns(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    names = [tmp_path / name for name in ("a_rather_long_name_of_a_camera_trajectory_that_somebody_chose.txt", "truth")]
    for path in names:
        write_tum(smooth(20_000), path)
    assert run_verb(["eval", str(names[0]), "--reference", str(names[1])]) == 0
    out = capsys.readouterr().out
    assert "estimate: a_rather" in out and "TUM" in out
    table = out[out.index("┏") :]
    assert max(map(len, table.splitlines())) <= 80
    assert "…" not in out and "20000/20000" in out
    for words in ("SE(3), scale kept", "Metres and degrees", "interpolated at the estimate's times", "0.1 s"):
        assert words in " ".join(table.split())


def test_clocks_are_doubted_only_where_the_spans_do_not_overlap(tmp_path: Path, capsys) -> None:
    early = Trajectory(PATH.t_ns - START_NS, PATH.T_world_body)
    with pytest.raises(DataError, match=r"spans 0\.00 to 4\.95 s, the reference 1700000000\.00 .* same clock\?"):
        evaluate(early, PATH)
    write_tum(PATH, tmp_path / "truth.tum")
    write_tum(Trajectory(PATH.t_ns[:30], PATH.T_world_body[:30]), tmp_path / "begin.tum")
    assert run_verb(["eval", str(tmp_path / "begin.tum"), "--reference", str(tmp_path / "truth.tum")]) == 4
    error = capsys.readouterr().err
    assert "begin.tum covers 29% of the reference's time, 80% asked" in error
    assert "spans 1700000000.00 to 1700000001.45 s" in error and "clock" not in error
