"""The tables of docs/validation.md on measured machines, from what their scripts stored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

STATED = 0.5
"""Effects with a lower probability are left out of the table."""
SURE = 0.9
"""Probability from which something unknown is said to be missing."""
PUBLISHED_FREE_RUN = 0.64
"""Free run of the official set at 10 Hz, error over standard deviation, mean of six axes."""


def write_rows(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(map(str, line)) + " |" for line in (head, *rows)]
    return "\n".join([lines[0], "|-" * len(head) + "|", *lines[1:]])


def number(value: float | None, digits: int = 3) -> str:
    """So many significant digits, without an exponent where it is not needed."""
    if value is None:
        return "–"
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in text else text


def write_emps(result: Mapping[str, Any]) -> str:
    """The three tasks by effect, and what the pulses show."""
    head = [
        "model", "open loop, mm", "fitted to the free run, mm", "with the friction of the test, mm",
        "force, %", "closed loop, position, %", "closed loop, force, %",
    ]  # fmt: skip

    def row(name: str, rung: Mapping[str, Any]) -> list[str]:
        closed = rung.get("closed", {})
        return [
            name, number(rung["open_loop_mm"]["test"]), number(rung["open_loop_fitted_mm"]["test"]),
            number(rung["open_loop_friction_of_the_test_mm"]), f"{rung['inverse_percent']:.2f}",
            number(closed.get("position_percent"), 2), number(closed.get("force_percent")),
        ]  # fmt: skip

    rows = [row(f"and `{r['added']}`" if r["added"] else "bare", r) for r in result["rungs"]]
    if result["search"]:
        rows.append(row("as `extend --auto` leaves it", result["search"]["as_found"]))
    published = ", ".join(f"{name} {mm:g}" for name, mm in result["published_mm"].items())
    best = min(
        found["test"]
        for rung in result["rungs"]
        for found in (rung["open_loop_mm"], rung["open_loop_fitted_mm"])
        if found["test"] is not None
    )
    ahead = [name for name, mm in result["published_mm"].items() if mm < best]
    place = f"behind {', '.join(ahead)}" if ahead else "ahead of all"
    seen = "; ".join(
        f"{x['hz']:.0f} Hz {x['mass_kg']:.1f} kg, {x['delay_ms']:.2f} ms"
        for x in result["transfer"][::2]
    )
    said = ""
    if result["pulses"]:
        verdict = result["pulses"]["verdict"]
        named = state_probabilities(verdict["probabilities"])
        said = f"DATA_EMPS_PULSES alone: {verdict['verdict'].replace('_', ' ')}; {named}. "
    return (
        f"{write_rows(head, rows)}\n\nPublished, open loop, mm: {published}; force 5.98 %; closed"
        f" loop, position 0.0080 %, force 8.94 %. The least here, {number(best)} mm, chosen on"
        f" the test, is {place}.\n\n{said}Apparent mass and delay from force to"
        f" acceleration, the mean over the pulses without a model: {seen}."
    )


def state_probabilities(probabilities: Mapping[str, float]) -> str:
    """Effects and their probabilities, the most probable first."""
    stated = sorted((-p, name) for name, p in probabilities.items() if p >= STATED)
    return ", ".join(f"`{name}` {-p:.2f}" for p, name in stated) or "nothing named"


def write_kr300(result: Mapping[str, Any]) -> str:
    """Inverse dynamics, simulation and free run by axis."""
    axes = result["axes"]
    rows: list[list[str]] = []
    rows.append(
        ["test, torque, %, bare", *(number(result["inverse_percent_bare"][a], 2) for a in axes)]
    )
    rows.append(["test, torque, %", *(number(result["inverse_percent"][a], 2) for a in axes)])
    steps, found = max(result["simulation"].items(), key=lambda one: int(one[0]))
    simulated, kept = found["normalised_rmse"], found["velocity_kept"]
    rows.append([f"{steps} steps", *(number(x, 2) for x in simulated)])
    rows.append([f"{steps} steps, velocity kept", *(number(x, 2) for x in kept)])
    free, before, after = (
        result[key] for key in ("free_run", "inverse_percent_bare", "inverse_percent")
    )
    rows.append(["free run", *(number(x, 2) for x in free["normalised_rmse"])])
    left = free["left_after_s"]
    told = (
        "stays within twice the range" if left is None else f"leaves twice the range at {left:g} s"
    )
    told += f"; its mean is {number(free['mean'])} until then" if left else ""
    told += f" (published, another split: {PUBLISHED_FREE_RUN:g} over the whole)"
    worse = [axis for axis in axes if after[axis] > before[axis]]
    note = f" {result['note'].capitalize()}." if result["note"] else ""
    note += f" The effects raise the test's error on {', '.join(worse)}." if worse else ""
    lost = [axis for axis, error, best in zip(axes, simulated, kept, strict=True) if error > best]
    note += f" Keeping the velocity is better on {', '.join(lost)}." if lost else ""
    added = ", ".join(f"`{e}`" for rung in result["choice"] for e in rung["added"])
    note += f" Chosen by validation, with {added}."
    return f"{write_rows(['', *axes], rows)}\n\nThe free run {told}.{note}"


def write_measured_sets(result: Mapping[str, Any]) -> str:
    """One row a set, with the values of its axes in order; sets that did not run stand below."""
    rows, refused = [], []
    for name, found in result.items():
        axes = [*found.get("axes", {}).values()]
        if not axes:
            refused.append(f"{name} ({found['note']})")
            continue
        said = found["note"]
        if done := all(x["verdict"] for x in axes):
            counts = Counter(map(_state_verdict, axes)).items()
            said = ", ".join(f"{n} × {each}" if len(axes) > 1 else each for each, n in counts)
        known = {effect: p for x in axes for effect, p in x["probabilities"].items()}
        added = [effect for _, effects in found.get("ladder", ()) for effect in effects]
        rows.append([
            name, _list_errors(axes, "bare"), _list_errors(axes, "after") if done else "–",
            _list_errors(axes, "flexible"), _list_errors(axes, "floor"), said,
            ", ".join(f"`{e}`" + (f" {known[e]:.2f}" if e in known else "") for e in added),
            f"{found['seconds'] / 60.0:.1f}",
        ])  # fmt: skip
    head = [
        "set", "bare, %", "after, %", "regression, %", "floor, %", "verdict", "added", "CPU, min"
    ]  # fmt: skip
    left = f"\n\nRefused until their user answers: {'; '.join(refused)}." if refused else ""
    return write_rows(head, rows) + left


def _list_errors(axes: Sequence[Mapping[str, Any]], which: str) -> str:
    """One of the errors of each axis, per cent."""
    return " ".join(number(x[f"{which}_percent"]) for x in axes) or "–"


def _state_verdict(axis: Mapping[str, Any]) -> str:
    """The verdict on an axis, and whether something unknown is missing beside effects."""
    verdict = str(axis["verdict"]).replace("_", " ")
    beside = verdict != "unknown effect" and (axis["unknown"] or 0.0) >= SURE
    return f"{verdict} and unknown" if beside else verdict


def write_rivals(
    result: Mapping[str, Any], emps: Mapping[str, Any], sets: Mapping[str, Any]
) -> str:
    """What other programs reach; bampipe's own numbers come first."""
    loop = emps["rungs"][0]["open_loop_fitted_mm"]
    reached = f"EMPS, open loop, bare: {number(loop['test'])} mm (train {number(loop['train'])})"
    if arm := sets.get("staubli_tx40", {}).get("axes"):
        reached += f"; TX40, after: {_list_errors([*arm.values()], 'after')} %"
    mass, _ = emps["rungs"][0]["parameters"]["mass"]
    rows = [["bampipe, as above", reached, number(mass), ""]]
    for name, x in result.items():
        reached = x["note"]
        if "open_loop_mm" in x:
            loop = x["open_loop_mm"]
            reached = f"EMPS, open loop: {number(loop['test'])} mm (train {number(loop['train'])})"
        for what, errors in x.get("held_out_percent", {}).items():
            reached += f" TX40, {what}: {' '.join(f'{e:.1f}' for e in errors)} %;"
        mass = x.get("parameters", {}).get("mass")
        rows.append([name, reached.strip(" ;"), number(mass), f"{x['seconds']:.0f}"])
    return write_rows(["program", "error", "EMPS, mass, kg", "CPU, s"], rows)
