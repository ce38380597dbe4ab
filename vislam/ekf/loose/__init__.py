"""The loose filter: motion that vision measured corrects the inertial state.

Compiled by hand: 430 lines. No library has been measured beside them; what is known is the same source without a
compiler: a prediction 1.8 us instead of 53, a correction 5.1 us instead of 0.18 ms, a replay of 100 ms 43 us instead
of 2.2 ms (benchmarks/ekf.py). The compiler is to be dropped where that is fast enough.
"""
