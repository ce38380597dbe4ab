"""Poses of keyframes that fit their depth images to each other, for the maps' files alone."""
