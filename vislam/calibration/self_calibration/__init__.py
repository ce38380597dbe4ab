"""Self-calibration: a camera, and how it sits on the IMU, from waving both about; no board, no files."""
