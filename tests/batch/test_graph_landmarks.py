"""Landmarks, priors and repaired information in g2o files: against plain formulas and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_graph_optimize import gtsam_levenberg_marquardt

from vislam.batch.posegraph.files import read_pose_graph, write_pose_graph
from vislam.batch.posegraph.optimize import optimize_pose_graph
from vislam.batch.posegraph.uncertainty import Uncertainty
from vislam.cli import run_verb
from vislam.config import PoseGraphConfig
from vislam.core.errors import DataError, UsageError

FULL = np.linalg.inv(np.cov(np.random.default_rng(3).normal(size=(6, 40))))


def upper(W):
    return " ".join(f"{v:.17g}" for v in W[np.triu_indices(len(W))])


def read(tmp_path, *lines, **options):
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(lines) + "\n")
    return read_pose_graph(path, **options)


def pose(rng, d):
    T = np.eye(d + 1)
    T[:d, d] = rng.normal(size=d)
    angle = rng.uniform(-3, 3)
    T[:d, :d] = (
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        if d == 2
        else Rotation.random(random_state=int(rng.integers(10**6))).as_matrix()
    )
    return T


def numbers(T):
    if len(T) == 3:
        return f"{T[0, 2]:.17g} {T[1, 2]:.17g} {np.arctan2(T[1, 0], T[0, 0]):.17g}"
    return " ".join(f"{v:.17g}" for v in (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()))


def log_error(D):
    """The logarithm of a pose, rotation first, by scipy's matrix logarithm."""
    from scipy.linalg import logm

    X, d = np.real(logm(D)), len(D) - 1
    turn = [X[1, 0]] if d == 2 else [X[2, 1], X[0, 2], X[1, 0]]
    return np.array([*turn, *X[:d, d]])


def test_the_cost_in_space_is_that_of_the_formulas_of_g2o(tmp_path):
    rng = np.random.default_rng(5)
    X, P, Z = [pose(rng, 3) for _ in range(2)], pose(rng, 3), pose(rng, 3)
    point, seen, gps, known = rng.normal(size=(4, 3))
    order = [3, 4, 5, 0, 1, 2]
    W = FULL[np.ix_(order, order)]  # as the file has it, translation first
    W3 = W[:3, :3]
    problem = read(
        tmp_path,
        f"PARAMS_SE3OFFSET 4 {numbers(P)}",
        *(f"VERTEX_SE3:QUAT {i} {numbers(T)}" for i, T in enumerate(X)),
        f"VERTEX_TRACKXYZ 7 {' '.join(map(repr, point.tolist()))}",
        f"EDGE_SE3_TRACKXYZ 0 7 4 {' '.join(map(repr, seen.tolist()))} {upper(W3)}",
        f"EDGE_SE3_PRIOR 1 4 {numbers(Z)} {upper(W)}",
        f"EDGE_SE3_XYZ_PRIOR 0 4 {' '.join(map(repr, gps.tolist()))} {upper(W3)}",
        f"EDGE_POINTXYZ_PRIOR 7 {' '.join(map(repr, known.tolist()))} {upper(W3)}",
    )
    body = np.linalg.inv(X[0] @ P) @ [*point, 1.0]
    errors = [body[:3] - seen, X[0][:3, 3] - gps, point - known]
    prior = log_error(np.linalg.inv(Z) @ X[1] @ P)
    expected = sum(e @ W3 @ e for e in errors) + prior @ FULL @ prior
    assert problem.chi2(problem.poses) == pytest.approx(expected, rel=1e-9)
    assert problem.is_point.tolist() == [False, False, True, False]
    assert problem.is_pose.tolist() == [True, True, False, False]


def test_the_cost_in_the_plane_is_that_of_the_formulas_of_g2o(tmp_path):
    rng = np.random.default_rng(6)
    T, Z = pose(rng, 2), pose(rng, 2)
    point, seen, gps = rng.normal(size=(3, 2))
    W, W2 = FULL[:3, :3], FULL[1:3, 1:3]
    back = np.ix_([1, 2, 0], [1, 2, 0])
    problem = read(
        tmp_path,
        f"VERTEX_SE2 3 {numbers(T)}",
        f"VERTEX_XY 2 {point[0]!r} {point[1]!r}".replace("np.float64(", "").replace(")", ""),
        f"EDGE_SE2_XY 3 2 {seen[0]:.17g} {seen[1]:.17g} {upper(W2)}",
        f"EDGE_PRIOR_SE2 3 {numbers(Z)} {upper(W[back])}",
        f"EDGE_PRIOR_SE2_XY 3 {gps[0]:.17g} {gps[1]:.17g} {upper(W2)}",
        f"EDGE_PRIOR_XY 2 {gps[0]:.17g} {gps[1]:.17g} {upper(W2)}",
    )
    errors = [T[:2, :2].T @ (point - T[:2, 2]) - seen, T[:2, 2] - gps, point - gps]
    prior = log_error(np.linalg.inv(Z) @ T)
    expected = sum(e @ W2 @ e for e in errors) + prior @ W @ prior
    assert problem.chi2(problem.poses) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("equations", ["cholesky", "gradients"])
