"""What goes wrong with sensors, put into any recording on purpose."""
