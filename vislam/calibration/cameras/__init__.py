"""Calibration of cameras: boards, lenses, and the floor below."""
