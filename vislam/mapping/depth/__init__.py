"""Depth of a keyframe: from its sensor, two cameras, or the motion of one."""
