"""Phrases on the sessions of a lab and on their control charts."""

from collections.abc import Iterable, Sequence

from bampipe.lists import join_names
from bampipe.results.lab import ControlChart, MovedParameter, SessionVerdict, TrendsResult


def list_moved(moved: Iterable[MovedParameter]) -> str:
    """Return the parameters beyond their limits, with their change from the centre."""
    parts = []
    for one in moved:
        change = f"{one.estimate:.4g} {one.unit}"
        if one.percent is not None:
            change = f"{one.percent:+.2g} %".replace("-", "−")
        parts.append(f"{one.parameter} {change}")
    return ", ".join(parts)


def describe_shift(
    moved: str, lacking: Sequence[str], back: Sequence[str], still: Sequence[str]
) -> str:
    """Return whether missing effects account for parameters beyond their limits.

    Args:
        moved: the parameters, from `list_moved`; lacking: the missing effects.
        back: parameters that are back within their limits with the effects; still: those outside.
    """
    effects = join_names(lacking)
    if still:
        return (
            f"{moved}; lacks {effects}, which does not account for {', '.join(still)}: the device"
            " changed too"
        )
    if back:
        verb = "they are" if back[1:] else "it is"
        return (
            f"{moved}; with {effects} in the model {verb} back within the limits: the device has"
            " not changed"
        )
    return f"{moved}; lacks {effects}, which biases the parameters"


def verdict(trends: TrendsResult, session: SessionVerdict) -> str:
    """Return the verdict on a session; it is in control only if its device has control limits."""
    limited = any(one.has_limits for one in trends.series if one.device == session.device)
    return session.verdict if limited or session.verdict != "in control" else "no limits yet"


def list_signs(chart: ControlChart) -> list[str]:
    """Return the signs of a change on a chart."""
    outside = [point.session for point in chart.points if point.outside_limits]
    signs = [f"outside its limits: {', '.join(outside)}"] if outside else []
    if chart.drifts:
        signs.append("trend")
    if chart.run:
        signs.append(f"shift from {chart.run[0]} to {chart.run[1]}")
    return signs


def list_trends(series: Iterable[ControlChart]) -> list[str]:
    """Return a line on each trend and each shift."""
    lines = []
    for chart in series:
        if chart.drifts and chart.slope_per_session is not None:
            percent = 100.0 * chart.slope_per_session / abs(chart.centre or 1.0)
            lines.append(f"trend: {chart.name} {percent:+.2g} % a session")
        if chart.run:
            first, last = chart.run
            lines.append(f"shift: {chart.name} on one side of its median, {first} to {last}")
    return lines
