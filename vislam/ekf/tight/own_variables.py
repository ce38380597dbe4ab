"""What readings of sensors other than IMU and camera do to the tight filter, and where their own variables begin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.core.geometry import skew, so3_exp, so3_right_jacobian
from vislam.core.messages import Array
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.history import Outcome
from vislam.ekf.regain import Regain, grown
from vislam.ekf.sensor_rows import OwnVariables, Sensing, body_of
from vislam.ekf.tight.kernels import INERTIAL, from_nav_error, to_nav_error
from vislam.ekf.tight.state import CLONES, Window, corrected
from vislam.sensors import BodyState


def begun(sensing: Sensing, window: Window, start: OwnStart, t_ns: int) -> tuple[Window, Outcome]:
    """Return the window with a sensor's own variables set."""
    out, own, P = Outcome(), window.own.copy(), window.P.copy()
    out.accept(f"{start.sensor}_begun")
    sensing.begin(start, own, P)
    since_ns, watch = {**window.own_since_ns, start.sensor: t_ns}, window.watch.begun(start.sensor, t_ns)
    return replace(window, own=own, P=P, own_since_ns=since_ns, watch=watch), out


def corrected_by_reading(
    sensing: Sensing, window: Window, x: Array, reading: Reading, gyro_rad_s: Array, ago_s: float
) -> tuple[Window, Outcome]:
    """Return the window after a reading that was taken `ago_s` before x [16], which moves in place.

    `ago_s` is 0 unless a frame came between whose stamp is older, by a clock that is behind.
    """
    out, name = Outcome(), reading.sensor
    body = body_of(reading.t_ns, x, gyro_rad_s)
    P, values, at = window.P.copy(), window.own.copy(), sensing.suite.own(name)
    sensing.grow(name, reading.t_ns, window.own_since_ns, values, P)
    own = OwnVariables(values, P, window.own_since_ns)
    rows = sensing.rows(reading, body if ago_s == 0.0 else body.later(-ago_s), own, out)
    if rows is None:
        return window, out
    free = replace(window, own=values, P=P)
    H = np.zeros((len(rows.residual), len(P)))
    H[:, :INERTIAL] = rows.H @ by_now(body, ago_s) @ to_nav_error(x)
    H[:, window.first_own :][:, at] = rows.H_own
    S = H @ P @ H.T + np.eye(len(H))
    nis = float(rows.residual @ np.linalg.solve(S, rows.residual))
    since_ns = {**window.own_since_ns, name: reading.t_ns}
    if sensing.judge(reading, rows, S, nis, out):
        window = corrected(free, x, H, rows.residual)
        return replace(window, own_since_ns=since_ns, watch=window.watch.accepted(name, reading.t_ns, rows.H)), out
    watch, regain = sensing.refuse(window.watch, reading, rows, body, out)
    if regain is None:
        return replace(window, watch=watch), out
    sensing.regained(name, regain, out)
    window = _regained(free, x, body, regain)
    return replace(window, own_since_ns=since_ns, watch=watch.accepted(name, reading.t_ns, rows.H)), out


def _regained(window: Window, x: Array, body: BodyState, regain: Regain) -> Window:
    """Return a window moved by what its body, clones and points are off by; x [16] moves in place.

    As an invariant error has the place turned by the error of rotation in it, the covariance of that moves, too.
    """
    clones, points = range(CLONES, window.first_point, 6), range(window.first_point, window.first_own, 3)
    T, by_turn = np.eye(len(window.P)), skew(regain.place_m)
    T[3:6, 0:3], T[6:9, 0:3] = by_turn, skew(regain.velocity_m_s)
    for at in clones:
        T[at + 3 : at + 6, at : at + 3] = by_turn
    for at in points:
        T[at : at + 3, 0:3] = by_turn
    places = (3, *(at + 3 for at in clones), *points)
    P = T @ grown(window.P, regain, from_nav_error(x), places, body.R_world_body[2]) @ T.T
    x[0:3] += regain.place_m
    x[3:6] += regain.velocity_m_s
    return replace(
        window, P=0.5 * (P + P.T), p=window.p + regain.place_m, velocity=window.velocity + regain.velocity_m_s,
        points=window.points + regain.place_m,
    )  # fmt: skip


def by_now(body: BodyState, ago_s: float) -> Array:
    """Return how the error [15] of the body a moment ago, `body.later(-ago_s)`, hangs on that of now."""
    M = np.eye(INERTIAL)
    M[0:3, 0:3] = so3_exp(body.rate_rad_s * ago_s)
    M[0:3, 9:12] = ago_s * so3_right_jacobian(-body.rate_rad_s * ago_s)
    M[3:6, 6:9] = -ago_s * np.eye(3)
    return M
