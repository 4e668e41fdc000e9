"""Which session drifted, and why: the device itself, or an effect that its model lacks.

A parameter of the base model is charted over all sessions, since only the same model can be
compared. For a session beyond the limits, its diagnosis decides. If nothing is missing, the
parameter itself moved. A missing effect biases the parameters: if the parameter is back within the
limits in the session's own model with that effect, the device has not changed.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from bampipe.data.run_folder import BASE
from bampipe.lab.control_chart import FEWEST_SESSIONS, make_chart
from bampipe.lists import join_names
from bampipe.phrases import lab as phrases
from bampipe.results.lab import (
    ChartPoint,
    ControlChart,
    MovedParameter,
    SessionVerdict,
    TrendsResult,
)

TableRow = Mapping[str, Any]
Tables = Mapping[str, Sequence[TableRow]]

IN_CONTROL = "in control"
DEVICE = "device drifted"
EFFECT = "missing effect"
BOTH = "device drifted, and missing effect"
UNKNOWN = "not diagnosed"


def build_trends(tables: Tables) -> TrendsResult:
    """Return charts of stiffness and of the base models' parameters, and verdicts on the sessions.

    Args:
        tables: rows of the lab's tables, sessions in the order of their recording.
    """
    found: dict[tuple[str, str, str], list[tuple[str, float, float]]] = {}
    bases = (r for r in tables.get("parameters", ()) if r["model"] == BASE)
    rows = [(r, r["parameter"], r["estimate"]) for r in bases]
    rows += [(r, f"stiffness.{r['axis']}", r["stiffness"]) for r in tables.get("stiffness", ())]
    for row, name, value in rows:
        entry = (row["session_id"], value, row["sd"])
        found.setdefault((row["device"], name, row["unit"]), []).append(entry)
    charts = [make_chart(*key, entries) for key, entries in sorted(found.items())]
    return TrendsResult(
        schema="bampipe.trends/1",
        fewest_sessions=FEWEST_SESSIONS,
        series=tuple(charts),
        sessions=tuple(_judge_session(row, tables, charts) for row in tables["sessions"]),
    )


def _judge_session(row: TableRow, tables: Tables, charts: Sequence[ControlChart]) -> SessionVerdict:
    session, device, model = row["session_id"], row["device"], row["counting_model"]
    mine = {
        name: [r for r in tables.get(name, ()) if r["session_id"] == session]
        for name in ("parameters", "errors", "verdicts")
    }
    errors = [r for r in mine["errors"] if r["model"] == model]
    ratios = [(r["error_over_floor"], r["axis"]) for r in errors]
    named = [effect for r in mine["verdicts"] for effect in r["effects"]]
    first = [r for r in mine["verdicts"] if r["model"] == BASE]
    last = [r for r in mine["verdicts"] if r["model"] == model]
    outside = {
        chart: point
        for chart in charts
        for point in chart.points
        if chart.device == device and point.session == session and point.outside_limits
    }
    moved = []
    for chart, point in outside.items():
        by, about = point.estimate - chart.centre, {"parameter": chart.name}
        percent = 100.0 * by / abs(chart.centre) if chart.centre else None
        moved.append(MovedParameter.of(chart, point, **about, percent=percent))
    judged = SessionVerdict(
        session=session,
        device=device,
        model=model,
        recorded=row["recorded_at"].isoformat() if row["recorded_at"] is not None else "",
        verdict=IN_CONTROL,
        moved=tuple(moved),
        effects=tuple(dict.fromkeys(named if first else row["effects"])),
        unexplained=tuple(r["axis"] for r in last or first if r["verdict"] == "unknown_effect"),
        diagnosed=bool(last),
        worst=max((one for one in ratios if one[0] is not None), default=None),
        above_floor=any(r["standing"] == "above_floor" for r in errors),
        sentence="",
        remedy="",
    )
    if outside:
        found = _explain_shift(judged, outside, mine)
    else:
        limited = any(one.device == device and one.has_limits for one in charts)
        found = _explain_model(judged, mine["verdicts"], row["effects"], limited)
    verdict, sentence, remedy = found
    return judged.model_copy(update={"verdict": verdict, "sentence": sentence, "remedy": remedy})


def _explain_model(
    judged: SessionVerdict, verdicts: Sequence[TableRow], present: Sequence[str], limited: bool
) -> tuple[str, str, str]:
    """Return verdict, sentence and remedy of a session whose parameters are within their limits.

    Args:
        present: effects of the model that counts; limited: whether its device has control limits.
    """
    if lacking := _list_missing(judged, verdicts, present):
        limits = "; no parameter is beyond its limits" if limited else ""
        return EFFECT, f"lacks {join_names(lacking)}{limits}", ""
    if not judged.diagnosed and judged.worst and judged.above_floor:
        error = f"error on unseen trials {judged.worst[0]:.3g} times the floor on {judged.worst[1]}"
        said = f"{error}: something is missing, and no diagnosis has been made"
        return UNKNOWN, said, _diagnose_command(judged)
    if unjudged := _list_unjudged(judged, verdicts):
        return UNKNOWN, f"no verdict on {unjudged}", f"bampipe report {judged.session}"
    return IN_CONTROL, "", ""


def _explain_shift(
    judged: SessionVerdict,
    outside: Mapping[ControlChart, ChartPoint],
    mine: Mapping[str, Sequence[TableRow]],
) -> tuple[str, str, str]:
    """Return verdict, sentence and remedy of a session with parameters beyond their limits."""
    verdicts, moved = mine["verdicts"], phrases.list_moved(judged.moved)
    lacking = _list_missing(judged, verdicts)
    if not lacking:
        if unjudged := _list_unjudged(judged, verdicts):
            return UNKNOWN, f"{moved}; no verdict on {unjudged}", f"bampipe report {judged.session}"
        if judged.diagnosed:
            return DEVICE, f"{moved}; its diagnosis finds nothing missing: the device changed", ""
        return UNKNOWN, f"{moved}; no diagnosis has been made", _diagnose_command(judged)
    back, still = _split_moved(judged, outside, mine)
    sentence = phrases.describe_shift(moved, lacking, back, still)
    remedy = "" if back or still else f"bampipe extend {judged.session} --auto, then bampipe lab"
    return BOTH if still else EFFECT, sentence, remedy


def _split_moved(
    judged: SessionVerdict,
    outside: Mapping[ControlChart, ChartPoint],
    mine: Mapping[str, Sequence[TableRow]],
) -> tuple[list[str], list[str]]:
    """Return the parameters for which the missing effect accounts, and those beyond it.

    With a model that has the effect, its estimates decide; without one, the effect accounts neither
    for a parameter of an axis on which nothing is missing, nor for a stiffness.
    """
    models = {r["model"] for r in mine["parameters"]} - {BASE}
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
    for chart, point in outside.items():
        if row := child.get(chart.name):
            inside = _is_within(chart, point, row["estimate"], row["sd"])
            (back if inside else still).append(chart.name)
        elif chart.name.startswith("stiffness.") or chart.name.rpartition(".")[2] in clean:
            still.append(chart.name)
    return back, still


def _diagnose_command(judged: SessionVerdict) -> str:
    return f"bampipe diagnose {judged.session} --model {judged.model}"


def _list_missing(
    judged: SessionVerdict, verdicts: Sequence[TableRow], present: Sequence[str] = ()
) -> list[str]:
    """Return the missing effects that no model has, in words; unknown ones, too."""
    # On an axis that is undecided one phrase names all its effects.
    undecided = [row for row in verdicts if row["verdict"] == "undecided"]
    words = {effect: row["named"] for row in undecided for effect in row["effects"]}
    said = [words.get(effect, effect) for effect in judged.effects if effect not in present]
    last = _select_verdicts(judged, undecided)
    said += [row["named"] for row in last if not row["effects"]]
    unknown = (f"something unknown on {axis}" for axis in judged.unexplained)
    return [*dict.fromkeys(said), *unknown]


def _list_unjudged(judged: SessionVerdict, verdicts: Sequence[TableRow]) -> str:
    last = _select_verdicts(judged, verdicts)
    return join_names(row["axis"] for row in last if row["verdict"] == "no_verdict")


def _select_verdicts(judged: SessionVerdict, verdicts: Sequence[TableRow]) -> list[TableRow]:
    """Return the verdicts on the model that counts; on the base model where it has none."""
    model = judged.model if judged.diagnosed else BASE
    return [row for row in verdicts if row["model"] == model]


def _is_within(chart: ControlChart, point: ChartPoint, value: float, sd: float) -> bool:
    """Return whether ``value``, in place of the estimate at ``point``, lies inside the limits."""
    between, upper = chart.between_sd or 0.0, point.upper or 0.0
    variance = between**2 + point.sd**2
    ratio = (between**2 + sd**2) / variance if variance > 0.0 else 1.0
    return abs(value - chart.centre) <= (upper - chart.centre) * math.sqrt(ratio)
