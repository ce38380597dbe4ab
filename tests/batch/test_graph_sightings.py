"""Files with landmarks of iSAM and gtsam: read, solved as gtsam does, false sightings found, what is unknown named."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from vislam.batch.posegraph.files import read_pose_graph, write_pose_graph
from vislam.batch.posegraph.g2o import read_g2o
from vislam.batch.posegraph.optimize import optimize_pose_graph
from vislam.batch.posegraph.plain import grown_start
from vislam.batch.posegraph.sightings import undetermined_landmarks
from vislam.batch.posegraph.uncertainty import Uncertainty
from vislam.cli import run_verb
from vislam.config import PoseGraphConfig
from vislam.core.errors import DataError

DATA = Path(gtsam.__file__).parent / "Data"
PARK = DATA / "victoria_park.txt"
PARK_CHI2 = 6183.9347  # where gtsam 4.3's Levenberg-Marquardt ends too, from its own iSAM2's estimate

pytestmark = pytest.mark.skipif(not PARK.exists(), reason="this gtsam came without its Data folder")


def begun(tmp_path, lines):
    """The first lines of Victoria Park."""
    path = tmp_path / "begun.txt"
    path.write_text("\n".join(PARK.read_text().splitlines()[:lines]) + "\n")
    return path


def written(tmp_path, *lines, ending="isam"):
    path = tmp_path / f"graph.{ending}"
    path.write_text("\n".join(lines) + "\n")
    return path


def loop_of_sightings(seed, false_share=0.0, poses=240, landmarks=16):
    """Two rounds on a circle among landmarks as an iSAM file, with exact places: lines, truth, false sightings."""
    rng = np.random.default_rng(seed)
    angle = np.arange(poses) * 4.0 * np.pi / poses
    truth = np.column_stack([20.0 * np.cos(angle), 20.0 * np.sin(angle), angle + np.pi / 2])
    around, out = rng.uniform(0.0, 2.0 * np.pi, landmarks), rng.uniform(8.0, 32.0, landmarks)
    places = np.column_stack([out * np.cos(around), out * np.sin(around)])
    lines, false = [], []
    for i in range(poses):
        x, y, heading = truth[i]
        back = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        if i:
            before = truth[i - 1]
            b = np.array([[np.cos(before[2]), np.sin(before[2])], [-np.sin(before[2]), np.cos(before[2])]])
            step = b @ (truth[i, :2] - before[:2]) + rng.normal(0.0, 0.02, 2)
            turn = heading - before[2] + rng.normal(0.0, 0.005)
            lines.append(f"ODOMETRY {i - 1} {i} {step[0]} {step[1]} {turn} 50 0 0 50 0 200")
        for k in np.flatnonzero(np.linalg.norm(places - [x, y], axis=1) < 18.0):
            seen = back @ (places[k] - [x, y]) + rng.normal(0.0, 0.1, 2)
            named = int(rng.integers(landmarks)) if rng.uniform() < false_share else int(k)
            false.append(named != k)
            lines.append(f"LANDMARK {i} {10_000 + named} {seen[0]} {seen[1]} 10 0 10")
    return lines, truth, np.array(false)


def test_victoria_park_is_opened_and_told(tmp_path, capsys):
    out = tmp_path / "out"
    assert run_verb(["posegraph", str(PARK), "--out", str(out), "--covariances"]) == 0
    told = capsys.readouterr().out
    assert "6969 poses, 151 landmarks, 10608 edges" in told
    assert "the noise was read as covariances" in told
    assert "landmarks" in (out / "report.html").read_text()
    solved = read_g2o(out / "optimized.g2o")
    assert solved.chi2(solved.poses) == pytest.approx(PARK_CHI2, rel=1e-6)
    rows = np.genfromtxt(out / "landmarks.csv", delimiter=",", names=True)
    assert len(rows) == 151
    assert (rows["x_x"] * rows["y_y"] > rows["x_y"] ** 2).all()  # each surer than nothing, in every direction


def test_linear_starts_end_in_another_valley_and_grown_ones_do_not():
    problem = read_pose_graph(PARK)
    assert problem.chi2(grown_start(problem)) == pytest.approx(PARK_CHI2, rel=1e-4)
    begun_at_odometry = optimize_pose_graph(problem, PoseGraphConfig(start="odometry", iterations=20))
    assert begun_at_odometry.costs[-1] > 10.0 * PARK_CHI2


@pytest.mark.parametrize("lines", [300, 1500])
def test_the_minimum_is_that_of_gtsams_own_levenberg_marquardt(lines, tmp_path):
    problem = read_pose_graph(begun(tmp_path, lines))
    ours = optimize_pose_graph(problem, PoseGraphConfig(start="odometry"))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors(problem, graph)
    for i, T in enumerate(ours.start):
        values.insert(
            i, T[:2, 2] if problem.is_point[i] else gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0]))
        )
    graph.add(gtsam.NonlinearEqualityPose2(0, values.atPose2(0)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setMaxIterations(200)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    solved = optimizer.optimize()
    assert 2.0 * graph.error(solved) == pytest.approx(ours.costs[-1], rel=1e-6)
    places = np.array([solved.atPoint2(i) for i in np.flatnonzero(problem.is_point).tolist()])
    assert ours.poses[problem.is_point, :2, 2] == pytest.approx(places, abs=1e-3)


def factors(problem, graph):
    """The same measurements as factors of gtsam, written down apart from vislam's own."""
    turn = [1, 2, 0]
    for e, (i, j) in enumerate(problem.edges.tolist()):
        Z, W = problem.measurements[e], problem.information[e]
        if not problem.is_position[e]:
            model = gtsam.noiseModel.Gaussian.Information(W[np.ix_(turn, turn)])
            graph.add(
                gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(Z[0, 2], Z[1, 2], np.arctan2(Z[1, 0], Z[0, 0])), model)
            )
            continue

        def error(_, values, jacobians, z=Z[:2, 2], i=i, j=j):
            pose, point = values.atPose2(i), values.atPoint2(j)
            by_pose, by_point = np.zeros((2, 3), order="F"), np.zeros((2, 2), order="F")
            seen = pose.transformTo(point, by_pose, by_point)
            if jacobians is not None:
                jacobians[0], jacobians[1] = by_pose, by_point
            return seen - z

        graph.add(gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Information(W[1:, 1:]), [i, j], error))


