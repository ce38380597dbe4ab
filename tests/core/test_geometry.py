import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vislam.core import geometry as g
from vislam.core.angles import angle_between, angles_of

vectors = arrays(np.float64, 3, elements=st.floats(-1.7, 1.7, width=64))
tangents = arrays(np.float64, 6, elements=st.floats(-1.7, 1.7, width=64))


@given(vectors)
def test_so3_exp_and_log_are_inverse(w):
    R = g.so3_exp(w)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.allclose(g.so3_exp(g.so3_log(R)), R, atol=1e-9)
    if np.linalg.norm(w) < 3.1:
        assert np.allclose(g.so3_log(R), w, atol=1e-7)


@pytest.mark.parametrize("axis", [*np.eye(3).tolist(), [0.6, -0.8, 0.0], [-0.36, 0.48, 0.8]])
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 3.1415, np.pi - 1e-9, np.pi])
def test_so3_log_is_exact_near_zero_and_pi(axis, angle):
    R, across = g.so3_exp(np.array(axis) * angle), g.tangent_basis(np.array(axis))[:, 0]
    assert abs(np.linalg.norm(g.so3_log(R)) - angle) < 1e-7
    assert abs(angles_of(R) - angle) < 1e-9
    assert abs(angle_between(R @ across, across) - angle) < 1e-9
    assert np.allclose(g.so3_exp(g.so3_log(R)), R, atol=1e-9)


@given(tangents)
def test_se3_exp_and_log_are_inverse(xi):
    T = g.se3_exp(xi)
    assert np.allclose(g.se3_exp(g.se3_log(T)), T, atol=1e-8)
    assert np.allclose(T @ g.invert(T), np.eye(4), atol=1e-12)
    assert np.allclose(g.invert_many(T[None])[0], g.invert(T))


@given(vectors, vectors)
def test_jacobians_match_finite_differences(w, direction):
    step = 1e-6
    left = (g.so3_log(g.so3_exp(w + step * direction) @ g.so3_exp(w).T)) / step
    right = (g.so3_log(g.so3_exp(w).T @ g.so3_exp(w + step * direction))) / step
    assert np.allclose(g.so3_left_jacobian(w) @ direction, left, atol=2e-5)
    assert np.allclose(g.so3_right_jacobian(w) @ direction, right, atol=2e-5)
    assert np.allclose(g.so3_left_jacobian(w) @ g.so3_left_jacobian_inverse(w), np.eye(3), atol=1e-9)
    assert np.allclose(g.so3_right_jacobian(w) @ g.so3_right_jacobian_inverse(w), np.eye(3), atol=1e-9)


@given(tangents, tangents)
def test_adjoint_moves_a_perturbation_to_the_other_side(xi, small):
    T = g.se3_exp(xi)
    moved = g.se3_exp(g.se3_adjoint(T) @ small)
    assert np.allclose(T @ g.se3_exp(small) @ g.invert(T), moved, atol=1e-8)


@given(arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_round_trip(q):
    R = g.rotation_from_quaternion_xyzw(q)
    again = g.quaternion_xyzw_from_rotation(R)
    assert np.allclose(g.rotation_from_quaternion_xyzw(again), R, atol=1e-9)
    assert again[3] >= 0.0
    assert np.allclose(np.abs(g.quaternion_wxyz(R)), np.abs(np.roll(again, 1)), atol=1e-7)


def test_zero_quaternion_is_refused():
    with pytest.raises(ValueError, match="zero norm"):
        g.rotation_from_quaternion_xyzw(np.zeros(4))


@given(vectors.filter(lambda v: np.linalg.norm(v) > 1e-2))
def test_level_rotation_turns_up_to_z_with_zero_yaw(up):
    R = g.level_rotation(up)
    assert np.allclose(R @ up, [0, 0, np.linalg.norm(up)], atol=1e-9)
    if abs(R[2, 0]) < np.sin(1.5):
        assert abs(np.arctan2(R[1, 0], R[0, 0])) < 1e-9


@given(tangents, st.floats(0, 1))
def test_interpolation_passes_through_both_ends(xi, alpha):
    T = g.se3_exp(xi)
    assert np.allclose(g.interpolate(np.eye(4), T, 0.0), np.eye(4), atol=1e-12)
    assert np.allclose(g.interpolate(np.eye(4), T, 1.0), T, atol=1e-8)
    middle = g.interpolate(np.eye(4), T, alpha)
    assert abs(np.linalg.norm(g.so3_log(middle[:3, :3])) - alpha * np.linalg.norm(g.so3_log(T[:3, :3]))) < 1e-7


@given(tangents, st.floats(0.2, 5.0), st.integers(0, 2**32 - 1))
def test_alignment_recovers_a_similarity(xi, scale, seed):
    source = np.random.default_rng(seed).normal(size=(20, 3))
    T = g.se3_exp(xi)
    S = g.sim3(scale, T[:3, :3], T[:3, 3])
    found = g.align_points(source, g.transform_points(S, source), with_scale=True)
    assert np.allclose(found, S, atol=1e-8)
    got_scale, R, t = g.sim3_parts(found)
    assert abs(got_scale - scale) < 1e-9
    assert np.allclose(R, T[:3, :3], atol=1e-8)
    assert np.allclose(t, T[:3, 3], atol=1e-8)
    rigid = g.align_points(source, g.transform_points(T, source))
    assert np.allclose(rigid, T, atol=1e-8)


def test_alignment_refuses_too_few_points():
    with pytest.raises(ValueError, match="at least 3 pairs"):
        g.align_points(np.zeros((2, 3)), np.zeros((2, 3)))


def test_a_rigid_motion_is_finite_orthonormal_not_mirrored_and_nothing_else():
    T = np.tile(g.se3_exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0])), (7, 1, 1))
    T[1, :3, 0] *= -1.0
    T[2, :3, :3] *= 1.01
    T[3, 0, 1] = np.nan
    T[4, 1, 3] = np.inf
    T[5, 3, 0] = 0.1
    T[6, 0, 0] += 1e-5
    assert g.are_rigid(T, 1e-4).tolist() == [True, False, False, False, False, False, True]
    assert g.are_rotations(T[:, :3, :3], 1e-6).tolist() == [True, False, False, False, True, True, False]
    assert g.are_rigid(T[0], 1e-9) and g.are_rigid(T[:0], 1e-9).all()
