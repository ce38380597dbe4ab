"""Heading by the magnetometer, where its field is what it has been: section 3.6 of VQF (see `levelling`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.config import AttitudeConfig
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.imu.levelling import low_pass

_MAG_TAU_S = 9.0  # of the heading
_MAG_FIELD_TAU_S = 0.05  # low-pass on the field's norm and dip
_MAG_REFERENCE_TAU_S = 20.0  # over which norm and dip of the reference follow
_MAG_UNDISTURBED_S = 0.5  # the field is trusted after being like the reference for so long
_MAG_NEW_S = 20.0  # another field becomes the reference after so long of turning in it
_MAG_NEW_RATE_DEG_S = 20.0  # at least as fast as this: what the body carries along would show
_MAG_REJECT_S = 60.0  # after so long, a disturbed field is better than a gyro alone
_MAG_REJECT_FACTOR = 2.0  # at a gain lower by this factor


class Heading(NamedTuple):
    """What is remembered of the field; norm in uT, dip (below the horizon) in rad."""

    field: Array  # [2, 2] low-passed norm and dip
    reference: Array  # [2] norm and dip of the field that is trusted
    candidate: Array  # [2] of the field that may become it
    clocks_s: Array  # [3] for how long: the field was trusted, it was rejected, the candidate stood
    yaw_rad: Array  # [1] of the world against the frame that levelling began with
    azimuth_rad: Array  # [1] of the field in the world, where yaw is held
    share: Array  # [1] of the next sample in the mean that the azimuth begins as; zero: it is over


class Magnetic(NamedTuple):
    """Settings of the kernel, in radians."""

    tau_s: float
    field_tau_s: float
    reference_tau_s: float
    norm_gate: float
    dip_gate_rad: float
    undisturbed_s: float
    new_s: float
    new_rate_rad_s: float
    reject_s: float
    reject_factor: float


def magnetic(config: AttitudeConfig) -> Magnetic:
    """Return the kernel's parameters."""
    return Magnetic(
        _MAG_TAU_S, _MAG_FIELD_TAU_S, _MAG_REFERENCE_TAU_S, config.mag_gate,
        np.deg2rad(config.mag_dip_gate_deg), _MAG_UNDISTURBED_S, _MAG_NEW_S,
        np.deg2rad(_MAG_NEW_RATE_DEG_S), _MAG_REJECT_S, _MAG_REJECT_FACTOR,
    )  # fmt: skip


def begin_heading() -> Heading:
    """Return the state before any field came."""
    return Heading(np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.zeros(3), np.zeros(1), np.zeros(1), np.ones(1))


@njit(cache=True, nogil=True)
def hold_heading(state: Heading, seen: Array, rate_rad_s: float, dt_s: float, p: Magnetic) -> None:
    """Take a field [3], seen in the level frame in which the heading is given; the first one has no dt_s."""
    norm = np.sqrt(np.sum(seen * seen))
    if norm == 0.0:
        return
    _watch(state, norm, -np.arcsin(seen[2] / norm), rate_rad_s, dt_s, p)
    off = np.arctan2(seen[1], seen[0]) + state.yaw_rad[0] - state.azimuth_rad[0]
    off = np.arctan2(np.sin(off), np.cos(off))
    gain = _gain(state, dt_s, p)
    if state.share[0] > 0.0:  # the first samples say where the field is: one alone is as wrong as its noise
        state.azimuth_rad[0] += state.share[0] * off
        state.share[0] /= 1.0 + state.share[0]
        if state.share[0] * p.tau_s < dt_s:
            state.share[0] = 0.0
    else:
        state.yaw_rad[0] -= gain * off


@njit(cache=True, nogil=True)
def _gain(state: Heading, dt_s: float, p: Magnetic) -> float:
    """Return the share of the sample in the heading; a disturbed field has none, for as long as a gyro can do alone."""
    gain = 1.0 - np.exp(-dt_s / p.tau_s)
    clocks_s = state.clocks_s
    if clocks_s[0] >= p.undisturbed_s:
        clocks_s[1] = max(clocks_s[1] - p.reject_factor * dt_s, 0.0)
        return gain
    if clocks_s[1] <= p.reject_s:
        clocks_s[1] += dt_s
        return 0.0
    return gain / p.reject_factor


@njit(cache=True, nogil=True)
def _watch(state: Heading, norm: float, dip_rad: float, rate_rad_s: float, dt_s: float, p: Magnetic) -> None:
    """Compare the field with the reference, and with what may become it after turning in it for long enough."""
    now = np.array([norm, dip_rad])
    if (
        state.share[0] == 1.0
    ):  # power-up saw to it that it is the earth's; VQF's own first field must show it by turning
        state.field[0] = now
        state.reference[:] = now
    elif dt_s > 0.0:
        low_pass(state.field, now, dt_s, p.field_tau_s)
    now = state.field[0]
    share = 1.0 - np.exp(-dt_s / p.reference_tau_s)
    reference, candidate, clocks_s = state.reference, state.candidate, state.clocks_s
    if _is_like(now, reference, p):
        clocks_s[0] += dt_s
        if clocks_s[0] >= p.undisturbed_s:
            reference += share * (now - reference)
    else:
        clocks_s[0] = 0.0
    if not _is_like(now, candidate, p):
        clocks_s[2] = 0.0
        candidate[:] = now
        return
    if rate_rad_s >= p.new_rate_rad_s:
        clocks_s[2] += dt_s
    candidate += share * (now - candidate)
    if clocks_s[0] < p.undisturbed_s and clocks_s[2] >= p.new_s:
        reference[:] = candidate
        clocks_s[0] = p.undisturbed_s


@njit(cache=True, nogil=True)
def _is_like(field: Array, reference: Array, p: Magnetic) -> bool:
    down = field[0] * np.sin(field[1]) - reference[0] * np.sin(reference[1])
    norm = abs(field[0] - reference[0])
    return bool(max(norm, abs(down)) < p.norm_gate * reference[0] and abs(field[1] - reference[1]) < p.dip_gate_rad)
