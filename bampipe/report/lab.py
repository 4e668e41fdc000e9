"""The report over all sessions of a lab: verdicts, control charts, errors, trials."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from bampipe.lists import join_names
from bampipe.report import style, wording
from bampipe.report.build import Report
from bampipe.report.document import Block, Callout, Document, Figure, Paragraph, Section, Table
from bampipe.results.lab import ControlChart, SessionVerdict, TrendsResult
from bampipe.results.standing import AT_FLOOR

_COLUMNS = 3
_MOST_PANELS = 12
_MOST_NAMES = 12


def build(folder: Path, pages: Mapping[str, str]) -> Report:
    """Return the report of the lab's folder.

    Args:
        folder: where ``trends.json`` and the tables are.
        pages: by session, the folder of its report as seen from there, where it has one.
    """
    trends = TrendsResult.read(folder / TrendsResult.FILE)
    with style.look():
        sections = [
            section
            for section in (
                _summary(trends, pages),
                *_charts(trends),
                _errors(folder, trends),
                _trials(folder),
            )
            if section is not None
        ]
    document = Document("All sessions", _subtitle(trends), tuple(sections))
    moments = [datetime.fromisoformat(one.recorded) for one in _dated(trends)]
    stamp = max((int(moment.timestamp()) for moment in moments), default=0)
    return Report.of(document, max(0, stamp))


def _dated(trends: TrendsResult) -> list[SessionVerdict]:
    return [one for one in trends.sessions if one.recorded]


def _subtitle(trends: TrendsResult) -> str:
    devices = sorted({one.device for one in trends.sessions})
    parts = [wording.count(len(trends.sessions), "session")]
    parts.append(f"device{'s' if len(devices) > 1 else ''} {join_names(devices)}")
    days = sorted({one.recorded[:10] for one in _dated(trends)})
    if days:
        parts.append(days[0] if len(days) == 1 else f"recorded {days[0]} to {days[-1]}")
    return ", ".join(parts)


def _summary(trends: TrendsResult, pages: Mapping[str, str]) -> Section:
    sessions = trends.sessions
    odd = [one for one in sessions if one.verdict != "in control"]
    blocks: list[Block] = []
    if not odd:
        judged = all(trends.verdict_in_words(one) == "in control" for one in sessions)
        title = "No session stands out" if judged else "Too few sessions for control limits"
        blocks.append(Callout("good" if judged else "note", title, _limits_in_words(trends)))
    for one in odd[:6]:
        remedy = f" To go on: `{one.remedy}`." if one.remedy else ""
        title = f"{one.session}: {one.verdict}"
        text = _sentence(one.sentence) + remedy
        blocks.append(
            Callout("unknown" if one.verdict == "not diagnosed" else "attention", title, text)
        )
    if len(odd) > 6:
        more = wording.count(len(odd) - 6, "session")
        blocks.append(Paragraph(f"Besides these, {more} in the table below."))
    rows = [
        (
            _linked(one.session, pages),
            one.recorded[:16].replace("T", " ") or "–",
            f"`{one.model}`",
            f"{wording.significant(one.worst[0])} ({one.worst[1]})" if one.worst else "–",
            ", ".join(moved.parameter for moved in one.moved) or "–",
            trends.verdict_in_words(one),
        )
        for one in sessions
    ]
    blocks.append(
        Table(
            "Sessions in the order of recording",
            (
                "Session",
                "Recorded (UTC)",
                "Model that counts",
                "Error / floor, worst axis",
                "Beyond its limits",
                "Verdict",
            ),
            tuple(rows),
            "lllrll",
            (0.0, 0.0, 1.2, 0.0, 1.0, 0.8),
            "Error of that model on unseen trials, over what sensors and filters leave.",
        )
    )
    return Section("Summary", tuple(blocks))


def _linked(session: str, pages: Mapping[str, str]) -> str:
    """Return the session's name with links to its pages."""
    if session not in pages:
        return session
    folder = pages[session]
    return f"[{session}]({folder}/report.html) ([explore]({folder}/explore.html))"


def _sentence(text: str) -> str:
    """Return ``text`` as a sentence; one that begins with a parameter's name leaves it as it is."""
    first = text.partition(" ")[0]
    return f"{text}." if "." in first else f"{text[:1].upper()}{text[1:]}."


def _limits_in_words(trends: TrendsResult) -> str:
    few = [c for c in trends.series if len(c.points) < trends.fewest_sessions]
    if few and len(few) == len(trends.series):
        return (
            f"Control limits need {trends.fewest_sessions} sessions of a device; until then "
            "only the diagnoses of single sessions count."
        )
    return "Every parameter lies within its control limits, and no diagnosis names an effect."


