"""vislam over one recording as the peers run: poses only, without dense map, Rerun recording and report.

    python vislam_poses.py SOURCE MODE OUT.tum

Window, loops and graph are on; poses are those published in `map` with each frame, the first pose that in `odom`.
"""

import json
import os
import sys
import time
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does

import cv2
import numpy as np

from vislam.config import from_data
from vislam.core.trajectory import Trajectory
from vislam.runs import imu_noise
from vislam.runs.sources import open_source
from vislam.slam import Slam
from vislam.trajectory import write_tum


def main():
    """Run it."""
    source, mode, out = sys.argv[1:4]
    cv2.setNumThreads(1)
    config = from_data({"frontend": {"mode": mode}, "map": {"enabled": False}}, "benchmark")
    recording = open_source(source, config.seed)
    slam = Slam(config, recording.rig, imu_noise(config.imu, recording.imu_noise))
    frames, first_ns, first, stamps, poses = 0, None, (None, None), [], []
    for value in recording.events():
        for step in slam.feed(value):
            frames, t_ns = frames + 1, step.front.frame.t_ns
            first_ns = t_ns if first_ns is None else first_ns
            if step.front.T_odom_body is not None and first[0] is None:
                first = (t_ns - first_ns) * 1e-9, time.process_time()
            if step.T_map_body is not None:
                stamps.append(t_ns)
                poses.append(step.T_map_body)
    slam.finish()
    write_tum(Trajectory(np.array(stamps), np.array(poses)), Path(out))
    told = {"versions": {"vislam": version("vislam")}, "frames": frames, "poses": len(poses)}
    print(json.dumps(told | {"first_pose_s": first[0], "first_pose_cpu_s": first[1]}))


if __name__ == "__main__":
    main()
