"""Width of confidence intervals."""

from __future__ import annotations

NORMAL_95 = 1.959964
"""Standard deviations on either side that hold 95 % of a normal distribution."""