def _charts(trends: TrendsResult) -> list[Section]:
    sections = []
    devices = sorted({c.device for c in trends.series})
    for place, device in enumerate(devices, start=1):
        charts = [c for c in trends.series if c.device == device]
        title = "Parameters over time" + (f", {device}" if len(devices) > 1 else "")
        if all(len(chart.points) == 1 for chart in charts):
            text = f"One session of this device, {charts[0].points[0].session}: nothing to compare."
            sections.append(Section(title, (Paragraph(text),)))
            continue
        blocks: list[Block] = [
            Paragraph(
                "Each point is a session's estimate with two standard deviations, by the base "
                "model: that of later versions differs from session to session. The line is the "
                f"median.{_band_in_words(charts, trends.fewest_sessions)}"
            )
        ]
        blocks.append(_chart_table(charts))
        for start in range(0, len(charts), _MOST_PANELS):
            part = charts[start : start + _MOST_PANELS]
            number = f"-{start // _MOST_PANELS + 1}" if len(charts) > _MOST_PANELS else ""
            blocks.append(_picture(part, f"charts-{place}{number}"))
        sections.append(Section(title, tuple(blocks)))
    return sections


def _band_in_words(charts: list[ControlChart], fewest: int) -> str:
    if not any(chart.has_limits for chart in charts):
        return f" Control limits need {fewest} sessions of this device."
    return (
        " The band is the control limits: from the scatter between neighbouring sessions and each "
        "session's own uncertainty, so wide that a session of an unchanged device leaves them once "
        "in 370 times. Sessions beyond them are named."
    )


