"""Provenance: inputs by hash, versions, settings and timings, on the last page."""

from __future__ import annotations

from typing import Any

from bampipe.report import wording
from bampipe.report.document import Block, Bullets, Section, Subheading, Table, Text
from bampipe.report.results import Results

TITLE = "Provenance"
_DIGITS = 12


def section(results: Results) -> Section:
    """Return the section."""
    content = results.json("run.json")
    if content is None:
        text = "This run folder has no run.json: what was run on what is not recorded."
        return Section(TITLE, (Text(text),), new_page=True)
    stages: dict[str, Any] = content.get("stages", {})
    blocks: list[Block] = [Text(_versions(content, stages))]
    inputs = _inputs(stages)
    if inputs is not None:
        blocks.append(inputs)
    blocks.append(_stages(stages, content.get("timings", {})))
    failures = content.get("failures") or {}
    if failures:
        blocks.append(
            Bullets(
                tuple(f"`{name}` failed when last tried: {why}" for name, why in failures.items())
            )
        )
    settings = _settings(stages)
    if settings is not None:
        blocks += [Subheading("Settings"), settings]
    return Section(TITLE, tuple(blocks), new_page=True)


def _versions(content: dict[str, Any], stages: dict[str, Any]) -> str:
    versions = content.get("versions") or {}
    if not versions:
        versions = next((made["versions"] for made in stages.values() if made.get("versions")), {})
    shown = ", ".join(f"{name} {version}" for name, version in sorted(versions.items()))
    text = f"Made with {shown}." if shown else ""
    machine = (content.get("place") or {}).get("machine")
    if machine:
        text += f" Machine: {machine}."
    return f"{text} Full hashes are in `run.json`; equal inputs and versions give equal results."


def _inputs(stages: dict[str, Any]) -> Table | None:
    ingest = stages.get("ingest", {}).get("inputs") or {}
    if not ingest:
        return None
    rows = tuple((f"`{name}`", f"`{str(digest)[:_DIGITS]}`") for name, digest in ingest.items())
    return Table(
        f"Files that were read (first {_DIGITS} digits of their hash)",
        ("File", "Hash"),
        rows,
        "ll",
    )


def _stages(stages: dict[str, Any], timings: dict[str, Any]) -> Table:
    rows = []
    order = sorted(stages, key=lambda name: str(timings.get(name, {}).get("started_at", "")))
    for name in order:
        if name == "report":
            continue
        made = stages[name]
        timing = timings.get(name, {})
        seconds = timing.get("seconds")
        rows.append(
            (
                f"`{name}`",
                str(timing.get("started_at", "–")).replace("T", " ").removesuffix("+00:00"),
                "–" if seconds is None else wording.plain(float(seconds), 1),
                str(len(made.get("outputs") or ())),
                f"`{str(made.get('key') or '–')[:_DIGITS]}`",
            )
        )
    return Table(
        "Stages",
        ("Stage", "Started (UTC)", "Seconds", "Files", "Key"),
        tuple(rows),
        "llrrl",
        note="Key: hash of everything the stage depends on (inputs, settings, code, versions).",
    )


def _settings(stages: dict[str, Any]) -> Table | None:
    rows = []
    for name, made in stages.items():
        values = made.get("config") or {}
        shown = ", ".join(f"{key} = {_value(value)}" for key, value in values.items())
        if shown and name != "report":
            rows.append((f"`{name}`", shown))
    if not rows:
        return None
    return Table("Settings of each stage", ("Stage", "Settings"), tuple(rows), "ll", (0.0, 1.0))


def _value(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return str(value)
