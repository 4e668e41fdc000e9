"""The tables of docs/validation.md on measured machines, from what their scripts stored."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

STATED = 0.1
"""Effects with a lower probability are left out of the table."""


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


def per_cent(value: float | None) -> str:
    """One digit after the point."""
    return "–" if value is None else f"{value:.1f}"


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
    seen = write_rows(
        ["Hz", "apparent mass, kg", "delay, ms"],
        [
            [f"{x['hz']:.0f}", f"{x['mass_kg']:.1f}", f"{x['delay_ms']:.2f}"]
            for x in result["transfer"][::2]
        ],
    )
    said = ""
    if result["pulses"]:
        verdict = result["pulses"]["verdict"]
        named = state_probabilities(verdict["probabilities"])
        said = f"DATA_EMPS_PULSES alone: {verdict['verdict'].replace('_', ' ')}; {named}. "
    return (
        f"{write_rows(head, rows)}\n\nPublished, open loop, mm: {published}; force 5.98 %; closed"
        f" loop, position 0.0080 %, force 8.94 %.\n\n{said}From force to acceleration, the mean"
        f" over the pulses, without a model:\n\n{seen}"
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
    for steps, found in result["simulation"].items():
        rows.append([f"{steps} steps", *(number(x, 2) for x in found["normalised_rmse"])])
        rows.append(
            [f"{steps} steps, velocity kept", *(number(x, 2) for x in found["velocity_kept"])]
        )
    free = result["free_run"]
    rows.append(["free run", *(number(x, 2) for x in free["normalised_rmse"])])
    left = free["left_after_s"]
    told = (
        "stays within twice the range" if left is None else f"leaves twice the range at {left:g} s"
    )
    told += f"; its mean is {number(free['mean'])} until then" if left else ""
    note = f" {result['note'].capitalize()}." if result["note"] else ""
    added = ", ".join(f"`{e}`" for rung in result["choice"] for e in rung["added"])
    note += f" Chosen by validation, with {added}."
    return f"{write_rows(['', *axes], rows)}\n\nThe free run {told}.{note}"


def write_measured_sets(result: Mapping[str, Any]) -> str:
    """One row an axis."""
    rows: list[list[str]] = []
    for name, found in result.items():
        minutes = f"{found['seconds'] / 60.0:.1f}"
        if not found.get("axes"):
            rows.append([name, "", *["–"] * 4, found["note"].replace("|", "/"), minutes])
        for axis, x in found.get("axes", {}).items():
            named = state_probabilities(x["probabilities"])
            verdict = (x["verdict"] or found["note"]).replace("_", " ").replace("|", "/")
            rows.append([
                name, axis, *(per_cent(x[f"{k}_percent"]) for k in ("bare", "after")),
                per_cent(x["flexible_percent"]), number(x["floor_percent"], 2),
                f"{verdict}: {named}" if x["verdict"] else verdict, minutes,
            ])  # fmt: skip
            name = minutes = ""
    head = [
        "set",
        "axis",
        "bare, %",
        "after, %",
        "flexible, %",
        "floor, %",
        "verdict",
        "processor, min",
    ]
    return write_rows(head, rows)


def write_rivals(result: Mapping[str, Any]) -> str:
    """What other programs reach, and what they are for."""
    rows = []
    for name, x in result.items():
        reached = x["note"]
        if "open_loop_mm" in x:
            loop = x["open_loop_mm"]
            reached = f"EMPS, open loop: {number(loop['test'])} mm (train {number(loop['train'])})"
        for what, errors in x.get("held_out_percent", {}).items():
            reached += f" TX40, {what}: {' '.join(f'{e:.1f}' for e in errors)} %;"
        known = x.get("parameters", {})
        values = ", ".join(f"{n} {number(v, 4)}" for n, v in known.items()).replace("|", "\\|")
        rows.append([name, reached.strip(" ;"), values, f"{x['seconds']:.0f}", x["scope"]])
    return write_rows(["program", "error", "parameters", "CPU, s", "in its makers' words"], rows)