def test_covariances_of_landmarks_are_the_inverse_of_all_equations(tmp_path):
    problem = read_pose_graph(begun(tmp_path, 60))
    solution = optimize_pose_graph(problem)
    points = np.flatnonzero(problem.is_point)

    def residuals(poses):
        L = np.linalg.cholesky(problem.information + 1e-30 * np.eye(3))
        return np.einsum("eba,eb->ea", L, problem.residuals(poses)).ravel()

    columns, step = [], 1e-6
    for i in range(len(problem.ids)):
        for k in range(3):
            if i == 0 or (problem.is_point[i] and k == 0):
                continue
            sides = []
            for sign in (1.0, -1.0):
                poses, move = solution.poses.copy(), np.eye(3)
                if k == 0:
                    c, s = np.cos(sign * step), np.sin(sign * step)
                    move[:2, :2] = [[c, -s], [s, c]]
                else:
                    move[k - 1, 2] = sign * step
                poses[i] = poses[i] @ move
                sides.append(residuals(poses))
            columns.append((i, k, (sides[0] - sides[1]) / (2 * step)))
    J = np.stack([column for _, _, column in columns], axis=1)
    whole = np.linalg.inv(J.T @ J)
    found = Uncertainty(problem, solution.poses).of(problem.ids[points])
    for n, i in enumerate(points.tolist()):
        at = [c for c, (j, k, _) in enumerate(columns) if j == i and k > 0]
        assert found[n][1:, 1:] == pytest.approx(whole[np.ix_(at, at)], rel=1e-4)


def test_noise_is_read_as_stated(tmp_path):
    root = written(tmp_path, "ODOMETRY 0 1 1 0 0 10 0 0 20 0 30", "LANDMARK 0 7 2 1 2 1 4")
    problem = read_pose_graph(root)
    assert problem.information[0] == pytest.approx(np.diag([900.0, 100.0, 400.0]))
    assert problem.information[1][1:, 1:] == pytest.approx(np.array([[4.0, 2.0], [2.0, 17.0]]))
    assert not any("covariances" in note for note in problem.notes)
    path = written(tmp_path, "ODOMETRY 0 1 1 0 0 0.01 0 0 0.04 0 0.0001", "LANDMARK 0 7 2 1 0.5 0.1 0.4")
    problem = read_pose_graph(path)
    assert any("read as covariances (headings to 0.01 rad)" in note for note in problem.notes)
    assert problem.information[0] == pytest.approx(np.diag([1e4, 100.0, 25.0]))
    assert problem.information[1][1:, 1:] == pytest.approx(np.linalg.inv([[0.5, 0.1], [0.1, 0.4]]))
    forced = read_pose_graph(path, isam_noise="root")
    assert forced.information[0] == pytest.approx(np.diag([1e-8, 1e-4, 16e-4]))


