"""The virtual cart: exact motion in every process, who steers it, what can be asked of it, and a whole run."""

import os
import signal
import tempfile
import threading
import time
import uuid
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from vislam.config import Config, SensorsConfig, load
from vislam.core.errors import DataError, UsageError, VislamError
from vislam.hw.health import Health
from vislam.imu import BiasMemory
from vislam.live.epoch import Epoch
from vislam.live.run_live import LiveRun
from vislam.live.sources import open_live
from vislam.live.status import status_line
from vislam.live.virtual.cart import VirtualCart, VirtualReadings
from vislam.live.virtual.imu import _truth, open_board, run_board
from vislam.live.virtual.motion import SEGMENT_S, Drive, Follower, Segment
from vislam.live.virtual.pilot import CommandReader, CommandWriter
from vislam.live.wire.published_pose import PublishedPose
from vislam.live.wire.publisher import PoseListener
from vislam.live.wire.slot import SlotWriter
from vislam.runs.folder import prepare
from vislam.runs.session import Session
from vislam.sensors import load_sensor_setup
from vislam.trajectory import Trajectory, associate, read_tum


def test_its_further_sensors_are_drawn_on_its_motion(tmp_path: Path) -> None:
    file = tmp_path / "cart.toml"
    file.write_text(
        '[sensors.wheels]\nkind = "wheels"\nsimulated_hz = 20.0\nslip = 0.0\nturn_slip = 0.0\nsigma_m_s = 1e-9\n'
        '[sensors.baro]\nkind = "height"\nsimulated_hz = 5.0\n'
    )
    setup = load_sensor_setup(file)
    name, epoch = f"vislam-test-{uuid.uuid4().hex}", Epoch()
    drive = Drive(name, 1.0, 2.0, 0.5)
    try:
        for k in range(161):  # the future is known here, and the last six seconds of it kept
            drive.advance(0.05 * k, 0.6, 0.3)
        begin_ns = epoch.begin_ns() - 4 * 10**9
        epoch.begin_ns = lambda: begin_ns  # type: ignore[method-assign]
        readings = VirtualReadings(name, epoch, setup, 0)
        found = readings.read()
        wheels = [reading for reading in found if reading.sensor == "wheels"]
        assert len(wheels) >= 70
        assert len(found) - len(wheels) >= 17
        own = setup.suite.drawn_own("wheels", np.random.default_rng([0, 0]))  # of the seed, as the first sensor
        scales = np.array([one.values for one in wheels[60:]]) * own[:2]
        for told, reading in zip(scales, wheels[60:], strict=True):
            here = drive.at((reading.t_ns - begin_ns) * 1e-9)
            half = 0.5 * own[2] * here.rate_rad_s
            np.testing.assert_allclose(told, [here.speed_m_s - half, here.speed_m_s + half], atol=1e-6)
        assert readings.status() == {"wheels": "well", "baro": "well"}
        begin_ns -= 60 * 10**9  # nobody asked for a minute
        readings.read()
        assert readings.counters()["wheels"]["missed"] > 1000
    finally:
        drive.close()


def test_a_segment_is_the_exact_integral_of_its_accelerations() -> None:
    start = Segment(1.0, 0.3, -0.2, 0.7, 0.6, 0.9, 0.5, -1.5)
    x, y, steps = start.x_m, start.y_m, 20_000
    dt = SEGMENT_S / steps
    for k in range(steps):
        t = (k + 0.5) * dt
        yaw = start.yaw_rad + start.rate_rad_s * t + 0.5 * start.angular_accel_rad_s2 * t * t
        speed = start.speed_m_s + start.accel_m_s2 * t
        x, y = x + speed * np.cos(yaw) * dt, y + speed * np.sin(yaw) * dt
    end = start.at(1.0 + SEGMENT_S)
    np.testing.assert_allclose([end.x_m, end.y_m], [x, y], atol=1e-10)
    assert end.speed_m_s == pytest.approx(0.625)


def test_other_processes_see_the_same_motion_and_chips_its_derivatives() -> None:
    name, epoch = f"vislam-test-{uuid.uuid4().hex}", Epoch()
    drive = Drive(name, 1.0, 2.0, 0.5)
    try:
        follower = Follower.waiting(name)
        for k in range(60):
            drive.advance(0.05 * k, 0.6, 0.8 if k > 20 else 0.0)
        assert follower.at(2.5) == drive.at(2.5)
        truth, begin_ns, h = _truth(follower, epoch.peek_ns, 9.81), epoch.begin_ns(), 1e-4
        for t_s in (0.312, 1.21, 2.03):
            before, here, after = (drive.at(t_s + d) for d in (-h, 0.0, h))
            rate, force, _, _ = truth(begin_ns + round(t_s * 1e9))
            assert rate[2] == pytest.approx((after.yaw_rad - before.yaw_rad) / (2 * h), abs=1e-6)
            acceleration = (
                np.array([after.x_m - 2 * here.x_m + before.x_m, after.y_m - 2 * here.y_m + before.y_m]) / h**2
            )
            forward = np.array([np.cos(here.yaw_rad), np.sin(here.yaw_rad)])
            assert force[0] == pytest.approx(acceleration @ forward, abs=1e-3)
            assert force[1] == pytest.approx(acceleration @ np.array([-forward[1], forward[0]]), abs=1e-3)
            assert force[2] == 9.81
    finally:
        drive.close()


