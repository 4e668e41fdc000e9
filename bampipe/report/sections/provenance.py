"""Provenance: inputs by hash, versions, settings and keys, last of all.

Nothing here depends on when or where the stages ran: equal results give equal reports. Times and
the machine are in ``run.json``, and ``bampipe status`` prints them.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

from bampipe.report.document import Block, Subheading, Table
from bampipe.report.run_results import Results
from bampipe.results.run import RunResult, StepRecord

TITLE = "Provenance"
_DIGITS = 12


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield versions, files, stages and settings."""
    run = results.read(RunResult)
    if run is None:
        yield "This run folder has no run.json, so its provenance is not known."
        return
    stages = {name: made for name, made in run.stages.items() if name != "report"}
    every = sorted({pair for made in stages.values() for pair in made.versions.items()})
    names = groupby(every, key=lambda pair: pair[0])
    shown = ", ".join(f"{n} {' and '.join(version for _, version in some)}" for n, some in names)
    text = f"Made with {shown}. " if shown else ""
    yield f"{text}Full hashes are in `run.json`; equal inputs and versions give equal results."
    read = stages["ingest"].inputs if "ingest" in stages else {}
    yield Table(
        f"Files that were read (first {_DIGITS} digits of their hash)",
        "File :code | Hash :code",
        [(name, digest[:_DIGITS]) for name, digest in read.items()],
    )
    ordered = _order_stages(stages)
    yield Table(
        "Stages",
        "Stage :code | >Files | Key :code",
        [(name, str(len(made.outputs)), made.key[:_DIGITS]) for name, made in ordered],
        "Key: hash of everything on which the stage depends (inputs, settings, code, versions). "
        "`bampipe status` says when each ran, and for how long.",
    )
    if settings := _tabulate_settings(ordered):
        yield Subheading("Settings")
        yield settings


def _order_stages(stages: Mapping[str, StepRecord]) -> list[tuple[str, StepRecord]]:
    """Return the steps, a stage before those that read its outputs."""
    made_by = {name: step for step, made in stages.items() for name in made.outputs}
    ranks: dict[str, int] = {}

    def rank(step: str) -> int:
        if step not in ranks:
            ranks[step] = 0  # a record that was tampered with may be circular
            before = {made_by.get(name, step) for name in stages[step].inputs} - {step}
            ranks[step] = 1 + max(map(rank, before), default=0)
        return ranks[step]

    return sorted(stages.items(), key=lambda item: (rank(item[0]), item[0]))


def _tabulate_settings(stages: Sequence[tuple[str, StepRecord]]) -> Table | None:
    models: dict[tuple[str, str], list[str]] = {}
    for name, made in stages:
        stage, _, model = name.partition(":")
        config = {key: value for key, value in made.config.items() if key != "model"}
        shown = ", ".join(f"{key} = {_format_value(value)}" for key, value in config.items())
        if shown:
            models.setdefault((stage, shown), []).append(model)
    if not models:
        return None
    alike = {stage: sum(stage == other for other, _ in models) == 1 for stage, _ in models}
    rows = [
        (f"`{stage}`" if alike[stage] else ", ".join(f"`{stage}:{name}`" for name in names), shown)
        for (stage, shown), names in models.items()
    ]
    title = "Settings of each stage, for all models where none is named"
    return Table(title, "Stage | Settings ~1", rows)


def _format_value(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_format_value(item) for item in value) + "]"
    return str(value)
