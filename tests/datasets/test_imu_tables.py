"""Gyroscope and accelerometer in two files, as loggers write them: joined as the two topics of a bag are."""

import os
from pathlib import Path

import numpy as np
import pytest

from vislam.core import DataError, Problems
from vislam.core.messages import ImuSample
from vislam.datasets import open_dataset, survey
from vislam.datasets.inspect import inspect
from worlds import mini_recording as mini

COUNT = 300
GYRO_NS = mini.BEGIN_NS + 5_000_000 * np.arange(COUNT)
ACCEL_NS = mini.BEGIN_NS - 10_000_000 + 16_000_000 * np.arange(COUNT // 3 + 2)


def since_begin(t_ns):
    return (t_ns - mini.BEGIN_NS) * 1e-9


def rate(t_ns):
    t_s = since_begin(t_ns)
    return np.stack([0.1 * np.sin(t_s), 0.2 * np.cos(t_s), 0.3 + 0 * t_s], axis=1)


def force(t_ns):
    t_s = since_begin(t_ns)
    return np.stack([0.5 * t_s, -0.2 * t_s, 9.81 + 0.1 * t_s], axis=1)  # straight: interpolation is exact


def seconds(t_ns, digits=9):
    return f"{t_ns // 10**9}.{t_ns % 10**9:09d}"[: 11 + digits]


def write(path: Path, head: str, row, t_ns, values) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [row(int(t), *v) for t, v in zip(t_ns, values.tolist(), strict=True)]
    path.write_text("\n".join([*([head] if head else []), *lines]) + "\n")


def euroc_row(t, x, y, z):
    return f"{t},{x!r},{y!r},{z!r}"


STYLES = {
    "ns, names after #": ("#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]", euroc_row),
    "ns, no names": ("", euroc_row),
    "seconds, blanks": ("", lambda t, x, y, z: f"{seconds(t)} {x!r} {y!r} {z!r}"),
    "RealSense, ms": ("timestamp,x,y,z", lambda t, x, y, z: f"{t // 10**6}.{t % 10**6:06d},{x!r},{y!r},{z!r}"),
    "us, no names": ("", lambda t, x, y, z: f"{t // 1000},{x!r},{y!r},{z!r}"),
    "phyphox": ('"Time (s)","X (1)","Y (1)","Z (1)","Absolute (1)"', lambda t, x, y, z: f"{seconds(t)},{x},{y},{z},9"),
    "Android, axes reversed": ("time,seconds_elapsed,z,y,x", lambda t, x, y, z: f"{t},0.5,{z!r},{y!r},{x!r}"),
    "OpenCamera, stamp last": ("", lambda t, x, y, z: f"{x!r},{y!r},{z!r},{t}"),
    "semicolons": ("t_ns;gx;gy;gz", lambda t, x, y, z: f"{t};{x!r};{y!r};{z!r}"),
}


def imu(source: str) -> list[ImuSample]:
    return [event for event in open_dataset(source).events() if isinstance(event, ImuSample)]


def check(samples: list[ImuSample], within_ns: int = 0) -> None:
    assert len(samples) >= COUNT - 2
    t_ns = np.array([sample.t_ns for sample in samples])
    assert np.abs(t_ns - GYRO_NS[: len(t_ns)]).max() <= within_ns
    np.testing.assert_allclose([sample.gyro_rad_s for sample in samples], rate(t_ns), atol=1e-9 + within_ns * 1e-9)
    np.testing.assert_allclose([sample.accel_m_s2 for sample in samples], force(t_ns), atol=1e-7 + within_ns * 1e-8)


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("names", [("imu0/gyro.csv", "imu0/accel.csv"), ("gyro0/data.csv", "accel0/data.csv")])
def test_two_tables_of_a_folder_are_joined_and_stated(tmp_path, style, names):
    root = tmp_path / "mav0"
    mini.write_camera(root, "cam0", 20)
    (root / "imu0").mkdir()
    (root / "imu0" / "sensor.yaml").write_text(mini.IMU_YAML)
    head, row = STYLES[style]
    write(root / names[0], head, row, GYRO_NS, rate(GYRO_NS))
    write(root / names[1], head, row, ACCEL_NS, force(ACCEL_NS))
    check(imu(str(tmp_path)), within_ns=1000 if style == "us, no names" else 0)
    said = [f.what for f in inspect(str(tmp_path)).findings if "interpolated at the stamps of the rates" in f.what]
    assert len(said) == 1 and said[0].startswith(f"{names[0]}, {names[1]}" if "0/data" in names[0] else "gyro.csv, ac")


def test_units_are_taken_from_the_names_of_columns(tmp_path):
    (tmp_path / "imu.yaml").write_text(mini.IMU_YAML)
    write(tmp_path / "Gyr.csv", "time,x (deg/s),y (deg/s),z (deg/s)", euroc_row, GYRO_NS, np.degrees(rate(GYRO_NS)))
    write(tmp_path / "acc.csv", "time,x (g),y (g),z (g)", euroc_row, ACCEL_NS, force(ACCEL_NS) / 9.80665)
    check(imu(str(tmp_path)))
    assert any("(stamps in ns, from g)" in finding.what for finding in survey(str(tmp_path)).findings)


def test_a_film_has_its_tables_beside_it(tmp_path):
    (tmp_path / "gyro_test.imu.yaml").write_text(mini.IMU_YAML)
    (tmp_path / "gyro_test.mp4").touch()
    assert survey(str(tmp_path / "gyro_test.mp4")).samples is None
    write(tmp_path / "gyro_test.gyro.csv", "", euroc_row, GYRO_NS, rate(GYRO_NS))
    write(tmp_path / "gyro_test.accel.csv", "", euroc_row, ACCEL_NS, force(ACCEL_NS))
    rows = list(survey(str(tmp_path / "gyro_test.mp4")).imu_rows(Problems()))
    np.testing.assert_allclose([row for _, row in rows], np.hstack([rate(GYRO_NS), force(GYRO_NS)]), atol=1e-7)
    (tmp_path / "gyro_test_timestamps.csv").write_text("7\n8\n")  # as OpenCamera Sensors has it
    assert survey(str(tmp_path / "gyro_test.mp4")).cameras[0].t_ns.tolist() == [7, 8]


@pytest.mark.parametrize(
    ("there", "told"),
    [
        (["gyro.csv"], "holds gyro.csv, but no table of the accelerometer (accel.csv); add it, or remove"),
        (["accel.csv"], "holds accel.csv, but no table of the gyroscope (gyro.csv); add it, or remove"),
        (["gyro.csv", "gyroscope.csv", "accel.csv"], "which are the gyroscope's and the accelerometer's?"),
    ],
)
def test_what_is_alone_or_several_is_named(tmp_path, there, told):
    root = tmp_path / "mav0"
    mini.write_camera(root, "cam0", 20)
    for name in there:
        write(root / "imu0" / name, "", euroc_row, GYRO_NS, rate(GYRO_NS))
    with pytest.raises(DataError) as refused:
        open_dataset(str(tmp_path))
    assert told in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("head", "row", "told"),
    [
        ("a,b,c,d", euroc_row, "which columns are the stamp and x, y, z? It names a, b, c, d"),
        ("time,orientation.x,y,z,x", lambda t, x, y, z: f"{t},0,{y},{z},{x}", "which columns are the stamp"),
        ("", lambda t, x, y, z: f"Gyro {t} {x}", "no rows of a stamp and x, y, z are found"),
    ],
)
def test_columns_that_are_not_known_are_refused(tmp_path, head, row, told):
    (tmp_path / "imu.yaml").write_text(mini.IMU_YAML)
    write(tmp_path / "gyro.csv", head, row, GYRO_NS, rate(GYRO_NS))
    write(tmp_path / "accel.csv", "", euroc_row, ACCEL_NS, force(ACCEL_NS))
    with pytest.raises(DataError) as refused:
        open_dataset(str(tmp_path))
    assert told in str(refused.value) and "\n" not in str(refused.value)


def test_files_that_cannot_be_opened_and_clocks_that_differ_are_named(tmp_path):
    (tmp_path / "imu.yaml").write_text(mini.IMU_YAML)
    write(tmp_path / "gyro.csv", "", euroc_row, GYRO_NS, rate(GYRO_NS))
    write(tmp_path / "accel.csv", "", euroc_row, ACCEL_NS - ACCEL_NS[0], force(ACCEL_NS))
    for change, told in (
        (
            lambda path: path,
            "no gyroscope sample has forces before and after it within 0.1 s: the last is at 140000000",
        ),
        (lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\n"), "a Git LFS pointer"),
        (lambda path: (path.unlink(), path.symlink_to("nowhere")), "accel.csv cannot be read: No such file"),
        (lambda path: (path.unlink(), os.mkfifo(path)), "accel.csv cannot be read"),
        (lambda path: (path.unlink(), path.write_text("1e400,1,2,3\n" * 50)), "no rows of a stamp and x, y, z"),
    ):
        change(tmp_path / "accel.csv")
        with pytest.raises(DataError) as refused:
            imu(f"phone:{tmp_path}")
        assert told in str(refused.value) and "\n" not in str(refused.value)
