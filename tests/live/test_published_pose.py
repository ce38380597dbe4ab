"""What a controller reads: the struct, its C header, shared memory, datagrams, prediction."""

import errno
import grp
import os
import pwd
import shutil
import stat
import subprocess
import time
import uuid
from collections.abc import Callable
from itertools import count, islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core import DataError, UsageError, VislamError
from vislam.core.geometry import se3_exp, so3_exp, so3_log, transform
from vislam.core.messages import NavState
from vislam.hw.health import Health
from vislam.live.wire.published_pose import HEADER, LAYOUT, SIZE, PublishedPose, of_base, pack, unpack
from vislam.live.wire.publisher import PoseListener, PosePublisher, PoseReader, socket_path
from vislam.live.wire.slot import SlotReader, SlotWriter


def random_pose(seed: int = 3, **changes: object) -> PublishedPose:
    rng = np.random.default_rng(seed)

    def covariance(n: int) -> np.ndarray:
        A = rng.normal(size=(n, n)) * 0.01
        return A @ A.T

    twist = np.zeros((6, 6))
    twist[:3, :3], twist[3:, 3:] = covariance(3), np.diag(rng.uniform(1e-6, 1e-4, 3))
    values = {
        "t_ns": 10**12 + 5, "published_ns": 10**12 + 1005, "sequence": 7, "health": Health.LEVELLED | Health.VISION_OK,
        "T_odom_base": se3_exp(rng.normal(size=6)), "velocity_m_s": rng.normal(size=3),
        "rate_rad_s": rng.normal(size=3),
        "pose_covariance": covariance(6), "twist_covariance": twist, "T_map_odom": se3_exp(rng.normal(size=6)),
        "map_revision": 12, "reset_counter": 2, "vision_age_s": 0.125,
    }  # fmt: skip
    return PublishedPose(**(values | changes))  # type: ignore[arg-type]


def test_pack_and_unpack_are_inverse() -> None:
    pose = random_pose()
    again = unpack(pack(pose))
    assert len(pack(pose)) == SIZE == LAYOUT.itemsize
    for name in ("t_ns", "published_ns", "sequence", "health", "map_revision", "reset_counter", "vision_age_s"):
        assert getattr(again, name) == getattr(pose, name), name
    np.testing.assert_array_equal(again.T_odom_base[:3, 3], pose.T_odom_base[:3, 3])  # double: odom may be far
    for name in ("T_odom_base", "T_map_odom", "velocity_m_s", "rate_rad_s", "pose_covariance", "twist_covariance"):
        np.testing.assert_allclose(getattr(again, name), getattr(pose, name), rtol=1e-6, atol=3e-7, err_msg=name)
    assert unpack(pack(random_pose(vision_age_s=float("inf")))).vision_age_s == float("inf")


@given(st.integers(0, SIZE - 1), st.integers(1, 255))
def test_a_changed_byte_is_never_taken_for_a_pose(place: int, change: int) -> None:
    data = bytearray(pack(random_pose()))
    data[place] ^= change
    with pytest.raises(DataError):
        unpack(bytes(data))


@given(st.binary(max_size=2 * SIZE))
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(DataError):
        unpack(data)


