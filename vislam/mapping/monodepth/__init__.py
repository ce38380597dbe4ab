"""Dense depth from one moving camera: one filter per pixel of a keyframe, fed by the frames that follow it."""

from vislam.mapping.monodepth.filter import DepthFilter
from vislam.mapping.monodepth.stage import LateDepth, MonoDepth, SeenFrame

__all__ = ["DepthFilter", "LateDepth", "MonoDepth", "SeenFrame"]