def test_bearing_and_range_lie_where_they_point(tmp_path):
    lines = "VERTEX2 0 0 0 0", "VERTEX2 1 1 0 0", "EDGE2 0 1 1 0 0 1 0 1 1 0 0", "BR 0 9 0.5 10 0.02 0.3"
    problem = read_pose_graph(written(tmp_path, *lines, ending="graph"))
    z, W = problem.measurements[1, :2, 2], problem.information[1][1:, 1:]
    assert z == pytest.approx([10 * np.cos(0.5), 10 * np.sin(0.5)])
    step = 1e-3  # the cost of bearing and range itself, around what was measured
    for angle in np.linspace(0.0, 3.0, 7):
        near = z + step * np.array([np.cos(angle), np.sin(angle)])
        exact = ((np.arctan2(near[1], near[0]) - 0.5) / 0.02) ** 2 + ((np.hypot(*near) - 10) / 0.3) ** 2
        assert (near - z) @ W @ (near - z) == pytest.approx(exact, rel=1e-3)
    solution = optimize_pose_graph(read_pose_graph(DATA / "example.graph"))
    assert solution.converged


def test_what_is_written_for_isam_is_read_again(tmp_path):
    problem = read_pose_graph(begun(tmp_path, 200))
    write_pose_graph(problem, tmp_path / "again.isam")
    again = read_pose_graph(tmp_path / "again.isam")
    poses = optimize_pose_graph(problem).poses
    assert again.ids.tolist() == problem.ids.tolist()
    assert again.chi2(poses) == pytest.approx(problem.chi2(poses), rel=1e-9)


@pytest.mark.parametrize(("seed", "share"), [(0, 0.1), (1, 0.3), (2, 0.3)])
def test_sightings_put_down_to_another_landmark_are_found(seed, share, tmp_path):
    lines, truth, false = loop_of_sightings(seed, share)
    problem = read_pose_graph(written(tmp_path, *lines))
    solution = optimize_pose_graph(problem, PoseGraphConfig(robust="auto"))
    sightings = problem.is_position
    rejected = solution.weights[sightings] == 0.0
    assert (rejected & ~false).sum() <= 0.02 * (~false).sum()
    assert (~rejected & false).sum() <= 0.02 * false.sum()
    true = np.concatenate([np.flatnonzero(~sightings), np.flatnonzero(sightings)[~false]])
    clean = optimize_pose_graph(problem.with_edges(true))
    assert rms(solution.poses, truth, problem) < 1.5 * rms(clean.poses, truth, problem) + 0.01
    without = optimize_pose_graph(problem)
    assert rms(without.poses, truth, problem) > 3.0 * rms(solution.poses, truth, problem)


def rms(poses, truth, problem):
    """Error of positions, the truth moved so that both begin alike."""
    x, y, heading = truth[0]
    back = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    apart = poses[problem.is_pose, :2, 2] - (truth[:, :2] - [x, y]) @ back.T
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def test_a_clean_graph_keeps_its_sightings(tmp_path):
    lines, _, _ = loop_of_sightings(3)
    solution = optimize_pose_graph(read_pose_graph(written(tmp_path, *lines)), PoseGraphConfig(robust="gnc"))
    assert len(solution.rejected) == 0


def test_a_landmark_that_loses_all_its_sightings_is_named(tmp_path):
    lines, _, _ = loop_of_sightings(4)
    far = [f"LANDMARK {i} 99999 {x} 0 10 0 10" for i, x in ((5, 10), (40, 400), (60, -300))]
    solution = optimize_pose_graph(read_pose_graph(written(tmp_path, *lines, *far)), PoseGraphConfig(robust="gnc"))
    kept = len(far) - len(solution.rejected)
    assert kept <= 1
    if kept == 0:
        assert any("lost all their sightings (the first: 99999)" in note for note in solution.notes)


def test_landmarks_that_isam_counts_apart_from_poses(tmp_path):
    lines, _, _ = loop_of_sightings(3)
    fields = [line.split() for line in lines]
    first = min(int(f[2]) for f in fields if f[0] == "LANDMARK")
    apart = [" ".join([*f[:2], str(int(f[2]) - first), *f[3:]] if f[0] == "LANDMARK" else f) for f in fields]
    mixed, plain = (read_pose_graph(written(tmp_path, *some)) for some in (apart, lines))
    assert "numbered from 240 on" in mixed.notes[-1]
    assert np.array_equal(mixed.edges, plain.edges)
    assert np.array_equal(mixed.is_point, plain.is_point)