def _picture(charts: list[ControlChart], name: str) -> Figure:
    rows = -(-len(charts) // _COLUMNS)
    figure, panels = style.panels(rows, _COLUMNS, 1.75 * rows + 0.25)
    for panel, chart in zip(panels.ravel(), charts, strict=False):
        _panel(panel, chart)
    for panel in panels.ravel()[len(charts) :]:
        panel.set_axis_off()
    caption = "Parameters of the base model and stiffnesses, session by session."
    return Figure(name, caption, style.svg(figure))


def _panel(panel: Axes, chart: ControlChart) -> None:
    points = chart.points
    x = np.arange(len(points))
    y = np.array([point.estimate for point in points])
    error = 2.0 * np.array([point.sd for point in points])
    scale, unit = wording.scale(list(np.abs(y)), chart.unit)
    y, error = y * scale, error * scale
    panel.axhline(chart.centre * scale, color=style.FAINT, lw=0.9)
    shown = [y - error, y + error]
    if chart.has_limits:
        low = scale * np.array([point.lower for point in points], dtype=float)
        high = scale * np.array([point.upper for point in points], dtype=float)
        edges = np.concatenate([[-0.5], np.repeat(x[1:] - 0.5, 2), [len(x) - 0.5]])
        panel.fill_between(
            edges, np.repeat(low, 2), np.repeat(high, 2), color=style.SKY, alpha=0.22, lw=0
        )
        shown += [low, high]
    outside = np.array([point.outside_limits for point in points])
    for chosen, colour, mark in (
        (~outside, style.BLUE, "o"),
        (outside, style.VERMILLION, "D"),
    ):
        panel.errorbar(
            x[chosen], y[chosen], error[chosen], fmt=mark, ms=3.2, color=colour, elinewidth=0.8
        )
    middle = float(np.median(y))
    for place in np.flatnonzero(outside):
        above = y[place] > middle
        left = place > len(x) / 2
        panel.annotate(
            points[place].session, (x[place], y[place]), (-5 if left else 5, 0),
            textcoords="offset points", fontsize=7, color=style.VERMILLION,
            ha="right" if left else "left", va="center_baseline" if above else "center",
        )  # fmt: skip
    style.limits(panel, shown)
    panel.set_xlim(-0.5, len(x) - 0.5)
    _name_sessions(panel, [point.session for point in points])
    panel.set_title(wording.parameter(chart.name))
    panel.set_ylabel(unit)


def _name_sessions(panel: Axes, names: list[str]) -> None:
    """Name every n-th session below a panel, upright where names are long."""
    step = -(-len(names) // _MOST_NAMES)
    places = range(0, len(names), step)
    shown = [names[place] for place in places]
    long = sum(map(len, shown)) > 24
    panel.set_xticks(list(places), shown, rotation=90 if long else 0)
    panel.tick_params(axis="x", labelsize=6)


def _chart_table(charts: list[ControlChart]) -> Table:
    rows = []
    for chart in charts:
        sds = [point.sd for point in chart.points]
        within, centre = float(np.median(sds)), chart.centre
        slope, chance = chart.slope_per_session, chart.slope_p
        trend = "–"
        if slope is not None and centre:
            trend = f"{wording.significant(100.0 * slope / abs(centre), 2)} %"
            trend += f" (p {wording.probability(chance)})"
        outside = [point.session for point in chart.points if point.outside_limits]
        signs = [f"outside its limits: {', '.join(outside)}"] if outside else []
        if chart.drifts:
            signs.append("trend")
        if chart.run:
            signs.append(f"shift from {chart.run[0]} to {chart.run[1]}")
        rows.append(
            (
                wording.parameter(chart.name),
                # Without control limits nothing is known of the scatter that the centre has.
                wording.with_sd(centre, chart.between_sd or within)
                if chart.has_limits
                else wording.significant(centre),
                wording.unit(chart.unit),
                wording.significant(chart.between_sd, 2),
                wording.significant(within, 2),
                trend,
                "; ".join(signs) or "–",
            )
        )
    return Table(
        "Centre and scatter of each parameter",
        ("Parameter", "Centre", "Unit", "Between", "Within", "Trend a session", "Signs"),
        tuple(rows),
        "lrlrrrl",
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        "Between: scatter between sessions, the uncertainty within them taken out. Within: median "
        "standard deviation of a session's estimate. Trend: median slope (Theil and Sen), and how "
        "likely one so clear is by chance (Kendall).",
    )


def _errors(folder: Path, trends: TrendsResult) -> Section | None:
    frame = pd.read_parquet(folder / "errors")
    frame = frame[frame["error_over_floor"].notna()]
    if frame.empty:
        return None
    order = [one.session for one in trends.sessions]
    counting = {one.session: one.model for one in trends.sessions}
    sessions = [name for name in order if name in set(frame["session_id"])]
    axes = list(dict.fromkeys(frame["axis"]))
    columns = min(_COLUMNS, len(axes))
    rows = -(-len(axes) // columns)
    figure, panels = style.panels(rows, columns, 1.9 * rows + 0.35)
    for panel, axis in zip(panels.ravel(), axes, strict=False):
        here = frame[frame["axis"] == axis]
        base = here[here["model"] == "base"].set_index("session_id")["error_over_floor"]
        counts = here["model"] == here["session_id"].map(counting)
        extended = here[counts & (here["model"] != "base")].set_index("session_id")
        others = extended["error_over_floor"]
        place = {name: number for number, name in enumerate(sessions)}
        panel.axhspan(0.0, AT_FLOOR, color=style.GREEN, alpha=0.12, lw=0)
        for values, colour, mark, name in (
            (base, style.BLUE, "o", "base model"),
            (others, style.VERMILLION, "D", "model that counts, where extended"),
        ):
            x = [place[session] for session in values.index]
            panel.plot(x, values.to_numpy(), mark, ms=3.6, color=colour, label=name)
        panel.set_yscale("log")
        low, high = here["error_over_floor"].min(), here["error_over_floor"].max()
        panel.set_ylim(0.85 * min(1.0, low), 1.2 * max(high, 1.5))
        ticks = [t for t in (0.5, 1, 2, 5, 10, 20, 50, 100) if 0.85 * min(1.0, low) <= t]
        panel.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        panel.minorticks_off()
        panel.set_ylim(0.85 * min(1.0, low), 1.2 * max(high, 1.5))
        panel.set_xlim(-0.5, len(sessions) - 0.5)
        _name_sessions(panel, sessions)
        panel.set_title(axis)
        panel.set_ylabel("error / floor")
    for panel in panels.ravel()[len(axes) :]:
        panel.set_axis_off()
    style.legend_below(figure, panels[0][0])
    caption = "Error on unseen trials over the noise floor, session by session."
    text = (
        "The noise floor is what sensors and filters leave if the model is exactly right. In the "
        f"green band, below {AT_FLOOR:g}, a model leaves nothing that the session could show."
    )
    picture = Figure("errors", caption, style.svg(figure))
    return Section("Prediction", (Paragraph(text), picture))


def _trials(folder: Path) -> Section | None:
    frame = pd.read_parquet(folder / "quality")
    if frame.empty:
        return None
    odd = frame[frame["status"] != "ok"]
    sessions = wording.count(frame["session_id"].nunique(), "session")
    text = (
        f"{wording.count(len(frame), 'trial')} in {sessions}: "
        f"{int((frame['status'] == 'repaired').sum())} repaired, "
        f"{int((frame['status'] == 'set_aside').sum())} set aside."
    )
    blocks: list[Block] = [Paragraph(text)]
    if not odd.empty:
        rows = [
            (
                str(row["session_id"]),
                str(row["trial_id"]),
                wording.words(str(row["status"])),
                str(row["reason"] or row["repairs"] or "–"),
            )
            for row in odd.head(40).to_dict("records")
        ]
        note = f"{len(odd) - 40} more in the table `quality`." if len(odd) > 40 else ""
        blocks.append(
            Table(
                "Trials that were not sound as recorded",
                ("Session", "Trial", "Status", "What"),
                tuple(rows),
                "llll",
                (0.0, 0.0, 0.0, 1.0),
                note,
            )
        )
    return Section("Trials", tuple(blocks))
