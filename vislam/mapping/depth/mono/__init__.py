"""Dense depth from one moving camera: one filter per pixel of a keyframe, fed by the frames that follow it.

Compiled by hand: 400 lines. Peer: the slambook's loop in C++, -O3 -march=native, which takes 6.3 to 12.7 times the CPU
time per frame; inverse depths agree to 0.1 % (benchmarks/RESULTS.md). To be dropped when a library has such a filter;
none has.
"""

from vislam.mapping.depth.mono.depth_filter import DepthFilter
from vislam.mapping.depth.mono.stage import LateDepth, MonoDepth, SeenFrame

__all__ = ["DepthFilter", "LateDepth", "MonoDepth", "SeenFrame"]
