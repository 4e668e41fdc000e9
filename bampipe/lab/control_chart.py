"""Control charts of estimates that each come with a standard deviation of their own.

An individuals chart (Shewhart) whose scatter is estimated from moving ranges, so that a slow
drift or a step between two values hardly widens the limits. The moving range holds both the
scatter between sessions, tau, and the uncertainty within each, s_i; limits of session i are

    centre +/- factor(n) * sqrt(tau^2 + s_i^2),    tau^2 = max(0, sigma_MR^2 - median(s^2)),

so that a session known only roughly has wider limits. sigma_MR is the median moving range over
0.954 (Montgomery, Introduction to Statistical Quality Control, section 6.4; the median is that of
Clifford 1959): up to a quarter of the sessions may be off without hiding one another.
"""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from bampipe.arrays import Array
from bampipe.results.lab import ChartPoint, ControlChart

FEWEST_SESSIONS = 6
"""Fewest sessions whose scatter is known well enough for limits."""

RUN_LENGTH = 9
"""Consecutive sessions on one side of the centre that are a shift (Nelson 1984, test 2)."""

FALSE_ALARM = 0.0027
"""Share of sessions of an unchanged device beyond the limits: that of three sigma."""

MEDIAN_RANGE = 0.9539
"""Median of the range of two standard normal numbers, sqrt(2) * 0.6745."""

_LIMIT_FACTORS = (
    (6, 6.95), (7, 5.30), (8, 5.63), (9, 4.80), (10, 4.95), (11, 4.46), (12, 4.54), (13, 4.21),
    (14, 4.27), (15, 4.05), (16, 4.09), (17, 3.92), (18, 3.94), (19, 3.81), (20, 3.83),
    (22, 3.75), (24, 3.69), (26, 3.63), (28, 3.58), (30, 3.53), (40, 3.40), (60, 3.26),
    (100, 3.15),
)  # fmt: skip
"""Numbers of sessions, and factors for FALSE_ALARM: quantiles of |x - median| / sigma_MR over 1.2e7
normal numbers; the test suite draws some of them again. Three only for very many sessions."""


def find_factor(sessions: int) -> float:
    """Return half the width of the limits in standard deviations, for so many sessions."""
    counts, values = zip(*_LIMIT_FACTORS, strict=True)
    if sessions > counts[-1]:
        return float(3.0 + (values[-1] - 3.0) * counts[-1] / sessions)
    return float(np.interp(sessions, counts, values))


def make_chart(
    device: str, name: str, unit: str, entries: Sequence[tuple[str, float, float]]
) -> ControlChart:
    """Return the control chart of a quantity; without limits where there are too few sessions.

    Args:
        entries: session, estimate and standard deviation, 0 where that is not known, in the order
            of their recording.
    """
    sessions, estimates, sds = zip(*entries, strict=True)
    x, s = np.array(estimates, dtype=float), np.array(sds, dtype=float)
    centre, half = float(np.median(x)), np.full(len(x), np.inf)
    between = slope = slope_p = run = None
    if len(x) >= FEWEST_SESSIONS:
        sigma = float(np.median(np.abs(np.diff(x)))) / MEDIAN_RANGE
        between = float(np.sqrt(max(0.0, sigma**2 - float(np.median(s**2)))))
        half = find_factor(len(x)) * np.sqrt(between**2 + s**2)
        slope, slope_p = _find_trend(x)
        run = _find_run(x)
    return ControlChart(
        device=device,
        name=name,
        unit=unit,
        centre=centre,
        between_sd=between,
        slope_per_session=slope,
        slope_p=slope_p,
        # This is less likely by chance than a point beyond the limits.
        drifts=slope_p is not None and slope_p < FALSE_ALARM,
        run=None if run is None else (sessions[run[0]], sessions[run[1]]),
        points=tuple(
            ChartPoint(
                session=session,
                estimate=value,
                sd=sd,
                lower=None if between is None else centre - half[i],
                upper=None if between is None else centre + half[i],
                outside_limits=abs(value - centre) > half[i],
            )
            for i, (session, value, sd) in enumerate(entries)
        ),
    )


def _find_run(x: Array) -> tuple[int, int] | None:
    """Return the places of the longest run of RUN_LENGTH or more on one side of the median."""
    side = np.sign(x - np.median(x)).tolist()
    runs = [[*run] for one, run in groupby(range(len(x)), key=side.__getitem__) if one]
    longest = max(runs, key=len, default=[])
    return (longest[0], longest[-1]) if len(longest) >= RUN_LENGTH else None


def _find_trend(x: Array) -> tuple[float, float]:
    """Return the median slope a session (Theil and Sen), and its p-value (Kendall)."""
    from scipy.stats import kendalltau, theilslopes

    order = np.arange(len(x), dtype=float)
    if np.ptp(x) == 0.0:
        return 0.0, 1.0
    return float(theilslopes(x, order).slope), float(kendalltau(order, x).pvalue)
