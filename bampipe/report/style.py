"""Style of figures: size, colours that colour-blind readers can distinguish, and SVG output.

Colours are those of Okabe and Ito (2008). Lines that matter also differ in dash or width.
"""

import io
from collections.abc import Sequence
from contextlib import AbstractContextManager
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from bampipe.report import document
from bampipe.report.wording import break_lines, choose_scale, format_unit, split_name
from bampipe.results.draft import DraftCurve
from bampipe.results.rounding import NORMAL_95
from bampipe.results.terms import TermCurve

COLOURS = {
    "ink": "#1c2024", "faint": "#b4b8bd", "blue": "#0072b2", "vermillion": "#d55e00",
    "green": "#009e73", "orange": "#e69f00", "sky": "#56b4e9", "purple": "#cc79a7",
}  # fmt: skip
"""All colours in use, by the name that the page's style sheet gives them."""
INK, FAINT, BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE = COLOURS.values()

SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
"""Colours of axes, components or models, in their order."""

_LABEL = 30
"""Letters in a line of an axis label: longer lines are clipped if three panels share a row."""
_HEADING = 70
"""Letters of a heading across the whole width."""
_LETTER, _HANDLE = 0.058, 0.42
"""Widths in a legend, inches: of an average letter, and of the symbol before the words."""
_MOST_LEGEND_COLUMNS = 4
_FEW_DECADES = 300.0
"""Ratio of values up to which a logarithmic axis has room for labels within a decade."""
_FEWER_TICKS = (6, 5, 4, 3, 2)

WIDTH = 6.69
"""Width of the text in print, inches: figures are drawn at the size at which they are printed."""
TALLEST = 9.1
"""Height of a figure, inches, that leaves room for a caption on its page."""

_SETTINGS = Path(__file__).parent / "templates" / "figure.mplstyle"


def use_style() -> AbstractContextManager[None]:
    """Return the context in which figures are drawn, independent of the user's own settings."""
    own = mpl.rc_params_from_file(_SETTINGS, use_default_template=False)
    settings: dict[Any, Any] = {**mpl.rcParamsDefault, **own, "backend": "svg"}
    return mpl.rc_context(settings)


def make_panels(
    rows: int, columns: int, height: float, *, width: float = WIDTH, sharex: bool = False
) -> tuple[Figure, np.ndarray]:
    """Return a figure of panels, and its axes, (rows, columns).

    Args:
        height, width: of the whole figure, inches; at most `TALLEST`.
        sharex: one horizontal range for all panels, labelled on the last row.
    """
    figure = Figure(figsize=(width, min(height, TALLEST)), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex)
    return figure, axes


