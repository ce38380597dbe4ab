"""What the config takes from measurements: cameras, IMU, noise, magnetometer, floor, and how they sit to each other."""
