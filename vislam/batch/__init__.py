"""Batch optimisation: a whole run at once, as the reference of accuracy."""