def test_a_landmark_is_the_weighted_mean_of_what_fixed_poses_saw(equations, tmp_path):
    problem = read(
        tmp_path, "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 4 0 1.5707963267948966", "VERTEX_XY 9 0 0", "FIX 0 1",
        "EDGE_SE2_XY 0 9 2 1 3 0 3", "EDGE_SE2_XY 1 9 1 1 1 0 1",
    )  # fmt: skip
    solution = optimize_pose_graph(problem, PoseGraphConfig(equations=equations))
    assert solution.poses[2, :2, 2] == pytest.approx([(3 * 2 + 3) / 4, (3 * 1 + 1) / 4], abs=1e-9)
    assert solution.poses[2, :2, :2] == pytest.approx(np.eye(2))
    assert solution.converged
    covariance = Uncertainty(problem, solution.poses).of(np.array([9]))[0]
    assert covariance[1:, 1:] == pytest.approx(np.eye(2) / 4)


def test_priors_on_positions_pull_a_line_as_least_squares_does(tmp_path):
    problem = read(
        tmp_path, *(f"VERTEX_SE3:QUAT {i} {i} 0 0 0 0 0 1" for i in range(3)), "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1",
        *(f"EDGE_SE3:QUAT {i} {i + 1} 1 0 0 0 0 0 1 {upper(np.diag([4.0, 4, 4, 100, 100, 100]))}" for i in range(2)),
        f"EDGE_SE3_PRIOR 0 0 0 0 0 0 0 0 1 {upper(np.diag([1.0, 1, 1, 50, 50, 50]))}",
        "EDGE_SE3_XYZ_PRIOR 2 0 2.6 0 0 1 0 0 1 0 1",
    )  # fmt: skip
    solution = optimize_pose_graph(problem)
    A = np.array([[1.0, 0, 0], [-2, 2, 0], [0, -2, 2], [0, 0, 1]])
    expected = np.linalg.lstsq(A, np.array([0.0, 2, 2, 2.6]), rcond=None)[0]
    assert solution.poses[:3, 0, 3] == pytest.approx(expected, abs=1e-7)
    assert solution.poses[3] == pytest.approx(np.eye(4))


def mixed(rng):
    lines = [f"VERTEX_SE2 {i} {i} 0.1 0" for i in (0, 1, 3)] + ["VERTEX_XY 2 1 1", "FIX 2"]
    lines += [f"EDGE_SE2 {i} {j} 1 0.05 0.1 100 1 2 90 3 400" for i, j in ((0, 1), (1, 3))]
    lines += [f"EDGE_SE2_XY {i} 2 {1 - i + 0.1 * rng.normal():.6f} 1 100 10 50" for i in (0, 1, 3)]
    return [*lines, "EDGE_PRIOR_SE2 0 0.1 0 0.1 10 1 0 20 0 30", "EDGE_PRIOR_SE2_XY 3 3 0.2 4 1 5"]


def test_what_is_written_is_read_again_as_the_same_problem(tmp_path):
    problem = read(tmp_path, *mixed(np.random.default_rng(1)))
    solution = optimize_pose_graph(problem)
    write_pose_graph(problem, tmp_path / "again.g2o", solution.poses)
    again = read_pose_graph(tmp_path / "again.g2o")
    assert again.ids.tolist() == problem.ids.tolist()
    assert again.fixed.tolist() == problem.fixed.tolist()
    assert again.chi2(again.poses) == pytest.approx(solution.costs[-1], rel=1e-9)
    assert "world" not in (tmp_path / "again.g2o").read_text()
    assert "VERTEX_SE2 4 " not in (tmp_path / "again.g2o").read_text()  # which stands for the world


def test_the_verb_tells_landmarks_and_writes_them_apart(tmp_path, capsys):
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(mixed(np.random.default_rng(2))) + "\n")
    assert run_verb(["optimize", str(path), "--out", str(tmp_path / "out"), "--covariances"]) == 0
    told = capsys.readouterr().out
    assert "3 poses" in told
    assert "1 landmarks, seen 3 times, and 2 priors" in told
    assert "not certified" in told
    assert len((tmp_path / "out" / "poses.csv").read_text().splitlines()) == 4
    landmarks = (tmp_path / "out" / "landmarks.csv").read_text().splitlines()
    assert landmarks[0] == "id,x_m,y_m,x_x,x_y,y_y"
    assert landmarks[1].startswith("2,1,1,")
    assert "world,0," in (tmp_path / "out" / "edges.csv").read_text()
    assert "noise of" not in told  # their edges are neither odometry nor loops
    assert run_verb(["optimize", str(path), "--out", str(tmp_path / "rescaled"), "--rescale-noise"]) == 2
    assert "landmarks" in capsys.readouterr().err


