"""A pose graph in Ceres through pyceres: our chi2 as cost functions, compiled, with exact derivatives.

pyceres offers no evaluation of many residuals at once, so Ceres calls Python for each edge; `solve` returns which share
of its time went there, so that the rest can be told.
"""

from __future__ import annotations

import math

import numpy as np
import pyceres
from numba import njit

from vislam.batch.posegraph.arithmetic import errors_2d, errors_3d
from vislam.batch.posegraph.problem import PoseGraphProblem

_BERNOULLI = (0.5, 1.0 / 12.0, 0.0, -1.0 / 720.0, 0.0, 1.0 / 30240.0, 0.0, -1.0 / 1209600.0)  # of Jr^-1 in ad
_EDGE = np.array([[0, 1]])


@njit(cache=True)
def _rotation(q, T):
    x, y, z, w = q / math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    T[0, 0], T[0, 1], T[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    T[1, 0], T[1, 1], T[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    T[2, 0], T[2, 1], T[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@njit(cache=True)
def _cross(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(cache=True)
def _inverse_right_jacobian(ad):
    out, power = np.eye(len(ad)), np.eye(len(ad))
    for coefficient in _BERNOULLI:
        power = power @ ad
        out += coefficient * power
    return out


@njit(cache=True)
def _space(qi, ti, qj, tj, Z, root, residuals, jacobians):
    """Write root @ Log(Z^-1 T_i^-1 T_j) [6], and for `jacobians` of four blocks [24], [18], [24], [18] those."""
    T, r = np.zeros((2, 4, 4)), np.empty((1, 6))
    _rotation(qi, T[0])
    _rotation(qj, T[1])
    T[0, :3, 3], T[1, :3, 3] = ti, tj
    errors_3d(_EDGE, T, Z, r)
    residuals[:] = root @ r[0]
    if len(jacobians) == 0:
        return
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = _cross(r[0, :3])
    ad[3:, :3] = _cross(r[0, 3:])
    Jj = root @ _inverse_right_jacobian(ad)
    R = np.ascontiguousarray(T[1, :3, :3].T) @ np.ascontiguousarray(T[0, :3, :3])  # of T_j^-1 T_i
    t = np.ascontiguousarray(T[1, :3, :3].T) @ (T[0, :3, 3] - T[1, :3, 3])
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = R
    Ad[3:, :3] = _cross(t) @ R
    for k, J, q in ((0, -Jj @ Ad, qi), (1, Jj, qj)):
        G = np.empty((3, 4))  # a turn w of the body moves the quaternion (x, y, z, w) by G^T w / 2
        G[:, :3] = q[3] * np.eye(3) - _cross(q[:3])
        G[:, 3] = -q[:3]
        turn, move = np.ascontiguousarray(J[:, :3]), np.ascontiguousarray(J[:, 3:])
        jacobians[2 * k][:] = (2.0 * turn @ G).ravel()
        jacobians[2 * k + 1][:] = (move @ np.ascontiguousarray(T[k, :3, :3].T)).ravel()


@njit(cache=True)
def _plane(pi, pj, Z, root, residuals, jacobians):
    """Write root @ Log(Z^-1 T_i^-1 T_j) [3] of poses (x, y, angle), and two Jacobians [9] where they are wanted."""
    T, r = np.zeros((2, 3, 3)), np.empty((1, 3))
    for k, p in ((0, pi), (1, pj)):
        c, s = math.cos(p[2]), math.sin(p[2])
        T[k, 0, 0], T[k, 0, 1], T[k, 1, 0], T[k, 1, 1], T[k, 0, 2], T[k, 1, 2] = c, -s, s, c, p[0], p[1]
    errors_2d(_EDGE, T, Z, r)
    residuals[:] = root @ r[0]
    if len(jacobians) == 0:
        return
    w, u, v = r[0]
    Jj = root @ _inverse_right_jacobian(np.array([[0.0, 0.0, 0.0], [v, 0.0, -w], [-u, w, 0.0]]))
    R = np.ascontiguousarray(T[1, :2, :2].T) @ np.ascontiguousarray(T[0, :2, :2])
    t = np.ascontiguousarray(T[1, :2, :2].T) @ (T[0, :2, 2] - T[1, :2, 2])
    Ad = np.zeros((3, 3))
    Ad[0, 0], Ad[1, 0], Ad[2, 0], Ad[1:, 1:] = 1.0, t[1], -t[0], R
    for k, J in ((0, -Jj @ Ad), (1, Jj)):
        out = np.empty((3, 3))
        out[:, :2] = np.ascontiguousarray(J[:, 1:]) @ np.ascontiguousarray(T[k, :2, :2].T)
        out[:, 2] = J[:, 0]
        jacobians[k][:] = out.ravel()


class _Edge(pyceres.CostFunction):
    """The error of one edge, whitened."""

    def __init__(self, sizes: list[int], Z: np.ndarray, root: np.ndarray) -> None:
        super().__init__()
        self.set_num_residuals(len(root))
        self.set_parameter_block_sizes(sizes)
        self._Z, self._root = Z[None], root
        self._none = tuple(np.empty(len(root) * size) for size in sizes)

    def Evaluate(self, parameters, residuals, jacobians):
        wanted = () if jacobians is None else tuple(
            none if J is None else J for J, none in zip(jacobians, self._none, strict=True)
        )  # fmt: skip
        (_plane if len(self._none) == 2 else _space)(*parameters, self._Z, self._root, residuals, wanted)
        return True


def compile_costs() -> None:
    """Load the compiled functions."""
    ones, q, p = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(6)
    _space(ones, q, ones, q, np.eye(4)[None], np.eye(6), p, ())
    _space(ones, q, ones, q, np.eye(4)[None], np.eye(6), p, tuple(np.empty(6 * n) for n in (4, 3, 4, 3)))
    _plane(q, q, np.eye(3)[None], np.eye(3), q.copy(), ())
    _plane(q, q, np.eye(3)[None], np.eye(3), q.copy(), (np.empty(9), np.empty(9)))


def solve(problem: PoseGraphProblem) -> tuple[np.ndarray, float]:
    """Return the poses [N, d + 1, d + 1] and the share of the time that was spent in Python's cost functions."""
    from scipy.spatial.transform import Rotation

    space, poses = problem.dimension == 3, problem.poses
    if space:
        turns, places = Rotation.from_matrix(poses[:, :3, :3]).as_quat(), poses[:, :3, 3].copy()
        blocks = [[turns[i], places[i]] for i in range(len(poses))]
    else:
        flat = np.column_stack([poses[:, :2, 2], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])
        blocks = [[flat[i]] for i in range(len(poses))]
    graph, costs = pyceres.Problem(), []
    roots = np.linalg.cholesky(problem.information).transpose(0, 2, 1).copy()
    for e, (i, j) in enumerate(problem.edges.tolist()):
        costs.append(_Edge([len(b) for b in blocks[i] + blocks[j]], problem.measurements[e], roots[e]))
        graph.add_residual_block(costs[-1], None, blocks[i] + blocks[j])
    for block in blocks[0]:
        graph.set_parameter_block_constant(block)
    if space:
        for turn, _ in blocks[1:]:
            graph.set_manifold(turn, pyceres.EigenQuaternionManifold())
    options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
    options.max_num_iterations = 200  # as in pose_graph_3d.cc; what is not set has Ceres' default
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.num_threads = 1
    pyceres.solve(options, graph, summary)
    evaluation = summary.residual_evaluation_time_in_seconds + summary.jacobian_evaluation_time_in_seconds
    out = np.tile(np.eye(problem.dimension + 1), (len(poses), 1, 1))
    if space:
        out[:, :3, :3], out[:, :3, 3] = Rotation.from_quat(turns).as_matrix(), places
    else:
        c, s = np.cos(flat[:, 2]), np.sin(flat[:, 2])
        out[:, :2, :2], out[:, :2, 2] = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1), flat[:, :2]
    return out, evaluation / summary.total_time_in_seconds
