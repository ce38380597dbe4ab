"""Loop closing: recognise places seen before and measure the relative pose, precision first."""