def make_grid(
    count: int, columns: int, row_height: float, *, extra: float = 0.35, column_width: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``count`` panels in rows of at most ``columns``, and the panels in order.

    Args:
        row_height: of each row, inches; extra: added to the height for a legend below.
        column_width: of each column, inches; the whole text width if 0.
    """
    columns = min(columns, count)
    rows = -(-count // columns)
    width = min(WIDTH, 1.0 + column_width * columns) if column_width else WIDTH
    figure, axes = make_panels(rows, columns, extra + row_height * rows, width=width)
    for unused in axes.flat[count:]:
        unused.set_axis_off()
    return figure, list(axes.flat[:count])


def split_figure(height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of one panel on the left and two on the right, in this order."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, list(figure.subplot_mosaic("AB;AC", width_ratios=(1.0, 1.7)).values())


def finish(
    figure: Figure, name: str, caption: str, legend_from: Sequence[Axes] = ()
) -> document.Figure:
    """Return the block of a figure, with a common legend of these panels below."""
    found = [axes.get_legend_handles_labels() for axes in legend_from]
    names = [name for _, own in found for name in own]
    handles = [handle for own, _ in found for handle in own]
    if names:
        columns = int(figure.get_figwidth() / (_LETTER * max(map(len, names)) + _HANDLE))
        columns = max(1, min(_MOST_LEGEND_COLUMNS, columns, len(names)))
        figure.legend(handles, names, loc="outside lower center", ncols=columns)
    return document.Figure(name.replace(":", "."), caption, render_svg(figure))


def render_svg(figure: Figure) -> str:
    """Return the figure as SVG: the same figure gives the same text."""
    _part_labels(figure)
    figure.set_layout_engine("none")  # already laid out, which takes half of the time
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _part_labels(figure: Figure) -> None:
    """Take fewer ticks along horizontal axes whose labels touch."""
    for most in _FEWER_TICKS:
        figure.get_layout_engine().execute(figure)  # type: ignore[union-attr]
        touching = [axes for axes in figure.axes if _touch(axes)]
        if not touching:
            return
        for axes in touching:
            axes.xaxis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))


def _touch(axes: Axes) -> bool:
    """Return whether matplotlib's own ticks have labels closer than the width of a letter."""
    if not isinstance(axes.xaxis.get_major_locator(), MaxNLocator) or not axes.axison:
        return False
    boxes = [
        text.get_window_extent() for text in axes.get_xticklabels()
        if text.get_visible() and text.get_text()
    ]  # fmt: skip
    between = 72.0 * _LETTER
    return any(b.x0 - a.x1 < between for a, b in pairwise(boxes))


def label_axis(quantity: str, unit: str, most: int = _LABEL) -> str:
    """Return the label of an axis: quantity and unit as printed, in lines if it is long."""
    return break_lines(f"{quantity} ({format_unit(unit)})" if unit else quantity, most)


def break_heading(name: str, columns: int) -> str:
    """Return the name above a panel, one of ``columns`` beside each other, in lines that fit."""
    return break_lines(name, round(_HEADING / columns))


def thin(length: int, most: int) -> slice:
    """Return every n-th sample, so that at most about ``most`` are drawn."""
    return slice(0, length, max(1, -(-length // most)))


def draw_curve(
    axes: Axes, curve: TermCurve | DraftCurve, at: Sequence[float], word: str = "", **look: Any
) -> None:
    """Draw a force with its band over a variable.

    Args:
        at: values of the variable; word: behind the name of the force; look: of the line.
    """
    x, shown = scale_values(np.array(at), curve.variable_unit)
    axes.fill_between(x, curve.low, curve.high, color=BLUE, alpha=0.25, lw=0)
    axes.plot(x, curve.mean, color=BLUE, **look)
    axes.axhline(0.0, color=INK, lw=0.5)
    kind = "torque" if curve.unit.startswith("N.m") else "force"
    axes.set_xlabel(label_axis(split_name(curve.variable), shown))
    axes.set_ylabel(label_axis(f"{kind}{word}", curve.unit))


def draw_series(
    axes: Axes, x: np.ndarray, y: np.ndarray, colour: str, name: str, **more: object
) -> None:
    """Draw a time series, thinned to what a printed line can show."""
    keep = thin(len(x), 2000)
    axes.plot(x[keep], y[keep], color=colour, label=name, **more)  # type: ignore[arg-type]


def draw_estimate(
    axes: Axes, trace: pd.DataFrame, name: str, colour: str, label: str, dashes: Any = "-"
) -> None:
    """Draw a column of a trace with its 95 % bounds, thinned."""
    shown = trace.iloc[thin(len(trace), 1500)]
    t, value = shown["t_total"].to_numpy(), shown[name].to_numpy()
    half = NORMAL_95 * shown[f"{name}_sd"].to_numpy()
    axes.fill_between(t, value - half, value + half, color=colour, alpha=0.18, lw=0)
    axes.plot(t, value, color=colour, ls=dashes, label=label)


def mark_trials(axes: Axes, trace: pd.DataFrame) -> None:
    """Mark the start of each trial but the first in a trace."""
    starts = trace.loc[trace["trial_id"].ne(trace["trial_id"].shift()), "t_total"].to_numpy()
    for start in starts[1:]:
        axes.axvline(start, color=FAINT, lw=0.6, ls=(0, (1, 2)), zorder=0)


def set_limits(axes: Axes, values: Sequence[np.ndarray], *, zero: bool = False) -> None:
    """Set the vertical range to hold all finite ``values`` with a margin, zero too if asked."""
    joined = np.concatenate([np.asarray(item, dtype=float).ravel() for item in values])
    joined = joined[np.isfinite(joined)]
    if not joined.size:
        return
    low, high = float(joined.min()), float(joined.max())
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    axes.set_ylim(low if zero and low == 0.0 else low - margin, high + margin)


def use_decades(axes: Axes, values: Sequence[float] | np.ndarray) -> None:
    """Make the vertical axis logarithmic over positive ``values``, without crowded labels."""
    low, high = float(min(values)), float(max(values))
    axes.set_yscale("log")
    axes.set_ylim(low / 1.6, high * 1.6)
    if high < _FEW_DECADES * low:
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def scale_values(values: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Return the values and the unit with a prefix that suits them."""
    finite = values[np.isfinite(values)]
    factor, shown = choose_scale([float(np.max(np.abs(finite)))] if finite.size else [], unit)
    return values * factor, shown
