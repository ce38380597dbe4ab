"""Sensors of the cart: inertial chips, serial bridge, webcam. Every driver stamps at capture and counts its faults."""
