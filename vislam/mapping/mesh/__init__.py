"""Meshes: signed distances of many views fused into one surface, and pictures laid on it."""
