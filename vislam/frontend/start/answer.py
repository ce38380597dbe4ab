"""What the search for the first state answers, and how a solved window becomes a state in `odom`."""

from dataclasses import dataclass, replace

import numpy as np

from vislam.config import InitConfig
from vislam.core.geometry import level_rotation, so3_exp, transform
from vislam.core.messages import Array, ImuSpan, NavState
from vislam.frontend.start.solution import Solution
from vislam.imu.resting import level_covariance

WINDOW_S = 2.0  # metric visual odometry: gravity to 0.03 deg plus what the accelerometer bias hides
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Initialisation:
    """An answer: "waiting", "failed" (the window contradicts physics; still trying), or a state "static" or "moving".

    `T_odom_vo` takes poses chained from visual odometry (identity at the first frame fed) to `odom`: gravity-aligned,
    heading and position zero at that frame. Without scale the chain has no lengths; then odom's position is zero at the
    first frame of the window, and only the rotation of `T_odom_vo` means something.
    """

    status: str
    reason: str
    first: NavState | None = None  # at the first frame of the window
    last: NavState | None = None  # at its last
    T_odom_vo: Array | None = None  # [4, 4]
    t_ns: tuple[int, ...] = ()  # of the frames in the window that were solved for
    T_odom_body: Array | None = None  # [N, 4, 4] at these times
    cause: str = ""  # of a refusal, in a word: what it is counted under
    scale_sigma: float = 0.0  # relative, of lengths in the window; 0 where vision is metric or nothing has moved yet
    excitation_m_s2: float = 0.0  # rms change of acceleration in the window; near zero scale cannot be seen
    time_offset_s: float = 0.0  # of the camera's clock beyond what was applied, as this window has it
    time_offset_sigma_s: float = float("inf")
    is_settled: bool = True  # False: provisional, not yet tested against the seconds after it
    takes_back: bool = False  # the provisional one before did not survive its test


def moved_to(found: Initialisation, T_odom_body: Array) -> Initialisation:
    """Return an answer in another odom, in which its last position and heading are those of `T_odom_body` [4, 4].

    The vertical stays as it was found. An `odom` that a provisional start began goes on that way without a jump.
    """
    assert found.first is not None and found.last is not None and found.T_odom_vo is not None
    T_last = found.last.T_world_body
    R = T_odom_body[:3, :3] @ T_last[:3, :3].T
    heading_rad = float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
    R_turn = so3_exp(np.array([0.0, 0.0, heading_rad]))
    shift = transform(R_turn, T_odom_body[:3, 3] - R_turn @ T_last[:3, 3])
    poses = None if found.T_odom_body is None else shift @ found.T_odom_body
    first, last = _moved(found.first, shift), _moved(found.last, shift)
    return replace(found, first=first, last=last, T_odom_vo=shift @ found.T_odom_vo, T_odom_body=poses)


def _moved(state: NavState, T: Array) -> NavState:
    """Return a state in a world moved and turned by T [4, 4]."""
    R = T[:3, :3]
    turn = np.eye(15)
    turn[3:6, 3:6] = turn[6:9, 6:9] = R
    return replace(
        state, T_world_body=T @ state.T_world_body, velocity_world_m_s=R @ state.velocity_world_m_s,
        covariance=turn @ state.covariance @ turn.T,
    )  # fmt: skip


def level_at_once(
    span: ImuSpan, t_ns: int, T_vo_body: Array, gravity_m_s2: float, config: InitConfig
) -> Initialisation:
    """Return a provisional state at the end of a few samples: level by their mean force, at any plausible velocity.

    For vision that measures metres, which finds the rest within frames. `T_vo_body` [4, 4] is where visual odometry is
    then.
    """
    force = span.accel_m_s2.mean(axis=0)
    norm = float(np.linalg.norm(force))
    up = force if norm > 0.5 * gravity_m_s2 else np.array([0.0, 0.0, gravity_m_s2])
    T_odom_vo = transform(level_rotation(T_vo_body[:3, :3] @ up), np.zeros(3))
    T_odom_body = T_odom_vo @ T_vo_body
    covariance = level_covariance(norm - gravity_m_s2, T_odom_body[:3, :3], gravity_m_s2, config)
    state = NavState(t_ns, T_odom_body, np.zeros(3), np.zeros(3), np.zeros(3), covariance)
    tilt_deg = np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    reason = f"level by the newest samples, to {tilt_deg:.0f} deg"
    return Initialisation("level", reason, state, state, T_odom_vo, (t_ns,), T_odom_body[None], is_settled=False)


def moving(T_vo_body: Array, solution: Solution, metric: bool, excitation_m_s2: float) -> Initialisation:
    """Return a solution in `odom`; `T_vo_body` [4, 4] is where visual odometry has its first node."""
    up_vo = T_vo_body[:3, :3] @ solution.T_world_body[0, 2, :3]
    T_odom_vo = transform(level_rotation(up_vo), np.zeros(3))
    origin = T_odom_vo @ T_vo_body
    turn = np.eye(4)
    turn[:3, :3] = origin[:3, :3] @ solution.T_world_body[0, :3, :3].T
    turn[:3, 3] = origin[:3, 3] if metric else 0.0
    poses = turn @ solution.T_world_body
    inflation = max(solution.residual_ratio, 1.0)  # what the model does not explain makes the answer less certain
    first, last = (
        NavState(
            t_ns=solution.t_ns[i],
            T_world_body=poses[i],
            velocity_world_m_s=turn[:3, :3] @ solution.velocities_m_s[i],
            gyro_bias_rad_s=solution.gyro_bias_rad_s,
            accel_bias_m_s2=solution.accel_bias_m_s2,
            covariance=_turn(covariance, turn[:3, :3]) * inflation,
        )
        for i, covariance in ((0, solution.first_covariance), (-1, solution.last_covariance))
    )
    reason = f"{len(poses)} frames over {(last.t_ns - first.t_ns) / _NS:.2f} s, chi2 {solution.residual_ratio:.2f}"
    scale_sigma = 0.0 if metric else solution.scale_sigma * float(np.sqrt(inflation))
    if not metric:
        reason = f"{reason}, scale sigma {100.0 * scale_sigma:.1f} %"
    return Initialisation(
        "moving", reason, first, last, T_odom_vo, solution.t_ns, poses,
        scale_sigma=scale_sigma, excitation_m_s2=excitation_m_s2,
    )  # fmt: skip


def _turn(covariance: Array, R: Array) -> Array:
    """Return the covariance with position and velocity in turned world axes; the chosen origin gets its sigma back."""
    J = np.eye(15)
    J[3:6, 3:6] = J[6:9, 6:9] = R
    out = J @ covariance @ J.T
    out[:6, :6] += np.eye(6) * 1e-8
    return out
