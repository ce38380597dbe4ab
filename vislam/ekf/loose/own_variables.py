"""What readings of sensors other than IMU and camera do to the loose filter, and where their own variables begin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.core.messages import Array
from vislam.core.readings import OwnStart, Reading
from vislam.ekf.history import Outcome
from vislam.ekf.loose import kernels
from vislam.ekf.loose.state import LooseState
from vislam.ekf.regain import grown
from vislam.ekf.sensor_rows import OwnVariables, Sensing, body_of


def begin(sensing: Sensing, state: LooseState, start: OwnStart, t_ns: int, out: Outcome) -> None:
    """Set a sensor's own variables in a state, in place."""
    out.accept(f"{start.sensor}_begun")
    sensing.begin(start, state.x[kernels.NOMINAL :], state.P)
    _note(state, start.sensor, t_ns)
    state.ledger = replace(state.ledger, watch=state.ledger.watch.begun(start.sensor, t_ns))


def correct_by_reading(sensing: Sensing, state: LooseState, reading: Reading, gyro_rad_s: Array, out: Outcome) -> None:
    """Correct a state in place by a reading, unless its gate refuses it.

    The past moves as well, also where `odom` is continuous: a reading may show where in `odom` the body is, and that is
    no business of the clone.
    """
    name, since_ns = reading.sensor, state.ledger.own_since_ns
    x, P = state.x.copy(), state.P.copy()  # copies: a reading that the gate refuses leaves no walk behind
    own = OwnVariables(x[kernels.NOMINAL :], P[kernels.ERRORS :, kernels.ERRORS :], since_ns)
    sensing.grow(name, reading.t_ns, since_ns, own.values, P)
    rows = sensing.rows(reading, body_of(reading.t_ns, x, gyro_rad_s), own, out)
    if rows is None:
        return
    m = len(rows.residual)
    H = np.zeros((m, len(P)))
    H[:, :15], H[:, kernels.ERRORS :][:, sensing.suite.own(name)] = rows.H, rows.H_own
    S = H @ P @ H.T + np.eye(m)
    everything = np.eye(len(P))
    nis = kernels.update(x, P, H, np.eye(m), rows.residual, sensing.limit(name, m), everything)
    watch = state.ledger.watch
    if not sensing.judge(reading, rows, S, nis, out):
        body = body_of(reading.t_ns, state.x, gyro_rad_s)
        watch, regain = sensing.refuse(watch, reading, rows, body, out)
        if regain is None:
            state.ledger = replace(state.ledger, watch=watch)
            return
        sensing.regained(name, regain, out)
        P = grown(P, regain, np.eye(15), (3, 18), body.R_world_body[2])
        x[0:3] += regain.place_m
        x[3:6] += regain.velocity_m_s
        x[16:19] += regain.place_m  # the clone
    state.x, state.P = x, P
    _note(state, name, reading.t_ns)
    state.ledger = replace(state.ledger, watch=watch.accepted(name, reading.t_ns, rows.H))


def _note(state: LooseState, name: str, t_ns: int) -> None:
    since_ns = {**state.ledger.own_since_ns, name: t_ns}
    state.ledger = replace(state.ledger, own_since_ns=since_ns)
