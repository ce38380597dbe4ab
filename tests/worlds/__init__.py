"""Worlds with exact truth that tests and benchmarks measure in."""
