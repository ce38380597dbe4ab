"""Images and views: features, two-view geometry, pose of a camera, shutter, brightness.

Compiled by hand: 540 lines. No peer has been measured. OpenCV has the matching, the essential matrix and the pose
from points, without their covariances: each submap is to be dropped when it is measured and the peer is as fast and as
good.
"""
