"""Calibration in the page of a live run that waits: sensors, steps, and what browsers get of them."""
