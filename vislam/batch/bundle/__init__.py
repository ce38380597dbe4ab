"""Visual-inertial bundle adjustment of whole runs."""
