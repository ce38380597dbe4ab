"""Topics of a bag as readings of further sensors, as a machine's TOML file names them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vislam.core import Problems
from vislam.core.errors import DataError, UsageError
from vislam.core.readings import Reading
from vislam.datasets.sensor_files import local_frame, sensor_readings
from vislam.sensors.toml import load_sensor_setup, sensor_setup
from worlds.bag_writer import Message, Types, types_of, write_bag

T0 = 1_700_000_000_000_000_000
STEP = 100_000_000


def twist(types: Types, vx: float, vy: float, wz: float) -> Any:
    return types.make(
        "geometry_msgs/msg/Twist", linear=types.vector([vx, vy, 0.0]), angular=types.vector([0.0, 0.0, wz])
    )


def odometry(types: Types, t_ns: int, position: list[float], speeds: tuple[float, float, float]) -> Any:
    pose = types.make("geometry_msgs/msg/PoseWithCovariance", pose=types.pose(position), covariance=np.zeros(36))
    told = types.make("geometry_msgs/msg/TwistWithCovariance", twist=twist(types, *speeds), covariance=np.zeros(36))
    header = types.header(t_ns, "odom")
    return types.make("nav_msgs/msg/Odometry", header=header, child_frame_id="base", pose=pose, twist=told)


def fix(types: Types, t_ns: int, latitude: float, status: int = 0, variance: float = 4.0) -> Any:
    told = types.make("sensor_msgs/msg/NavSatStatus", status=status, service=1)
    return types.make(
        "sensor_msgs/msg/NavSatFix", header=types.header(t_ns, "gps"), status=told, latitude=latitude, longitude=11.0,
        altitude=500.0, position_covariance=np.diag([variance, variance, 4 * variance]).ravel(),
        position_covariance_type=2,
    )  # fmt: skip


def distance(types: Types, t_ns: int, range_m: float, frame: str) -> Any:
    return types.make(
        "sensor_msgs/msg/Range", header=types.header(t_ns, frame), radiation_type=0, field_of_view=0.1, min_range=0.1,
        max_range=50.0, range=range_m,
    )  # fmt: skip


def joints(types: Types, t_ns: int, angles: list[float], rates: list[float]) -> Any:
    return types.make(
        "sensor_msgs/msg/JointState", header=types.header(t_ns, ""), name=["arm", "left", "right"],
        position=np.array(angles), velocity=np.array(rates), effort=np.array([]),
    )  # fmt: skip


def pressure(types: Types, t_ns: int, pascal: float) -> Any:
    header = types.header(t_ns, "baro")
    return types.make("sensor_msgs/msg/FluidPressure", header=header, fluid_pressure=pascal, variance=0.0)


def drive(folder: Path, kind: str) -> Path:
    types = types_of(kind)
    out = []
    for i in range(5):
        t = T0 + i * STEP
        stamped = types.make(
            "geometry_msgs/msg/TwistStamped", header=types.header(t, "base"), twist=twist(types, 1.0, 0.2, 0.5)
        )
        values = {
            "/fix": fix(types, t, 48.0 + i * 1e-5, status=-1 if i == 3 else 0),
            "/odom": odometry(types, t, [i * 0.1, 0.0, 0.0], (1.0, 0.2, 0.5)),
            "/twist": stamped,
            "/uwb": distance(types, t, 5.0 + i if i != 2 else 99.0, "anchor_7"),
            "/nameless": distance(types, t, 5.0, "uwb"),
            "/rates": joints(types, t, [0.0, i * 1.0, i * 2.0], [9.0, 10.0, 20.0]),
            "/angles": joints(types, t, [0.0, i * 1.0, i * 2.0], []),
            "/baro": pressure(types, t, 101_325.0 - 12.0 * i if i != 1 else 1013.25),
            "/mag": types.field(t, [20e-6, 0.0, -40e-6] if i else [np.nan, 0.0, 0.0]),
            "/pose": types.pose_stamped(t, [i, 2.0, 3.0]),
        }
        out += [Message(t + 5_000_000, topic, value) for topic, value in values.items()]
    return write_bag(folder, kind, out)


def read(folder: Path, bag: Path, kind: str, topic: str, more: str = "") -> tuple[list[Reading], Problems]:
    path = folder / "cart.toml"
    path.write_text(f'[sensors.it]\nkind = "{kind}"\nfile = "{bag.name}"\ntopic = "{topic}"\noffset_s = 0.5\n{more}\n')
    setup, problems = load_sensor_setup(path), Problems()
    return list(sensor_readings("it", setup.sensors["it"], setup.files["it"], problems)), problems


WHEELS = 'track_width_m = 0.4\njoints = {left = "left", right = "right", radius_m = 0.1}'
ANCHORS = "anchors = {7 = [0.0, 0.0, 2.0]}"


@pytest.mark.parametrize("storage", ["bag-lz4", "mcap", "db3"])
@pytest.mark.parametrize(
    ("kind", "topic", "more", "count", "last", "problem"),
    [
        ("twist", "/twist", "", 5, [1.0, 0.5], ""),
        ("twist", "/odom", "", 5, [1.0, 0.5], ""),
        ("omni", "/twist", "", 5, [1.0, 0.2, 0.5], ""),
        ("odometry", "/odom", "", 5, [0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], ""),
        ("pose", "/pose", "", 5, [4.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], ""),
        ("position", "/pose", "", 5, [4.0, 2.0, 3.0], ""),
        ("range", "/uwb", ANCHORS, 4, [7.0, 9.0], "beyond what their sensor"),
        ("height", "/uwb", "", 4, [9.0], "beyond what their sensor"),
        ("height", "/baro", "", 4, [3.996], "no air's in Pa"),
        ("wheels", "/rates", WHEELS, 5, [1.0, 2.0], ""),
        ("wheels", "/angles", WHEELS, 4, [1.0, 2.0], ""),
        ("magnetic_field", "/mag", "", 4, [20.0, 0.0, -40.0], "NaN or infinity"),
    ],
)
def test_messages_become_readings(
    storage: str, kind: str, topic: str, more: str, count: int, last: list[float], problem: str, tmp_path: Path
) -> None:
    readings, problems = read(tmp_path, drive(tmp_path, storage), kind, topic, more)
    assert len(readings) == count
    assert np.allclose(readings[-1].values, last, atol=1e-3)
    middle_ns = STEP // 2 if topic == "/angles" else 0
    assert readings[-1].t_ns == T0 + 4 * STEP - middle_ns + 500_000_000  # the header's stamp and the offset
    assert any(problem in key for key in problems) if problem else not problems


def test_fixes_have_a_frame_and_bring_their_noise(tmp_path: Path) -> None:
    bag = drive(tmp_path, "mcap")
    readings, _ = read(tmp_path, bag, "position", "/fix")
    assert len(readings) == 4  # one had no fix
    assert np.allclose(readings[-1].values, [0.0, 4.447, 0.0], atol=0.01)
    assert np.allclose(np.diag(readings[0].covariance), [4.0, 4.0, 16.0])
    setup = load_sensor_setup(tmp_path / "cart.toml")
    assert local_frame(setup.files["it"]).datum.latitude_deg == pytest.approx(48.0)


def test_ranges_whose_anchor_nobody_tells_are_counted(tmp_path: Path) -> None:
    readings, problems = read(tmp_path, drive(tmp_path, "mcap"), "range", "/nameless", ANCHORS)
    assert readings == []
    assert sum(problems.values()) == 5


@pytest.mark.parametrize(
    ("kind", "topic", "more", "words"),
    [
        ("twist", "/tiwst", "", "topic=/tiwst: no such topic; of TwistStamped .* there are /odom, /twist"),
        ("twist", "/pose", "", "it is geometry_msgs/msg/PoseStamped"),
        ("wheels", "/rates", "track_width_m = 0.4", "joints = {left"),
        ("heading", "/pose", "", "no message of a bag gives heading_rad"),
    ],
)
def test_what_does_not_fit_is_named(kind: str, topic: str, more: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=words):
        read(tmp_path, drive(tmp_path, "mcap"), kind, topic, more)


JOINTS = {"left": "a", "right": "b", "radius_m": 1.0}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"kind": "twist", "file": "drive.bag"}, "option topic: one is asked of a bag"),
        ({"kind": "twist", "file": "a.csv", "format": "csv", "topic": "/x"}, "option topic: one is asked of a bag"),
        ({"kind": "wheels", "file": "a.csv", "track_width_m": 0.4, "joints": JOINTS}, "joints those of a bag"),
    ],
)
def test_settings_that_do_not_fit_a_bag_are_refused(table: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=words):
        sensor_setup({"sensors": {"it": table}}, "cart.toml", tmp_path)


def test_inertial_samples_of_a_bag_can_be_calibrated_with(tmp_path: Path) -> None:
    from vislam.calibration.inertial.tables import read_field, read_inertial

    types = types_of("mcap")
    out = [Message(T0 + i, "/imu", types.imu(T0 + i, [i, 0, 0, 0, 0, 9.8])) for i in range(200)]
    out += [Message(T0 + i, "/mag", types.field(T0 + i, [i * 1e-6, 0, 0])) for i in range(150)]
    bag = write_bag(tmp_path, "mcap", out)
    for source in (bag, next(bag.glob("*.mcap"))):
        assert read_inertial(source).values[:, 0].tolist() == list(range(200))
        assert np.allclose(read_field(source).values[:, 0], np.arange(150))
    with pytest.raises(DataError, match="0 usable rows"):
        read_field(write_bag(tmp_path, "mcap", out[:200], name="without"))
