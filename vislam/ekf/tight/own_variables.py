"""What readings of sensors other than IMU and camera do to the tight filter, and where their own variables begin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.core.geometry import so3_exp, so3_right_jacobian
from vislam.core.messages import Array
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.history import Outcome
from vislam.ekf.sensor_rows import OwnVariables, Sensing, body_of
from vislam.ekf.tight.kernels import INERTIAL, to_nav_error
from vislam.ekf.tight.state import Window, corrected
from vislam.sensors import BodyState


def begun(sensing: Sensing, window: Window, start: OwnStart, t_ns: int) -> tuple[Window, Outcome]:
    """Return the window with a sensor's own variables set."""
    out, own, P = Outcome(), window.own.copy(), window.P.copy()
    out.accept(f"{start.sensor}_begun")
    sensing.begin(start, own, P)
    return replace(window, own=own, P=P, own_since_ns={**window.own_since_ns, start.sensor: t_ns}), out


def corrected_by_reading(
    sensing: Sensing, window: Window, x: Array, reading: Reading, gyro_rad_s: Array, ago_s: float
) -> tuple[Window, Outcome]:
    """Return the window after a reading that was taken `ago_s` before x [16], which moves in place.

    `ago_s` is 0 unless a frame came between whose stamp is older, by a clock that is behind.
    """
    out, name = Outcome(), reading.sensor
    body = body_of(reading.t_ns, x, gyro_rad_s)
    own = OwnVariables(window.own, window.P, window.own_since_ns)
    rows = sensing.rows(reading, body if ago_s == 0.0 else body.later(-ago_s), own, out)
    if rows is None:
        return window, out
    P, at = window.P.copy(), sensing.suite.own(name)
    sensing.grow(name, reading.t_ns, window.own_since_ns, P)
    grown = replace(window, P=P)
    H = np.zeros((len(rows.residual), len(P)))
    H[:, :INERTIAL] = rows.H @ by_now(body, ago_s) @ to_nav_error(x)
    H[:, window.first_own :][:, at] = rows.H_own
    S = H @ P @ H.T + np.eye(len(H))
    nis = float(rows.residual @ np.linalg.solve(S, rows.residual))
    if not sensing.judge(name, nis, len(H), out):
        return window, out
    since_ns = {**window.own_since_ns, name: reading.t_ns}
    return replace(corrected(grown, x, H, rows.residual), own_since_ns=since_ns), out


def by_now(body: BodyState, ago_s: float) -> Array:
    """Return how the error [15] of the body a moment ago, `body.later(-ago_s)`, hangs on that of now."""
    M = np.eye(INERTIAL)
    M[0:3, 0:3] = so3_exp(body.rate_rad_s * ago_s)
    M[0:3, 9:12] = ago_s * so3_right_jacobian(-body.rate_rad_s * ago_s)
    M[3:6, 6:9] = -ago_s * np.eye(3)
    return M
