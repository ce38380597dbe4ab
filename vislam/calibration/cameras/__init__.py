"""Calibration of cameras: boards, lenses, and the floor below."""

from vislam.calibration.cameras.lens import COEFFICIENTS, Model, parameter_names, parameters_of

__all__ = ["COEFFICIENTS", "Model", "parameter_names", "parameters_of"]
