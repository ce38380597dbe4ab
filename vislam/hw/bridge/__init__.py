"""A microcontroller on a serial port that reads the chips on time: protocol, clock, driver."""
