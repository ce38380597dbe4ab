"""A program by someone who uses vislam as a library: each entry of the public API in about ten lines."""

import tempfile
from pathlib import Path

import numpy as np

import vislam
from vislam.imu import state_at_rest
from vislam.mapping.octree import ray_cast
from vislam.sim import open_world


def whole_run(folder: Path) -> None:
    run = vislam.run(
        "points:laps,duration_s=6,rig=stereo", out=folder / "run", seed=3,
        graph={"coupling": "loose"}, view={"enabled": False},
    )  # fmt: skip
    print(run)
    assert isinstance(run, vislam.LoadedRun)
    assert len(run.trajectories["graph"]) > 5
    again: vislam.LoadedRun = vislam.load_run(folder / "run")
    assert again.metrics == run.metrics


def value_by_value() -> None:
    recording = vislam.open_source("points:laps,duration_s=6,rig=stereo")
    slam = vislam.Slam(vislam.Config(), recording.rig, recording.imu_noise)
    stamps, poses = [], []
    for value in recording.events():
        for step in slam.feed(value):
            if step.T_map_body is not None:
                stamps.append(step.front.frame.t_ns)
                poses.append(step.T_map_body)
    slam.finish()
    live = vislam.Trajectory(np.array(stamps), np.array(poses))
    truth = recording.truth()
    assert truth is not None
    accuracy = vislam.evaluate(live, truth, "yaw")
    print(slam, live, f"{accuracy['ate_rmse_m']:.3f} m")


def filter_alone() -> None:
    noise = vislam.ImuNoise(
        gyroscope_noise_density=1.7e-4, accelerometer_noise_density=2e-3,
        gyroscope_random_walk=2e-5, accelerometer_random_walk=3e-3, rate_hz=200.0,
    )  # fmt: skip
    samples = [vislam.ImuSample(k * 5_000_000, np.zeros(3), np.array([0.0, 0.0, 9.81])) for k in range(400)]
    ekf = vislam.Ekf.at_rest(samples[:200], noise)
    for sample in samples[200:]:
        ekf.predict(sample)
    print(ekf)
    assert np.linalg.norm(ekf.state().T_world_body[:3, 3]) < 1e-3
    start = vislam.NavState.with_sigmas(0, np.eye(4), (0.01, 0.1))
    assert vislam.Ekf.from_state(start, noise).state().t_ns == 0


def window_alone() -> None:
    recording = vislam.open_source("points:laps,duration_s=6,rig=stereo")
    assert recording.imu_noise is not None
    window: vislam.Window | None = None
    samples: list[vislam.ImuSample] = []
    frame: vislam.Frame | None = None
    for value in recording.events():
        if isinstance(value, vislam.ImuSample):
            samples.append(value)
            if frame is not None and value.t_ns >= frame.t_ns and frame.tracks is not None:
                if window is None:
                    rest = state_at_rest([s for s in samples if s.t_ns <= frame.t_ns], recording.imu_noise)
                    window = vislam.Window(recording.rig, recording.imu_noise, rest)
                window.add(frame.t_ns, frame.tracks, samples)
                frame, samples = None, samples[-2:]
        elif isinstance(value, vislam.Frame) and value.index >= 20 and value.index % 5 == 0:
            frame = value
    print(window)
    assert window is not None
    assert window.state is not None


def loops() -> None:
    world = open_world("handheld-room", camera_hz=10.0, image_width_px=480)
    with vislam.LoopDetector(world.rig.cameras[0]) as detector:
        for index in (0, 15, 30):
            old = world.render(index)
            detector.add(old.images[0], old.depth_m)
        new = world.render(32)
        found = detector.query(new.images[0], new.depth_m)
        print(detector, *found)
        assert found[0].id == 2
        assert found[0].T_old_new is not None


def graph_by_hand() -> None:
    graph = vislam.Graph()
    graph.prior(graph.add_pose(), np.eye(4), (1e-3, 1e-3))
    step = np.eye(4)
    step[0, 3] = 1.0
    for k in range(3):
        graph.add_pose()
        graph.between(k, k + 1, step, (0.01, 0.05))
    print(graph.optimise(), graph)
    assert abs(graph.poses()[3, 0, 3] - 3.0) < 1e-6
    assert graph.covariance(3).shape == (6, 6)


def octree(folder: Path) -> None:
    tree = vislam.Octree(resolution_m=0.05)
    tree.insert(np.array([[2.0, 0.0, 0.0], [2.0, 0.1, 0.0]]), np.zeros(3))
    tree.save(folder / "map.bt")
    again = vislam.Octree.load(folder / "map.bt")
    print(again)
    assert abs(ray_cast(again, [0.0, 0.0, 0.0], [[1.0, 0.0, 0.0]], 5.0).range_m[0] - 2.0) < 0.06


def pose_graph(folder: Path) -> None:
    path = folder / "square.g2o"
    poses = [(0, 0, 0), (1, 0, 1.5708), (1, 1, 3.1416)]
    lines = [f"VERTEX_SE2 {k} {x} {y} {turn}" for k, (x, y, turn) in enumerate(poses)]
    lines += [f"EDGE_SE2 {a} {b} 1.02 0 1.5708 100 0 0 100 0 400" for a, b in ((0, 1), (1, 2))]
    path.write_text("\n".join(lines) + "\n")
    graph = vislam.PoseGraphFile(path)
    print(graph, graph.optimise(robust="none"))
    graph.write(folder / "optimised.g2o")
    assert len(vislam.PoseGraphFile(folder / "optimised.g2o").problem.edges) == 2


def errors() -> None:
    try:
        vislam.open_dataset("tum:/nowhere")
    except vislam.VislamError as error:
        print(error)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        whole_run(Path(name))
        octree(Path(name))
        pose_graph(Path(name))
    value_by_value()
    filter_alone()
    window_alone()
    loops()
    graph_by_hand()
    errors()
    print("done")
