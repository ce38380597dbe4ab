"""How simulated bodies move: smooth splines, measured paths, walks."""