def test_every_way_and_gtsam_end_at_the_same_minimum(tmp_path):
    problem = read(tmp_path, *mixed(np.random.default_rng(1)))
    expected = optimize_pose_graph(problem, PoseGraphConfig(start="file"))
    ways = [optimize_pose_graph(problem, PoseGraphConfig(**way)) for way in ({"robust": "gnc"}, {"start": "grown"})]
    for found in (*ways, gtsam_levenberg_marquardt(problem, expected.start)):
        assert found.costs[-1] == pytest.approx(expected.costs[-1], rel=1e-7)
        assert found.poses == pytest.approx(expected.poses, abs=1e-5)


def test_what_a_way_or_a_format_does_not_know_is_refused(tmp_path):
    problem = read(tmp_path, *mixed(np.random.default_rng(1)))
    with pytest.raises(UsageError, match="with landmarks auto, gnc or cauchy"):
        optimize_pose_graph(problem, PoseGraphConfig(robust="dcs"))
    for ending in ("toro", "isam"):
        with pytest.raises(UsageError, match="no lines for"):
            write_pose_graph(problem, tmp_path / f"a.{ending}")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("VERTEX_TRACKXYZ 0 1 2 3", "id of a landmark and that of a pose"),
        ("EDGE_SE3_TRACKXYZ 0 1 0 1 2 3 1 0 0 1 0 1", "id of a landmark and that of a pose"),
        ("EDGE_SE3_TRACKXYZ 0 5 8 1 2 3 1 0 0 1 0 1", "no PARAMS_SE3OFFSET 8"),
        ("EDGE_SE3_XYZ_PRIOR 0 0 1 2 3 1 0 0 1 0", "ends too early"),
        ("EDGE_SE3_XYZ_PRIOR 0 0 1 2 3 0 0 0 0 0 0", "the information is zero"),
        ("EDGE_SE3_PRIOR 0 1 0 0 0 0 0 0 1 " + upper(np.diag([1.0, 1, 1, 0, 0, 0])), "with an offset away from"),
        (f"EDGE_POINTXYZ_PRIOR {2**63 - 1} 1 2 3 1 0 0 1 0 1", "for priors to find a place"),
    ],
)
def test_bad_landmarks_and_priors_are_told_with_their_line(line, message, tmp_path):
    with pytest.raises(DataError, match=r"graph\.g2o") as error:
        read(
            tmp_path, "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1",
            "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", "PARAMS_SE3OFFSET 1 1 0 0 0 0 0 1",
            f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {upper(np.eye(6))}", line,
        )  # fmt: skip
    assert message in str(error.value)


INDEFINITE = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", "VERTEX_SE2 2 2 0 0", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"]
INDEFINITE += ["EDGE_SE2 0 1 1 0 0 1 2 0 1 0 5", "EDGE_SE2 1 2 1 0 0 1 0 0 2 3 1"]


def test_indefinite_information_is_projected_when_asked(tmp_path):
    with pytest.raises(DataError, match=r"graph.g2o:5: .* -1; so are 2 of 3 edges; --repair-information"):
        read(tmp_path, *INDEFINITE)
    problem = read(tmp_path, *INDEFINITE, repair=True)
    assert any("2 of 3 edges was not positive (the first: line 5" in note for note in problem.notes)
    # [[1, 2], [2, 1]] has the eigenvalues 3 along (1, 1) and -1, which goes
    assert problem.information[1] == pytest.approx(np.array([[5, 0, 0], [0, 1.5, 1.5], [0, 1.5, 1.5]]), abs=1e-7)
    assert np.linalg.eigvalsh(problem.information).min() > 0.0
    assert problem.information[0] == pytest.approx(np.eye(3))


def test_what_has_no_positive_part_cannot_be_repaired(tmp_path):
    with pytest.raises(DataError, match="not positive in any direction"):
        read(tmp_path, *INDEFINITE, "EDGE_SE2 0 2 2 0 0 -1 0 0 -1 0 -1", repair=True)


def test_the_verb_repairs_and_says_so(tmp_path, capsys):
    path = tmp_path / "graph.g2o"
    path.write_text("\n".join(INDEFINITE) + "\n")
    assert run_verb(["optimize", str(path), "--out", str(tmp_path / "out"), "--no-report"]) == 3
    assert "--repair-information" in capsys.readouterr().err
    assert run_verb(["optimize", str(path), "--out", str(tmp_path / "out"), "--no-report", "--repair-information"]) == 0
    assert "warning: the information of 2 of 3 edges was not positive" in capsys.readouterr().out
