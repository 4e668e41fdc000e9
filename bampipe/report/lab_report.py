"""The report over all sessions of a lab: verdicts, control charts, errors, trials."""

from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from bampipe.lists import count_noun, join_names
from bampipe.phrases import lab as phrases
from bampipe.report import style
from bampipe.report.build import Report
from bampipe.report.document import Block, Callout, Document, Section, Table, Tone
from bampipe.report.wording import (
    choose_scale,
    format_digits,
    format_p_value,
    name_parameter,
    split_name,
)
from bampipe.results.floor import AT_FLOOR
from bampipe.results.lab import ControlChart, SessionVerdict, TrendsResult

_PANEL_COLUMNS = 3
_MOST_PANELS = 12
_MOST_NAMES = 12
_MOST_CALLOUTS = 6
_MOST_TRIALS = 40


def build_lab_report(folder: Path, pages: Mapping[str, str]) -> Report:
    """Return the report of the lab's folder.

    Args:
        folder: where ``trends.json`` and the tables are.
        pages: by session with a report, the folder of the report, relative to that folder.
    """
    trends = TrendsResult.read(folder / TrendsResult.FILE)
    with style.use_style():
        sections = [_summarise(trends, pages), *_show_charts(trends)]
        sections += [*_show_errors(folder, trends), *_show_trials(folder)]
    devices = sorted({one.device for one in trends.sessions})
    parts = [count_noun(len(trends.sessions), "session")]
    parts.append(f"device{'s' * (len(devices) > 1)} {join_names(devices)}")
    moments = [one.recorded for one in trends.sessions if one.recorded]
    if days := sorted({moment[:10] for moment in moments}):
        parts.append(days[0] if len(days) == 1 else f"recorded {days[0]} to {days[-1]}")
    document = Document("All sessions", ", ".join(parts), tuple(sections))
    stamps = (int(datetime.fromisoformat(moment).timestamp()) for moment in moments)
    return Report.from_document(document, max(0, *stamps, 0))


def _summarise(trends: TrendsResult, pages: Mapping[str, str]) -> Section:
    odd = [one for one in trends.sessions if one.verdict != "in control"]
    verdicts = {one.session: phrases.verdict(trends, one) for one in trends.sessions}
    blocks: list[Block] = list(map(_show_session, odd[:_MOST_CALLOUTS]))
    if not odd:
        judged = all(verdict == "in control" for verdict in verdicts.values())
        title = "No session stands out" if judged else "Too few sessions for control limits"
        text = "Every parameter lies within its control limits, and no diagnosis names an effect."
        if trends.series and not any(one.has_limits for one in trends.series):
            text = (
                f"Control limits need {trends.fewest_sessions} sessions of a device; until then "
                "only the diagnoses of single sessions count."
            )
        blocks.append(Callout("good" if judged else "note", title, text))
    if len(odd) > _MOST_CALLOUTS:
        more = count_noun(len(odd) - _MOST_CALLOUTS, "more session")
        blocks.append(f"The table below has {more} that stand out.")
    links = {
        session: f"[{session}]({folder}/report.html) ([explore]({folder}/explore.html))"
        for session, folder in pages.items()
    }
    rows = [
        (
            *(links.get(one.session, one.session), one.recorded[:16].replace("T", " ") or None),
            *(one.model, f"{format_digits(one.worst[0])} ({one.worst[1]})" if one.worst else None),
            *(", ".join(moved.parameter for moved in one.moved) or None, verdicts[one.session]),
        )
        for one in trends.sessions
    ]
    columns = (
        "Session | Recorded (UTC) | Best confirmed model :code ~1.2 | >Error / floor, worst axis"
        " | Beyond its limits ~1 | Verdict ~0.8"
    )
    note = "Error of that model on unseen trials over the noise floor of sensors and filters."
    blocks.append(Table("Sessions in the order of recording", columns, rows, note))
    return Section("Summary", tuple(blocks))