def test_an_older_name_of_sightings(tmp_path):
    lines = ["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "LANDMARK2 0 5 1 1 10 0 10", "LANDMARK2 1 5 0 1 10 0 10"]
    solution = optimize_pose_graph(read_pose_graph(written(tmp_path, *lines, ending="g2o")))
    assert solution.poses[2, :2, 2] == pytest.approx([1.0, 1.0])


def test_what_is_seen_along_one_direction_is_named(tmp_path, capsys):
    lines = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "EDGE_SE2_XY 0 5 3 0 4 0 0"]
    path = written(tmp_path, *lines, ending="g2o")
    problem = read_pose_graph(path)
    solution = optimize_pose_graph(problem)
    assert undetermined_landmarks(problem, solution.poses, solution.weights).tolist() == [5]
    with pytest.raises(DataError, match="the first: 5"):
        Uncertainty(problem, solution.poses)
    assert run_verb(["posegraph", str(path), "--out", str(tmp_path / "out")]) == 0
    assert "warning: 1 landmarks are seen along one direction only" in capsys.readouterr().out
    # from a second place, along another direction, it is a crossing of two lines
    path = written(tmp_path, *lines, "EDGE_SE2_XY 1 5 2 0 0 0 4", ending="g2o")
    assert not len(undetermined_landmarks(read_pose_graph(path), solution.poses, np.ones(3)))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("LANDMARK 0 7 nan 0 1 0 1", r"isam:4: 'nan'"),
        ("LANDMARK 0 7 1 0 0 0 0", r"isam:4: the information is zero"),
        ("LANDMARK 0 7 1 0 1e200 0 1", r"isam:4: the square of"),
        ("LANDMARK 0 7 1 0 1 0", r"isam:4: the line ends too early"),
        ("BR 0 7 0.1 0 0.1 0.1", r"isam:4: the range is 0, not positive"),
        ("BR 0 7 0.1 -2 0.1 0.1", r"isam:4: the range is -2"),
        ("BR 0 7 0.1 2 0 0.1", r"isam:4: the bearing's sigma is 0"),
        ("BR 0 7 0.1 2 1e-200 0.1", r"isam:4: the information is not finite"),
        ("EDGE3 0 7 1 0 0 0 0 0 " + "1 " * 21, r"isam:4: poses in the plane and in space"),
    ],
)
def test_bad_sightings_are_told_with_their_line(line, message, tmp_path):
    path = written(tmp_path, "ODOMETRY 0 1 1 0 0 10 0 0 20 0 30", "# here", "LANDMARK 0 9 1 0 1 0 1", line)
    with pytest.raises(DataError, match=message):
        read_pose_graph(path)


@pytest.mark.parametrize("line", ["LANDMARK 0 7 1 0 0.4 1 0.4", "LANDMARK 0 7 1 0 0.4 0 0", "LANDMARK 0 7 1 0 -1 0 1"])
def test_covariances_that_are_none_are_told_with_their_line(line, tmp_path):
    path = written(tmp_path, "ODOMETRY 0 1 1 0 0 1e-4 0 0 4e-6 0 4e-6", line)
    with pytest.raises(DataError, match=r"isam:2: the covariance is not positive definite"):
        read_pose_graph(path)


def test_ids_may_be_as_large_as_they_like(tmp_path):
    large = 2**60
    lines = f"ODOMETRY 0 {large} 1 0 0 10 0 0 20 0 30", f"LANDMARK {large} {large + 1} 1 2 1 0 1"
    problem = read_pose_graph(written(tmp_path, *lines))
    solution = optimize_pose_graph(problem, PoseGraphConfig(robust="auto"))
    assert solution.poses[problem.is_point][0, :2, 2] == pytest.approx([2.0, 2.0])
    assert run_verb(["posegraph", str(tmp_path / "graph.isam"), "--out", str(tmp_path / "out")]) == 0


def test_parts_that_nothing_joins_grow_too(tmp_path):
    lines, _, _ = loop_of_sightings(5, poses=60)
    apart = [f"ODOMETRY {500 + i} {501 + i} 1 0 0.1 10 0 0 20 0 30" for i in range(5)]
    apart += ["LANDMARK 500 20000 3 1 1 0 1", "LANDMARK 505 20000 3 1 1 0 1"]
    problem = read_pose_graph(written(tmp_path, *lines, *apart))
    solution = optimize_pose_graph(problem, PoseGraphConfig(start="grown"))
    assert solution.parts == 2
    assert solution.converged
    assert np.isfinite(solution.poses).all()
    other = optimize_pose_graph(problem, PoseGraphConfig(start="tree"))
    assert solution.costs[-1] == pytest.approx(other.costs[-1], rel=1e-6)
