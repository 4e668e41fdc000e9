"""Width of confidence intervals."""

NORMAL_95 = 1.959964
"""Standard deviations on either side that hold 95 % of a normal distribution."""
