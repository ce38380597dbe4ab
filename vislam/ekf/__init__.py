"""The fast path: an error-state Kalman filter over inertial samples, corrected by relative visual motion."""

from vislam.ekf.filter import Ekf, UpdateResult

__all__ = ["Ekf", "UpdateResult"]
