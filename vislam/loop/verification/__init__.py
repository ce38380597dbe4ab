"""Whether two views show the same place, and from where each was seen.

Compiled by hand: 220 lines. No peer has been measured; poselib is the one to try, for the relative pose.
"""

from vislam.loop.verification.likeness import Likeness
from vislam.loop.verification.verifier import Verification, Verifier, judge, tilt_error_rad

__all__ = [
    "Likeness",
    "Verification",
    "Verifier",
    "judge",
    "tilt_error_rad",
]