def test_what_was_sensed_while_nobody_steered_stays_true() -> None:
    name = f"vislam-test-{uuid.uuid4().hex}"
    drive = Drive(name, 1.0, 2.0, 0.5)
    try:
        follower = Follower.waiting(name)
        for k in range(21):
            drive.advance(0.05 * k, 0.6, 0.8)
        truth = _truth(follower, lambda: 1, 9.81)
        at_s = (0.9, 1.17, 1.7, 2.9)
        seen = [follower.at(t_s).T_world_body(0.3) for t_s in at_s]
        felt = [np.concatenate(truth(1 + round(t_s * 1e9))[:3]) for t_s in at_s]
        drive.advance(2.92, -0.5, -1.0)
        np.testing.assert_allclose([follower.at(t_s).T_world_body(0.3) for t_s in at_s], seen, atol=1e-6)
        np.testing.assert_allclose([np.concatenate(truth(1 + round(t_s * 1e9))[:3]) for t_s in at_s], felt, atol=1e-9)
        assert drive.at(3.1).rate_rad_s < drive.at(2.9).rate_rad_s, "from now on it is steered again"
    finally:
        drive.close()


def test_who_follows_waits_for_the_first_segment() -> None:
    name = f"vislam-test-{uuid.uuid4().hex}"
    slot, first = SlotWriter(name, 1024), Segment(0.0, 1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.0)
    values = [getattr(first, field.name) for field in fields(first)]
    late = threading.Timer(0.1, lambda: slot.write(np.array(values).tobytes()))
    late.start()
    try:
        assert Follower.waiting(name).at(0.0) == first
    finally:
        late.join()
        slot.close()


def test_commands_that_nobody_renews_are_not_obeyed_nor_those_that_are_no_numbers() -> None:
    name = f"vislam-test-{uuid.uuid4().hex}"
    reader = CommandReader(name)
    assert reader.newest(0.0) == (0.0, 0.0)
    writer = CommandWriter(name)
    try:
        writer.command(0.4, -0.2)
        assert reader.newest(1.0) == (0.4, -0.2)
        assert reader.newest(1.29) == (0.4, -0.2)
        assert reader.newest(1.31) == (0.0, 0.0)
        writer.command(0.4, -0.2)
        assert reader.newest(2.0) == (0.4, -0.2)
        writer.command(float("nan"), 0.1)
        assert reader.newest(2.1) == (0.0, 0.0)
    finally:
        writer.close()


def test_the_virtual_cart_tells_its_wheels_and_its_camera() -> None:
    source, settings = open_live("virtual-cart,imu_out=2:3/4:5,camera_hz=5", Config(), SensorsConfig())
    assert isinstance(source, VirtualCart)
    assert source.options.imu_out == ((2.0, 3.0), (4.0, 5.0))
    assert settings.machine.slip_sigma_m_s == 0.02
    assert settings.frontend.planar.height_m == pytest.approx(0.6)
    with pytest.raises(DataError, match="live"):
        next(iter(source.events()))


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("nothing", "no live source 'nothing'"),
        ("gy85", "no live source"),
        ("virtual-cart,colour=red", "no option 'colour'"),
        ("virtual-cart,camera_hz", "write virtual-cart,option=value"),
        ("virtual-cart,imu_out=5", "no list of outages"),
        ("virtual-cart,imu_fault=frozen", "imu_fault=frozen is one of a serial bridge; write virtual-cart,bridge"),
        ("gy85+webcam", "needs its calibration"),
        ("replay:sim:nowhere", "no simulated world"),
    ],
)
def test_wrong_sources_are_told(asked: str, message: str) -> None:
    with pytest.raises(VislamError, match=message):
        open_live(asked, Config(), SensorsConfig())


def test_sensors_without_a_camera_need_no_calibration_of_one() -> None:
    for asked in ("gy85+none", "serial:/dev/ttyUSB0+none", "virtual-cart,rig=none"):
        source, _ = open_live(asked, Config(), SensorsConfig())
        assert source.rig.is_blind and "camera" not in source.helpers()
        camera = source.cameras()()
        assert camera.read(0.0) is None and camera.health() == Health(0)


