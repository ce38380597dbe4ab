"""Clouds, surfels and meshes fused from keyframes."""
