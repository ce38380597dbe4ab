"""How cameras and inertial unit sit to each other, in space and time."""
