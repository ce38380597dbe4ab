"""A low-pass of second order for samples that come when they come."""

from __future__ import annotations

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array


@njit(cache=True, nogil=True)
def low_pass(state: Array, values: Array, dt_s: float, tau_s: float) -> None:
    """Move a Butterworth filter on by one sample: state [2, N] is what it lets through and its slope per second.

    `tau_s` is the time constant of its step response, the cutoff sqrt(2)/(2 pi tau_s). The differential equation is
    solved exactly for a value held over the step, so steps may differ and `tau_s` may change between them.
    """
    decay = np.exp(-dt_s / tau_s)
    c, s = decay * np.cos(dt_s / tau_s), decay * np.sin(dt_s / tau_s)
    for i in range(len(values)):
        off, drift = state[0, i] - values[i], tau_s * state[1, i]
        state[0, i] = values[i] + c * off + s * (off + drift)
        state[1, i] = (c * drift - s * (2.0 * off + drift)) / tau_s
