"""The published pose on other wires: ROS 2 and MAVLink."""
