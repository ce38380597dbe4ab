"""7. A live pose, read by another process: how a controller gets it.

    python examples/07_live_pose.py

`vislam live` publishes a struct of 256 bytes in shared memory, 400 times a second. Reading it takes microseconds, needs
no library (there is a C header, docs/cart.md) and can never slow the estimator down: nobody waits for anybody.
"""

import os
import subprocess
import sys
import time

import numpy as np

from vislam.core import se3_exp
from vislam.hw import Health
from vislam.live import PosePublisher, PoseReader, PublishedPose

NAME = f"vislam-example-{os.getppid() if sys.argv[1:] == ['control'] else os.getpid()}"


def pose_after(sequence: int) -> PublishedPose:
    """Return the pose of a base that drives a circle at 1 m/s: what the filter would say."""
    now_ns = time.monotonic_ns()
    return PublishedPose(
        t_ns=now_ns, published_ns=now_ns, sequence=sequence, health=Health.LEVELLED | Health.VISION_OK,
        T_odom_base=se3_exp(np.array([0, 0, 0.5, 1.0, 0, 0]) * sequence / 400),
        velocity_m_s=np.array([1.0, 0, 0]), rate_rad_s=np.array([0, 0, 0.5]),
        pose_covariance=np.eye(6) * 1e-4, twist_covariance=np.eye(6) * 1e-4,
        T_map_odom=np.eye(4), map_revision=0, reset_counter=0, vision_age_s=0.05,
    )  # fmt: skip


def control() -> None:
    """The other process: read the newest pose, and predict it to when the wheels will answer."""
    reader = PoseReader(NAME)
    pose = reader.latest()
    assert pose is not None
    # a controller decides by the health word first: an invalid pose is worse than none
    assert not pose.health & Health.INVALID
    ahead = pose.predict(pose.t_ns + 50_000_000)
    way_m = np.linalg.norm(ahead.T_odom_base[:3, 3] - pose.T_odom_base[:3, 3])
    print(f"pose {pose.sequence}: at {pose.T_odom_base[:2, 3].round(2)} m, health {pose.health!r}")
    print(f"in 50 ms the base is {100 * way_m:.0f} cm on; that is the pose to steer by")
    reader.close()


def publish() -> None:
    """Stands in for `vislam live`: publish, and let a process of its own read."""
    publisher = PosePublisher(NAME, send_to=())
    try:
        for sequence in range(1, 401):
            publisher.publish(pose_after(sequence))
        answer = subprocess.run([sys.executable, __file__, "control"], check=True, capture_output=True, text=True)
    finally:
        publisher.close()  # the shared memory goes with it
    print(answer.stdout, end="")
    assert "pose 400" in answer.stdout


if __name__ == "__main__":
    control() if sys.argv[1:] == ["control"] else publish()
