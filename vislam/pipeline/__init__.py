"""The halves of the pipeline: what runs at the rate of the sensors, and what runs at that of keyframes."""
