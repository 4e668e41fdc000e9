"""Which session drifted, and why: the device itself, or an effect that its model lacks.

A parameter of the base model is charted over all sessions, since only the same model can be
compared. A session beyond the limits is then asked what its diagnosis says. Nothing missing: the
parameter itself moved. An effect missing: it biases the parameters, so the parameter is looked up
in the session's own model with that effect; back within the limits, the device has not changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bampipe.lab.control_chart import FEWEST, Chart, chart
from bampipe.lists import join_names
from bampipe.results.lab import (
    ChartPoint,
    ControlChart,
    MovedParameter,
    SessionVerdict,
    TrendsResult,
)
from bampipe.run.models import BASE

TableRow = Mapping[str, Any]

IN_CONTROL = "in control"
DEVICE = "device drifted"
EFFECT = "missing effect"
BOTH = "device drifted, and missing effect"
UNKNOWN = "not diagnosed"


@dataclass(frozen=True)
class Series:
    """One quantity of one device over its sessions.

    Attributes:
        device: the device.
        name: parameter of the base model, or ``stiffness.<axis>``.
        unit: its unit.
        sessions: session ids in the order of recording.
        estimates: one a session.
        sds: their standard deviations.
        chart: the control chart.
    """

    device: str
    name: str
    unit: str
    sessions: tuple[str, ...]
    estimates: tuple[float, ...]
    sds: tuple[float, ...]
    chart: Chart

    def within(self, session: str, value: float, sd: float) -> bool:
        """Whether ``value``, in place of the estimate of ``session``, lies inside the limits."""
        place = self.sessions.index(session)
        room = (self.chart.upper[place] - self.chart.centre) ** 2
        widened = float(room * _ratio(self.chart.between_sd, sd, self.sds[place])) ** 0.5
        return bool(abs(value - self.chart.centre) <= widened)


def _ratio(between: float, sd: float, old: float) -> float:
    variance = between**2 + old**2
    return (between**2 + sd**2) / variance if variance > 0.0 else 1.0


def series(tables: Mapping[str, Sequence[TableRow]]) -> list[Series]:
    """Return the charts of every parameter of the base models, and of every stiffness.

    Args:
        tables: rows of the lab's tables, sessions in the order of their recording.
    """
    found: dict[tuple[str, str, str], list[tuple[str, float, float]]] = {}
    for row in tables.get("parameters", ()):
        if row["model"] == BASE and row["estimate"] is not None:
            key = (str(row["device"]), str(row["parameter"]), str(row["unit"] or ""))
            entry = (str(row["session_id"]), float(row["estimate"]), float(row["sd"] or 0.0))
            found.setdefault(key, []).append(entry)
    for row in tables.get("stiffness", ()):
        if row["stiffness"] is not None:
            key = (str(row["device"]), f"stiffness.{row['axis']}", str(row["unit"] or ""))
            entry = (str(row["session_id"]), float(row["stiffness"]), float(row["sd"] or 0.0))
            found.setdefault(key, []).append(entry)
    charts = []
    for (device, name, unit), entries in sorted(found.items()):
        ids, values, sds = zip(*entries, strict=True)
        charts.append(Series(device, name, unit, ids, values, sds, chart(values, sds)))
    return charts


def judge_sessions(
    tables: Mapping[str, Sequence[TableRow]], charts: Sequence[Series]
) -> list[SessionVerdict]:
    """Return the verdict on each session, in the order of recording.

    Args:
        tables: rows of the lab's tables.
        charts: what :func:`series` returns for them.
    """
    return [_judge_session(row, tables, charts) for row in tables["sessions"]]


def _judge_session(
    row: TableRow, tables: Mapping[str, Sequence[TableRow]], charts: Sequence[Series]
) -> SessionVerdict:
    session, device, model = str(row["session_id"]), str(row["device"]), row["counting_model"]
    when = row["recorded_at"]
    mine = {
        name: [r for r in tables.get(name, ()) if r["session_id"] == session]
        for name in ("parameters", "errors", "verdicts")
    }
    errors = [r for r in mine["errors"] if r["model"] == model]
    ratios = [
        (float(r["error_over_floor"]), str(r["axis"]))
        for r in errors
        if r["error_over_floor"] is not None
    ]
    named = [effect for r in mine["verdicts"] for effect in r["effects"]]
    first = [r for r in mine["verdicts"] if r["model"] == BASE]
    last = [r for r in mine["verdicts"] if r["model"] == model]
    outside = [c for c in charts if c.device == device and _is_outside(c, session)]
    judged = SessionVerdict(
        session=session,
        device=device,
        model=model,
        recorded=when.isoformat() if when is not None else "",
        verdict=IN_CONTROL,
        moved=tuple(_moved(c, session) for c in outside),
        effects=tuple(dict.fromkeys(named if first else row["effects"])),
        unexplained=tuple(r["axis"] for r in last or first if r["verdict"] == "unknown_effect"),
        diagnosed=bool(last),
        worst=max(ratios, default=None),
        above_floor=any(r["standing"] == "above_floor" for r in errors),
        sentence="",
        remedy="",
    )
    limited = any(c.device == device and len(c.sessions) >= FEWEST for c in charts)
    verdict, sentence, remedy = _decide(judged, outside, mine, row["effects"], limited)
    return judged.model_copy(update={"verdict": verdict, "sentence": sentence, "remedy": remedy})


def _is_outside(c: Series, session: str) -> bool:
    return session in c.sessions and bool(c.chart.outside_limits[c.sessions.index(session)])


def _moved(c: Series, session: str) -> MovedParameter:
    value, centre = c.estimates[c.sessions.index(session)], c.chart.centre
    percent = 100.0 * (value - centre) / abs(centre) if centre else None
    return MovedParameter(
        parameter=c.name, estimate=value, centre=centre, percent=percent, unit=c.unit
    )


def _decide(
    judged: SessionVerdict,
    outside: Sequence[Series],
    mine: Mapping[str, Sequence[TableRow]],
    has: Sequence[str],
    limited: bool,
) -> tuple[str, str, str]:
    """Return verdict, sentence and remedy.

    ``has``: effects of the model that counts; ``limited``: whether its device has control limits.
    """
    diagnose = f"bampipe diagnose {judged.session} --model {judged.model}"
    last = _last(judged, mine["verdicts"])
    unjudged = join_names(row["axis"] for row in last if row["verdict"] == "no_verdict")
    if not outside:
        if lacking := _named(judged, mine["verdicts"], has):
            limits = "; no parameter is beyond its limits" if limited else ""
            return EFFECT, f"lacks {join_names(lacking)}{limits}", ""
        if not judged.diagnosed and judged.worst and judged.above_floor:
            sentence = (
                f"error on unseen trials {judged.worst[0]:.3g} times the floor on "
                f"{judged.worst[1]}: something is missing, not yet asked what"
            )
            return UNKNOWN, sentence, diagnose
        if unjudged:
            return UNKNOWN, f"no verdict on {unjudged}", f"bampipe report {judged.session}"
        return IN_CONTROL, "", ""
    what = join_names(_named(judged, mine["verdicts"]))
    moved = ", ".join(_in_words(entry) for entry in judged.moved)
    if not what:
        if unjudged:
            return UNKNOWN, f"{moved}; no verdict on {unjudged}", f"bampipe report {judged.session}"
        if judged.diagnosed:
            return DEVICE, f"{moved}; its diagnosis finds nothing missing: the device changed", ""
        return UNKNOWN, f"{moved}; whether an effect is missing has not been asked", diagnose
    back, still = _with_the_effect(judged, outside, mine)
    if still:
        sentence = (
            f"{moved}; lacks {what}, which does not account for {', '.join(still)}: the device "
            "changed too"
        )
        return BOTH, sentence, ""
    if back:
        sentence = (
            f"{moved}; with {what} in the model {'they are' if len(back) > 1 else 'it is'} back "
            "within the limits: the device has not changed"
        )
        return EFFECT, sentence, ""
    remedy = f"bampipe extend {judged.session} --auto, then bampipe lab"
    return EFFECT, f"{moved}; lacks {what}, which biases the parameters", remedy


def _named(
    judged: SessionVerdict, verdicts: Sequence[TableRow], has: Sequence[str] = ()
) -> list[str]:
    """Return what is missing in words, but for what a model ``has``; unknowns, too."""
    # On an axis that is undecided one phrase speaks of all its effects.
    words = {
        effect: row["named"]
        for row in verdicts
        for effect in row["effects"]
        if row["verdict"] == "undecided"
    }
    said = [words.get(effect, effect) for effect in judged.effects if effect not in has]
    said += [
        row["named"]
        for row in _last(judged, verdicts)
        if row["verdict"] == "undecided" and not row["effects"]
    ]
    unknown = (f"something unknown on {axis}" for axis in judged.unexplained)
    return [*dict.fromkeys(said), *unknown]


def _last(judged: SessionVerdict, verdicts: Sequence[TableRow]) -> list[TableRow]:
    """Return the verdicts on the model that counts; on the base model where it has none."""
    model = judged.model if judged.diagnosed else BASE
    return [row for row in verdicts if row["model"] == model]


def _with_the_effect(
    judged: SessionVerdict, outside: Sequence[Series], mine: Mapping[str, Sequence[TableRow]]
) -> tuple[list[str], list[str]]:
    """Return which parameters the missing effect brings back, and which it cannot account for.

    With a model that has the effect, its estimates decide; without one, a parameter of an axis on
    which nothing is missing, or a stiffness (which no model enters), counts as unaccounted for.
    """
    models = {str(r["model"]) for r in mine["parameters"]} - {BASE}
    largest = max(models, key=lambda name: (name.count("+"), name), default="")
    chosen = judged.model if judged.model != BASE else largest
    child = {r["parameter"]: r for r in mine["parameters"] if r["model"] == chosen}
    clean = {
        r["axis"]
        for r in mine["verdicts"]
        if r["model"] == BASE and r["verdict"] == "nothing_missing"
    }
    back: list[str] = []
    still: list[str] = []
    for c in outside:
        row = child.get(c.name)
        if row is not None and row["estimate"] is not None:
            inside = c.within(judged.session, float(row["estimate"]), float(row["sd"] or 0.0))
            (back if inside else still).append(c.name)
        elif c.name.startswith("stiffness.") or c.name.rpartition(".")[2] in clean:
            still.append(c.name)
    return back, still


def _in_words(moved: MovedParameter) -> str:
    if moved.percent is None:
        return f"{moved.parameter} {moved.estimate:.4g} {moved.unit}"
    return f"{moved.parameter} {moved.percent:+.2g} %".replace("-", "−")


def build_trends(charts: Sequence[Series], judged: Sequence[SessionVerdict]) -> TrendsResult:
    """Return charts and verdicts as ``trends.json`` holds them."""
    return TrendsResult(
        schema="bampipe.trends/1",
        fewest_sessions=FEWEST,
        series=tuple(_chart(c) for c in charts),
        sessions=tuple(judged),
    )


def _chart(c: Series) -> ControlChart:
    known = len(c.sessions) >= FEWEST
    k = c.chart
    return ControlChart(
        device=c.device,
        name=c.name,
        unit=c.unit,
        centre=k.centre,
        between_sd=k.between_sd if known else None,
        slope_per_session=k.slope if known else None,
        slope_p=k.slope_p if known else None,
        drifts=k.drifts,
        run=None if k.run is None else (c.sessions[k.run[0]], c.sessions[k.run[1]]),
        points=tuple(
            ChartPoint(
                session=session,
                estimate=c.estimates[i],
                sd=c.sds[i],
                lower=k.lower[i] if known else None,
                upper=k.upper[i] if known else None,
                outside_limits=k.outside_limits[i],
            )
            for i, session in enumerate(c.sessions)
        ),
    )