def test_only_a_calibration_makes_a_magnetometer_count() -> None:
    calibration = replace(SensorsConfig().gy85.calibration, mag_bias_ut=(3.0, -2.0, 0.0))
    told = replace(SensorsConfig(), gy85=replace(SensorsConfig().gy85, calibration=calibration))
    for asked, sensors, counts in (
        ("gy85+none", SensorsConfig(), False), ("gy85+none", told, True), ("serial+none", told, False),
        ("virtual-cart", SensorsConfig(), True),
    ):  # fmt: skip
        assert open_live(asked, Config(), sensors)[0].is_mag_calibrated is counts


def test_without_a_camera_attitude_is_published_and_the_bias_kept_until_ctrl_c(tmp_path: Path) -> None:
    out, name = tmp_path / "run", f"vislam-test-blind-{os.getpid()}"
    prepare(out, overwrite=False)
    memory = tmp_path / "biases.json"
    power_up = {"power_up.window_s": 0.5, "power_up.memory": str(memory)}  # no hole in it on a busy machine
    base = load(None, {"live.name": name, "live.send_to": (), **power_up})
    source, config = open_live("virtual-cart,rig=none,laps=0", base, SensorsConfig())
    live = LiveRun(source, config, out, "virtual-cart", ["vislam", "live"])
    told: list[dict] = []
    interrupted = []

    def watch(run: LiveRun) -> None:
        status_line(run)
        status = run.notes.get("fast", {}).get("status")
        if status:
            told.append(status)
            if Health.LEVELLED in Health(status["health"]) and memory.exists() and not interrupted:
                interrupted.append(True)
                os.kill(os.getpid(), signal.SIGINT)

    metrics = live.execute(watch, duration_s=600.0)
    last = Health(told[-1]["health"])
    assert interrupted and Health.LEVELLED in last and Health.CAMERA_MISSING not in last
    assert all(Health.INVALID in Health(status["health"]) for status in told)
    assert np.isinf(told[-1]["sigma_m"])
    assert metrics["frames"] == 0 and metrics["live"]["counters"]["samples"] > 100
    assert any("no camera" in warning for warning in metrics["warnings"])
    zero = metrics["live"]["power_up"]
    assert zero["tilt_deg"] < 1.0
    np.testing.assert_allclose(BiasMemory.read(memory, 64).at(25.0), zero["gyro_bias_rad_s"])
    files = {path.name for path in out.iterdir()}
    assert files >= {"manifest.json", "config.json", "metrics.json", "tracking.csv", "session.db", "run.rrd"}
    stored = Session(out / "session.db")
    try:
        assert stored.info()["finished"]
    finally:
        stored.close()
    assert not list(Path("/dev/shm").glob(f"*{name}*"))


@pytest.mark.parametrize("chip", ["imu", "mag"])
def test_a_second_calibration_of_a_chip_is_refused(chip: str, tmp_path: Path) -> None:
    config = load(None, {"calibration.camera": str(tmp_path / "cam.yaml"), f"calibration.{chip}": "found.yaml"})
    with pytest.raises(UsageError, match="sensors file"):
        open_live("gy85+webcam", config, SensorsConfig())


def test_the_webcam_of_the_settings_keeps_its_name_and_its_clock(tmp_path: Path) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(
        "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n"
        "  intrinsics: [500, 500, 320, 240]\n  resolution: [640, 480]\n  timeshift_cam_imu: 0.02\n"
        "  T_cam_imu: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]\n"
    )
    config = load(None, {"calibration.camera": str(file)})
    source, settings = open_live("gy85+webcam", config, SensorsConfig())
    assert source.cameras().args[0] == "webcam"
    assert settings.init.time_offset_s == pytest.approx(0.02)
    with pytest.raises(UsageError, match="no live source"):
        open_live("gy85+", config, SensorsConfig())


@pytest.mark.slow
def test_a_whole_run_of_the_virtual_cart(tmp_path: Path) -> None:
    """Real drivers, emulated chips, rendered camera, every process; the IMU is unplugged for a second."""
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    name = f"vislam-test-cart-{os.getpid()}"
    base = load(None, {"view.enabled": False, "live.name": name, "live.send_to": ()})
    asked = "virtual-cart,camera_hz=4,image_width_px=320,imu_out=9:10"
    source, config = open_live(asked, base, SensorsConfig())
    missed: list[bool] = []

    def until_plugged_in_again(run: LiveRun) -> None:
        status = run.notes.get("fast", {}).get("status")
        if status:
            missed.append(Health.IMU_MISSING in Health(status["health"]))
            if any(missed) and not any(missed[-8:]):
                run.stop()

    live = LiveRun(source, config, out, asked, ["vislam", "live"])
    metrics = live.execute(until_plugged_in_again, duration_s=600.0)
    assert metrics["mode"] == "planar"
    assert metrics["frames"] > 5
    late = {role: cost["late_kernels"] for role, cost in metrics["cost"]["processes"].items()}
    assert late == dict.fromkeys(("fast", "front", "back", "map"), 0), "rehearse what calls them, too"
    assert metrics["counters"]["imu"]["gaps"] >= 1
    assert metrics["live"]["counters"]["samples"] > 20  # hundreds on an idle machine
    assert (out / "trajectory_truth.tum").is_file()
    assert not list(Path("/dev/shm").glob(f"*vislam-virtual-{os.getpid()}*"))
    assert not list(Path("/dev/shm").glob(f"*{name}*"))


