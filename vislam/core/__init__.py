"""What every room knows: messages, geometry, cameras, errors, clocks, files.

Compiled by hand: 350 lines (cameras, geometry, 3 x 3 helpers). Kernels elsewhere call them, so no library can take
their place while those are compiled; no peer has been measured.
"""