def _show_session(one: SessionVerdict) -> Callout:
    sentence = one.sentence
    if "." not in sentence.partition(" ")[0]:  # else it begins with the name of a parameter
        sentence = sentence[:1].upper() + sentence[1:]
    remedy = f" Next: `{one.remedy}`." if one.remedy else ""
    tone: Tone = "unknown" if one.verdict == "not diagnosed" else "attention"
    return Callout(tone, f"{one.session}: {one.verdict}", f"{sentence}.{remedy}")


def _show_charts(trends: TrendsResult) -> Iterator[Section]:
    devices = sorted({one.device for one in trends.series})
    for place, device in enumerate(devices, start=1):
        charts = [one for one in trends.series if one.device == device]
        title = "Parameters over time" + f", {device}" * (len(devices) > 1)
        if all(len(chart.points) == 1 for chart in charts):
            name = charts[0].points[0].session
            text = f"This device has one session, {name}: there is nothing to compare."
            yield Section(title, (text,))
            continue
        text = (
            "Each point is the estimate of a session with two standard deviations, for the base "
            "model: later versions differ from session to session. The line is the median. "
        ) + (
            "The band is the control limits, computed from the scatter between neighbouring "
            "sessions and from the uncertainty of each session: a session of an unchanged device "
            "lies beyond them once in 370 times. Sessions beyond them are named."
            if any(chart.has_limits for chart in charts)
            else f"Control limits need {trends.fewest_sessions} sessions of this device."
        )
        blocks: list[Block] = [text, _tabulate_charts(charts)]
        for start in range(0, len(charts), _MOST_PANELS):
            part = charts[start : start + _MOST_PANELS]
            number = f"-{start // _MOST_PANELS + 1}" if len(charts) > _MOST_PANELS else ""
            figure, panels = style.make_grid(len(part), _PANEL_COLUMNS, 1.75, extra=0.25)
            for panel, chart in zip(panels, part, strict=True):
                _draw_chart(panel, chart)
            caption = "Parameters of the base model and stiffnesses, session by session."
            blocks.append(style.finish(figure, f"charts-{place}{number}", caption))
        yield Section(title, tuple(blocks))


def _draw_chart(panel: Axes, chart: ControlChart) -> None:
    points = chart.points
    x = np.arange(len(points))
    y = np.array([point.estimate for point in points])
    scale, unit = choose_scale(list(np.abs(y)), chart.unit)
    y, error = y * scale, 2.0 * scale * np.array([point.sd for point in points])
    panel.axhline(chart.centre * scale, color=style.FAINT, lw=0.9)
    shown = [y - error, y + error]
    if chart.has_limits:
        limits = scale * np.array([(one.lower, one.upper) for one in points], dtype=float)
        low, high = np.repeat(limits, 2, axis=0).T
        edges = np.concatenate([[-0.5], np.repeat(x[1:] - 0.5, 2), [len(x) - 0.5]])
        panel.fill_between(edges, low, high, color=style.SKY, alpha=0.22, lw=0)
        shown += [low, high]
    outside = np.array([point.outside_limits for point in points])
    for chosen, colour, mark in ((~outside, style.BLUE, "o"), (outside, style.VERMILLION, "D")):
        panel.errorbar(
            x[chosen], y[chosen], error[chosen], fmt=mark, ms=3.2, color=colour, elinewidth=0.8
        )
    middle = float(np.median(y))
    for place in np.flatnonzero(outside):
        left = place > len(x) / 2
        panel.annotate(
            points[place].session, (x[place], y[place]), (-5 if left else 5, 0),
            textcoords="offset points", fontsize=7, color=style.VERMILLION,
            ha="right" if left else "left",
            va="center_baseline" if y[place] > middle else "center",
        )  # fmt: skip
    style.set_limits(panel, shown)
    _name_sessions(panel, [point.session for point in points])
    panel.set(title=name_parameter(chart.name), ylabel=unit)


