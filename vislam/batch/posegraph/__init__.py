"""Pose-graph files: read, solved, judged, certified.

Compiled by hand: the solver and the reader, 1,400 lines. Peer: gtsam 4.3, whose best route takes 1.9 to 8 times the
CPU time from structure to answer on five public files and misses the optimum of the sixth; from file to file it takes
1.2 to 18 times. Ceres and g2o stand beside them in docs/batch.md. `cholesky`, `ordering` and `symbolic` are to be
dropped when a wheel brings a multifrontal Cholesky with dense blocks under a permissive licence.
"""