_PROGRAM = r"""
#include "vislam_pose.h"
#include <stdio.h>
#include <stdlib.h>
#define FIELD(name) printf("%zu ", offsetof(vislam_pose, name));
int main(int count, char **path) {
    FIELDS
    printf("\n");
    const vislam_pose_slot *slot = vislam_pose_open_of(path[1], count > 2 ? atoi(path[2]) : 0);
    vislam_pose pose;
    if (slot == NULL) return 3;
    if (!vislam_pose_read(slot, &pose)) return 2;
    printf("%u %.17g %.9g %u %lld\n", pose.sequence, pose.position_m[1], pose.pose_covariance[20], pose.health,
           (long long)pose.stamp_sample_ns);
    return 0;
}
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
def test_the_c_header_reads_what_is_published(tmp_path: Path) -> None:
    name, pose = f"vislam-test-{uuid.uuid4().hex}", random_pose()
    fields = " ".join(f"FIELD({field})" for field in LAYOUT.names or ())
    (tmp_path / "read.c").write_text(_PROGRAM.replace("FIELDS", fields))
    program = tmp_path / "read"
    command = ["cc", "-std=c11", "-Wall", "-Werror", "-I", str(HEADER.parent), "-o", str(program)]
    subprocess.run([*command, str(tmp_path / "read.c")], check=True)
    publisher = PosePublisher(name, ())
    try:
        publisher.publish(pose)
        done = subprocess.run([str(program), f"/dev/shm/{name}"], check=True, capture_output=True, text=True)
        if os.geteuid() == 0:
            os.chown(f"/dev/shm/{name}", 54321, -1)
            assert subprocess.run([str(program), f"/dev/shm/{name}"], check=False).returncode == 3
            assert subprocess.run([str(program), f"/dev/shm/{name}", "54321"], check=False).returncode == 0
        os.chmod(f"/dev/shm/{name}", 0o660)
        assert subprocess.run([str(program), f"/dev/shm/{name}", "54321"], check=False).returncode == 3
        assert subprocess.run([str(program), f"/dev/shm/{name}-none"], check=False).returncode == 3
    finally:
        publisher.close()
    offsets, values = done.stdout.splitlines()
    assert [int(word) for word in offsets.split()] == [LAYOUT.fields[field][1] for field in LAYOUT.names]
    sequence, y, last, health, stamp = values.split()
    assert (int(sequence), int(health), int(stamp)) == (pose.sequence, int(pose.health), pose.t_ns)
    assert float(y) == pose.T_odom_base[1, 3]
    assert float(last) == pytest.approx(pose.pose_covariance[5, 5], rel=1e-6)


def _publish_for_ever(name: str, k: int) -> None:
    publisher = PosePublisher(name, ())
    for sequence in count(1):
        now_ns = time.monotonic_ns()
        at = transform(np.eye(3), np.array([float(k), 0.0, 0.0]))
        publisher.publish(random_pose(sequence=sequence, t_ns=now_ns, published_ns=now_ns, T_odom_base=at))
        time.sleep(0.001)


@pytest.mark.parametrize("compiler", ["gcc", "clang", "g++"])
def test_readers_follow_a_writer_that_is_killed_and_started_again(tmp_path: Path, compiler: str) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not here")
    language = ["-x", "c++", "-std=c++17"] if compiler == "g++" else ["-std=c11", "-pedantic"]
    name, program = f"vislam-test-{uuid.uuid4().hex}", tmp_path / "read_pose"
    source = HEADER.with_name("read_pose.c")
    subprocess.run([compiler, *language, "-Wall", "-Wextra", "-Werror", str(source), "-o", str(program)], check=True)
    shown = subprocess.Popen([str(program), f"/dev/shm/{name}"], stdout=subprocess.PIPE, text=True)
    assert shown.stdout is not None

    def until(what: str) -> None:
        assert any(what in line for line in islice(shown.stdout, 60_000)), what  # ten minutes: only ends a hang

    reader: PoseReader | None = None
    try:
        until("stop: there is no pose")
        for k in range(20):
            writer = get_context("fork").Process(target=_publish_for_ever, args=(name, k))
            writer.start()
            try:
                until(f": {k}.000 0.000 0.000 m")
                reader = reader or PoseReader(name)
                pose = reader.latest()
                while pose is None or pose.T_odom_base[0, 3] != k:  # met in the middle of a write
                    pose = reader.latest()
            finally:
                writer.kill()
                writer.join()
            until("ms old")
            last = reader.latest()
            assert last is None or last.age_s > 0.1
    finally:
        shown.kill()
        shown.communicate()
        if reader is not None:
            reader.close()
        Path(f"/dev/shm/{name}").unlink(missing_ok=True)


def test_the_header_knows_every_health_bit() -> None:
    text = HEADER.read_text()
    for bit in Health:
        assert f"VISLAM_{bit.name} = 1u << {bit.value.bit_length() - 1}" in text


def test_publishing_in_shared_memory_and_by_datagram(tmp_path: Path) -> None:
    name = f"vislam-test-{uuid.uuid4().hex}"
    listener = PoseListener(f"unix:{tmp_path / 'pose.sock'}")
    publisher = PosePublisher(name, (f"unix:{tmp_path / 'pose.sock'}", "udp:127.0.0.1:9"))
    reader = PoseReader(name)
    try:
        assert reader.latest() is None
        for sequence in (1, 2):
            publisher.publish(random_pose(sequence=sequence))
        latest, first, second = reader.latest(), listener.next(1.0), listener.next(1.0)
        assert latest is not None and first is not None and second is not None
        assert (latest.sequence, first.sequence, second.sequence) == (2, 1, 2)
        assert listener.next(0.0) is None
        for _ in range(2000):  # nobody takes them: the publisher must not wait
            publisher.publish(random_pose())
        assert publisher.counters["datagrams_refused"] > 0
    finally:
        publisher.close()
        publisher.close()
        listener.close()
        reader.close()
    assert not Path(f"/dev/shm/{name}").exists()
    with pytest.raises(DataError, match="is `vislam live` running"):
        PoseReader(name)


def test_nothing_goes_beyond_this_machine_unasked() -> None:
    for address in ("udp:192.0.2.1:5000", "udp:0.0.0.0:5000"):
        with pytest.raises(UsageError, match="allow-remote"):
            PosePublisher("vislam-test", (address,))
    for address in ("tcp:127.0.0.1:1", "udp:127.0.0.1", "udp::", "udp:127.0.0.1:99999"):
        with pytest.raises(UsageError, match="no place"):
            PosePublisher("vislam-test", (address,))


def _write_for_ever(name: str, ready: object, stop: object) -> None:
    slot, k = SlotWriter(name, 4096), 0
    while not stop.is_set():  # type: ignore[attr-defined]
        k += 1
        slot.write(bytes([k % 256]) * 4096)
        if k % 50 == 0:
            time.sleep(2e-5)
        if k == 1:
            ready.set()  # type: ignore[attr-defined]
    slot.close()


def test_a_reader_never_sees_half_of_two_values() -> None:
    context, name = get_context("spawn"), f"vislam-test-{uuid.uuid4().hex}"
    ready, stop = context.Event(), context.Event()
    writer = context.Process(target=_write_for_ever, args=(name, ready, stop))
    writer.start()
    try:
        end = time.monotonic() + 600.0  # only ends a hang
        assert ready.wait(600.0)
        slot, last, seen = SlotReader(name), 0, 0
        while seen < 1000 and time.monotonic() < end:
            read = slot.read()
            if read is None:  # the writer was in the way every time
                continue
            sequence, value = read
            assert value == bytes([sequence % 256]) * 4096
            assert sequence >= last
            seen, last = seen + (sequence > last), sequence
        assert seen == 1000
    finally:
        stop.set()
        writer.join(600.0)
    assert not Path(f"/dev/shm/{name}").exists()


def test_memory_and_sockets_belong_to_their_user(tmp_path: Path) -> None:
    name, at = f"vislam-test-{uuid.uuid4().hex}", tmp_path / "a.sock"
    writer, listener = SlotWriter(name, 8), PoseListener(f"unix:{at}")
    try:
        path = Path(f"/dev/shm/{name}")
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(at.stat().st_mode) == 0o600
        writer.write(b"mine")
        assert SlotReader(name).read() == (1, b"mine")
    finally:
        writer.close()
        listener.close()


def test_a_group_that_is_named_may_read_and_an_owner_who_is_named_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, at = f"vislam-test-{uuid.uuid4().hex}", tmp_path / "a.sock"
    path, group = Path(f"/dev/shm/{name}"), grp.getgrgid(os.getegid()).gr_name
    user = pwd.getpwnam("nobody") if os.geteuid() == 0 else pwd.getpwuid(os.geteuid())
    writer, listener = SlotWriter(name, 8, group), PoseListener(f"unix:{at}", group)
    try:
        assert [(stat.S_IMODE(p.stat().st_mode), p.stat().st_gid) for p in (path, at)] == [
            (0o640, os.getegid()),
            (0o660, os.getegid()),
        ]
        writer.write(b"ours")
        os.chown(path, user.pw_uid, -1)
        monkeypatch.setattr(os, "geteuid", lambda: 12345)
        with pytest.raises(DataError, match="is that of user"):
            SlotReader(name)
        assert SlotReader(name, user.pw_name).read() == (1, b"ours")
        path.chmod(0o660)
        with pytest.raises(DataError, match="is open to others, who may write anything into it"):
            SlotReader(name, user.pw_name)
    finally:
        writer.close()
        listener.close()
    for make in (lambda: SlotWriter(name, 8, "no-such-group"), lambda: PoseListener(f"unix:{at}", "no-such-group")):
        with pytest.raises(UsageError, match="group no-such-group: no such group"):
            make()
    with pytest.raises(UsageError, match="no user no-such-user"):
        PoseReader(name, "no-such-user")
    assert not at.exists() and not [left for left in Path("/dev/shm").iterdir() if name in left.name]


def said_as(user: str, groups: list[int], act: Callable[[], str]) -> str:
    """Return what is said in a process of another user, errors too."""
    reader, writer = os.pipe()
    if not (child := os.fork()):
        try:
            os.setgroups(groups)
            os.setuid(pwd.getpwnam(user).pw_uid)
            said = act()
        except BaseException as error:
            said = str(error)
        os.write(writer, said.encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(writer)
    with open(reader) as file:
        return file.read()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root becomes other users")
def test_other_users_read_by_their_group_or_not_and_cannot_be_first() -> None:
    name, group = f"vislam-test-{uuid.uuid4().hex}", grp.getgrnam("users")
    path = Path(f"/dev/shm/{name}")

    def write() -> str:
        SlotWriter(name, 8, group.gr_name).write(b"ours")
        return "written"

    def read() -> str:
        return str(SlotReader(name, "nobody").read())

    try:
        assert said_as("bin", [], lambda: str(path.write_bytes(bytes(40)))) == "40"
        assert "cannot be made: Operation not permitted" in said_as("nobody", [group.gr_gid], write)
        assert "is that of user" in said_as("daemon", [group.gr_gid], read)
        path.unlink()
        assert said_as("nobody", [group.gr_gid], write) == "written"
        assert said_as("daemon", [group.gr_gid], read) == "(1, b'ours')"
        assert "another user's" in said_as("bin", [], read)
        path.rename(other := path.with_name(f"{name}-other"))
        assert said_as("bin", [], lambda: str(path.symlink_to(other))) == "None"
        assert "there is no shared memory" in said_as("daemon", [group.gr_gid], read)
    finally:
        for left in path.parent.glob(f"{name}*"):
            left.unlink()


def test_poses_are_not_sent_to_who_was_first_at_a_name_in_tmp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    name = f"vislam-test-{uuid.uuid4().hex}"
    listener, publisher = PoseListener(f"unix:{socket_path(name)}"), PosePublisher(name)
    try:
        publisher.publish(random_pose())
        assert listener.next(10.0) is not None
        if os.geteuid() == 0:
            os.chown(socket_path(name), 54321, -1)
        monkeypatch.setattr(os, "geteuid", lambda: 12345)
        publisher.publish(random_pose())
        assert listener.next(0.0) is None
    finally:
        publisher.close()
        listener.close()


def test_a_full_shared_memory_is_named_and_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    name = f"vislam-test-{uuid.uuid4().hex}"
    with pytest.raises(VislamError, match=f"/dev/shm/{name} cannot be made: No space left.*/dev/shm is full"):
        SlotWriter(name, 8)
    assert list(Path("/dev/shm").glob(f"*{name}*")) == []


def test_a_new_writer_takes_over_what_a_killed_one_left() -> None:
    name = f"vislam-test-{uuid.uuid4().hex}"
    old = SlotWriter(name, 8)
    new = SlotWriter(name, 8)
    new.write(b"new")
    old.close()  # is no longer the owner
    assert SlotReader(name).read() == (1, b"new")
    new.close()
    assert not Path(f"/dev/shm/{name}").exists()


def test_prediction_goes_along_the_arc_and_its_covariance_covers_what_may_happen() -> None:
    """Monte Carlo: true twist drawn from the covariance, constant acceleration from its sigma."""
    rng = np.random.default_rng(11)
    pose = random_pose(
        T_odom_base=transform(so3_exp(np.array([0.1, -0.2, 1.0])), np.array([3.0, 4.0, 0.2])),
        velocity_m_s=np.array([1.0, 0.05, 0.0]), rate_rad_s=np.array([0.0, 0.05, 0.8]),
    )  # fmt: skip
    dt = 0.2
    predicted = pose.predict(pose.t_ns + round(dt * 1e9), 0.5, 0.5)
    errors = []
    R0, p0 = pose.T_odom_base[:3, :3], pose.T_odom_base[:3, 3]
    for _ in range(400):
        start = rng.multivariate_normal(np.zeros(6), pose.pose_covariance)
        twist = rng.multivariate_normal(np.concatenate([pose.velocity_m_s, pose.rate_rad_s]), pose.twist_covariance)
        accel = rng.normal(size=6) * 0.5
        R, p, steps = so3_exp(start[3:]) @ R0, p0 + start[:3], 40
        for k in range(steps):
            now = twist + accel * (k + 0.5) * dt / steps
            p = p + R @ so3_exp(now[3:] * 0.5 * dt / steps) @ now[:3] * dt / steps
            R = R @ so3_exp(now[3:] * dt / steps)
        e = np.concatenate([p - predicted.T_odom_base[:3, 3], so3_log(R @ predicted.T_odom_base[:3, :3].T)])
        errors.append(e @ np.linalg.solve(predicted.pose_covariance, e))
    assert 5.2 < np.mean(errors) < 6.8  # 6 degrees of freedom, 400 runs: sigma of the mean is 0.17
    with pytest.raises(DataError, match="predicted forward only"):
        pose.predict(pose.t_ns - 1)


def test_the_base_and_its_covariance_follow_from_the_state() -> None:
    """Against numerical differentiation of the same quantities."""
    rng = np.random.default_rng(5)
    A = rng.normal(size=(15, 15))
    covariance = A @ A.T * 1e-6
    gyro, offset = np.array([0.1, -0.2, 0.7]), np.array([-0.3, 0.05, -0.2])
    state = NavState(
        5, se3_exp(rng.normal(size=6)), rng.normal(size=3), rng.normal(size=3) * 0.01, np.zeros(3), covariance
    )

    def observed(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        T = transform(state.T_world_body[:3, :3] @ so3_exp(d[:3]), state.T_world_body[:3, 3] + d[3:6])
        moved = NavState(
            5, T, state.velocity_world_m_s + d[6:9], state.gyro_bias_rad_s + d[9:12], np.zeros(3), covariance
        )
        T_base, speed, rate, _, _ = of_base(moved, gyro, 0.0, offset)
        return T_base, np.concatenate([speed, rate])

    T0, twist0 = observed(np.zeros(15))
    J, K, step = np.zeros((6, 15)), np.zeros((6, 15)), 1e-6
    for i in range(15):
        T, twist = observed(step * np.eye(15)[i])
        J[:3, i] = (T[:3, 3] - T0[:3, 3]) / step
        J[3:, i] = so3_log(T[:3, :3] @ T0[:3, :3].T) / step
        K[:, i] = (twist - twist0) / step
    _, _, _, pose_covariance, twist_covariance = of_base(state, gyro, 0.0, offset)
    np.testing.assert_allclose(pose_covariance, J @ covariance @ J.T, rtol=1e-4, atol=1e-11)
    full = K @ covariance @ K.T
    np.testing.assert_allclose(twist_covariance[:3, :3], full[:3, :3], rtol=1e-4, atol=1e-11)
    np.testing.assert_allclose(twist_covariance[3:, 3:], full[3:, 3:], rtol=1e-4, atol=1e-11)