def _name_sessions(panel: Axes, names: list[str]) -> None:
    """Name every n-th session below a panel, vertically if names are long."""
    places = range(0, len(names), -(-len(names) // _MOST_NAMES))
    shown = [names[place] for place in places]
    panel.set_xlim(-0.5, len(names) - 0.5)
    panel.set_xticks(list(places), shown, rotation=90 if sum(map(len, shown)) > 24 else 0)
    panel.tick_params(axis="x", labelsize=6)


def _tabulate_charts(charts: list[ControlChart]) -> Table:
    rows = []
    for chart in charts:
        within, centre = float(np.median([point.sd for point in chart.points])), chart.centre
        trend = None
        if chart.slope_per_session is not None and centre:
            slope = format_digits(100.0 * chart.slope_per_session / abs(centre), 2)
            trend = f"{slope} % (p {format_p_value(chart.slope_p)})"
        # Without control limits the scatter of the centre is not known.
        shown = (centre, chart.between_sd or within) if chart.has_limits else centre
        signs = "; ".join(phrases.list_signs(chart)) or None
        rows.append((chart.name, shown, chart.unit, chart.between_sd, within, trend, signs))
    return Table(
        "Centre and scatter of each parameter",
        "Parameter :name | >Centre | Unit :unit | >Between :2 | >Within :2 | >Trend a session"
        " | Signs ~1",
        rows,
        "Between: scatter between sessions, without the uncertainty within them. Within: median "
        "standard deviation of a session's estimate. Trend: median slope (Theil and Sen), and the "
        "probability of so clear a trend by chance (Kendall).",
    ).drop_empty_columns()


def _show_errors(folder: Path, trends: TrendsResult) -> Iterator[Section]:
    frame = pd.read_parquet(folder / "errors")
    frame = frame[frame["error_over_floor"].notna()]
    if frame.empty:
        return
    model_of = {one.session: one.model for one in trends.sessions}
    with_error = set(frame["session_id"])
    sessions = [one.session for one in trends.sessions if one.session in with_error]
    axes = list(dict.fromkeys(frame["axis"]))
    counts = (frame["model"] == frame["session_id"].map(model_of)) & (frame["model"] != "base")
    figure, panels = style.make_grid(len(axes), _PANEL_COLUMNS, 1.9)
    for panel, axis in zip(panels, axes, strict=True):
        panel.axhspan(0.0, AT_FLOOR, color=style.GREEN, alpha=0.12, lw=0)
        for chosen, colour, mark, name in (
            (frame["model"] == "base", style.BLUE, "o", "base model"),
            (counts, style.VERMILLION, "D", "best confirmed model, if extended"),
        ):
            part = frame[chosen & (frame["axis"] == axis)]
            x = [sessions.index(session) for session in part["session_id"]]
            panel.plot(x, part["error_over_floor"], mark, ms=3.6, color=colour, label=name)
        values = frame[frame["axis"] == axis]["error_over_floor"]
        style.use_decades(panel, [1.0, AT_FLOOR, *values])
        _name_sessions(panel, sessions)
        panel.set(title=axis, ylabel="error / floor")
    caption = "Error on unseen trials over the noise floor, session by session."
    text = (
        "The noise floor is the error that sensors and filters leave if the model is exactly "
        f"right. In the green band, below {AT_FLOOR:g}, only a diagnosis can find a further effect."
    )
    picture = style.finish(figure, "errors", caption, panels[:1])
    yield Section("Prediction", (text, picture))


def _show_trials(folder: Path) -> Iterator[Section]:
    frame = pd.read_parquet(folder / "quality")
    if frame.empty:
        return
    odd = frame[frame["status"] != "ok"]
    sessions = count_noun(frame["session_id"].nunique(), "session")
    text = (
        f"{count_noun(len(frame), 'trial')} in {sessions}: "
        f"{int((frame['status'] == 'repaired').sum())} repaired, "
        f"{int((frame['status'] == 'set_aside').sum())} set aside."
    )
    rows = [
        (one.session_id, one.trial_id, split_name(one.status), one.reason or one.repairs or None)
        for one in odd.head(_MOST_TRIALS).itertuples()
    ]
    more = len(odd) - _MOST_TRIALS
    note = f"{more} more in the table `quality`." if more > 0 else ""
    title = "Trials that were not sound as recorded"
    table = Table(title, "Session | Trial | Status | Reason ~1", rows, note)
    yield Section.gather("Trials", (text, table))