@pytest.mark.slow
def test_a_ride_through_the_serial_bridge_and_its_unplugged_port(tmp_path: Path) -> None:
    """Protocol, bridge, filter, graph and published pose against the true motion."""
    out, at = tmp_path / "run", f"unix:{tmp_path}/pose"
    prepare(out, overwrite=False)
    name = f"vislam-test-bridge-{os.getpid()}"
    base = load(None, {"view.enabled": False, "map.enabled": False, "live.name": name, "live.send_to": (at,)})
    asked = "virtual-cart,bridge,camera_hz=4,image_width_px=160,imu_out=5.5:6.2"
    source, config = open_live(asked, base, SensorsConfig())
    listener, poses, ended, since = PoseListener(at), list[PublishedPose](), threading.Event(), list[int]()

    def hear() -> None:
        while (heard := listener.next(0.5)) is not None or not ended.is_set():
            poses.extend([] if heard is None else [heard])

    def until_it_sees_again(run: LiveRun) -> None:
        path = source.true_path()
        if path and path[-1].t_s > 7.0:
            since.append(len(poses))
            if sum(map(is_valid, poses[since[0] :])) > 200:
                driven_m = [pose.T_odom_base[0, 3] for pose in poses if is_valid(pose)]
                run.stop() if np.ptp(driven_m) > 0.6 else None

    ear = threading.Thread(target=hear)
    ear.start()
    try:
        metrics = LiveRun(source, config, out, asked, ["vislam", "live"]).execute(until_it_sees_again, 600.0)
    finally:
        ended.set()
        ear.join()
        listener.close()
    valid = {pose.t_ns: pose for pose in poses if is_valid(pose)}
    estimate = Trajectory(np.array([*valid]), np.array([pose.T_odom_base for pose in valid.values()]))
    pairs = associate(estimate, read_tum(out / "trajectory_truth.tum"))
    pairs = pairs.aligned(pairs.reference[0] @ np.linalg.inv(pairs.estimate[0]))
    sigma_m = np.sqrt([np.trace(valid[t_ns].pose_covariance[:3, :3]) for t_ns in pairs.t_ns.tolist()])
    assert (pairs.position_errors_m() < 0.05 + 3.0 * sigma_m).all()
    assert np.ptp(pairs.reference[:, 0, 3]) > 0.5, "it drove"
    counts = metrics["live"]["counters"]
    assert len(poses) + counts["datagrams_refused"] == counts["published"]
    assert counts["sensor_port_lost"] == 1 and counts["sensor_opened"] == 2
    assert metrics["counters"]["imu"]["gaps"] >= 1
    assert counts.get("sensor_bad_frames", 0) == 0
    assert not list(Path(tempfile.gettempdir()).glob(f"vislam-virtual-{os.getpid()}-*"))


def test_a_chip_behind_its_bridge_may_freeze(tmp_path: Path) -> None:
    name, epoch, port, stop = f"vislam-test-{uuid.uuid4().hex}", Epoch(), tmp_path / "tty", threading.Event()

    class Running:
        stopped = property(lambda self: stop.is_set())

        def ready(self) -> bool:
            return True

    drive = Drive(name, 0.0, 0.0, 0.0)
    told = (Running(), port, name, epoch, 9.81, 0, ((0.0, 600.0),), ("frozen",))
    board = threading.Thread(target=run_board, args=told)
    board.start()
    try:
        bridge = open_board(port)
        seen, end = Health(0), time.monotonic() + 600.0
        while Health.GYRO_FAULT not in seen:
            assert time.monotonic() < end, bridge.counters()
            bridge.read(0.05)
            seen |= bridge.health()
        stop.set()
        board.join(0.2)
        bridge.read(0.05)
        assert bridge.counters().get("port_lost", 0) == 0, "the board stays for a reader that ends later"
        bridge.close()
    finally:
        stop.set()
        board.join()
        drive.close()
    assert not port.is_symlink()


def is_valid(pose: PublishedPose) -> bool:
    return Health.LEVELLED in pose.health and Health.INVALID not in pose.health
