"""Calibration of inertial units and magnetometers."""
