"""Output of the commands: results on standard output, progress and errors on standard error."""

import json
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from bampipe.errors import InputError, printable
from bampipe.progress import Progress
from bampipe.report.document import Table, strip_marks
from bampipe.report.wording import break_lines
from bampipe.run.events import Event

if TYPE_CHECKING:
    from bampipe.results.compare import Rung
    from bampipe.run.request import Outcome

LARGEST_TABLE = 40
WIDEST_CELL = 60
MOST_TRIALS = 10
QUIET_S = 10.0
"""Off a terminal, a long step prints a line this often."""
FIRST_COLUMNS = (
    *("", "trial_id", "estimate", "sd", "unit", "rmse", "held_out_rmse", "noise_floor"),
    *("verdict", "rmse_before", "rmse_after", "noise_floor_after"),
    *("effect", "axis", "held_out_rmse_before", "held_out_rmse_after"),
    *("probability", "p_value"),
)
"""Order of the tables, for a new summary and for one read from the run folder."""


def format_cell(value: object) -> str:
    """Return a cell: four significant digits for a number, plain words for the rest."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_cell(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(format_cell(item) for item in value) or "–"
    return printable(str(value))


class OutputClosedError(Exception):
    """The reader has closed the output; no OSError, which typer would make a failed gate."""


def write_line(line: str) -> None:
    """Print a line on standard output, at once.

    Raises:
        OutputClosedError: its reader has closed it, as ``| head`` does.
    """
    try:
        print(line, flush=True)
    except BrokenPipeError as error:
        raise OutputClosedError from error


def say(text: str) -> None:
    """Print a line for a person on standard output."""
    write_line(printable(text))


def note(text: str) -> None:
    """Print a line on standard error."""
    print(printable(text), file=sys.stderr, flush=True)


def print_json(content: object) -> None:
    """Print ``content`` as JSON on standard output."""
    write_line(json.dumps(content, sort_keys=True, indent=1, ensure_ascii=False))


def page(path: Path) -> None:
    """Open a page in the user's browser; InputError if none can be started."""
    import webbrowser

    if not webbrowser.open(path.resolve().as_uri()):
        remedy = "open the file in a browser yourself, or name one in the variable BROWSER"
        raise InputError("no browser could be started", where=str(path), remedy=remedy)


def print_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table: text to the left, broken where it is long, numbers to the right, no rules."""
    raw = [list(row) for row in rows]
    last = len(head) - 1  # nothing follows it, so it may be of any length
    # Names of models, and of several effects, are long.
    lines = [
        [
            [cell] if column == last else break_lines(cell, WIDEST_CELL, "+ ").split("\n")
            for column, cell in enumerate(map(format_cell, row))
        ]
        for row in (head, *raw)
    ]
    forms = []
    for column in range(len(head)):
        is_number = bool(raw) and all(isinstance(row[column], int | float | None) for row in raw)
        width = max(len(part) for row in lines for part in row[column])
        forms.append(f"{'>' if is_number else '<'}{width}")
    for row in lines:
        for parts in zip_longest(*row, fillvalue=""):
            say("  " + "  ".join(map(format, parts, forms)).rstrip())


_Scalar = str | int | float | None


def _read_rows(value: object) -> list[dict[str, Any]]:
    """Return a table of named records, or a list of records, as rows; none if it is neither."""
    if isinstance(value, Mapping) and all(isinstance(item, Mapping) for item in value.values()):
        return [{"": name, **item} for name, item in sorted(value.items())]
    if isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
        return [dict(item) for item in value]
    return []


def _flatten(row: Mapping[str, Any], deep: bool) -> dict[str, Any]:
    """Return the columns of a record: scalars and, if ``deep``, tables of them key by key."""
    shown: dict[str, Any] = {name: row[name] for name in FIRST_COLUMNS if name in row}
    for name, value in row.items():
        if isinstance(value, _Scalar):
            shown[name] = value
        elif deep and isinstance(value, Mapping):
            items = {f"{name} {key}": item for key, item in value.items()}
            shown |= items if all(isinstance(item, _Scalar) for item in items.values()) else {}
        elif isinstance(value, list) and all(isinstance(item, str) for item in value):
            shown[name] = ", ".join(value)
    shown.pop("sentence", None)
    return shown


def print_summary(content: Mapping[str, object]) -> None:
    """Print the findings of a stage: its headline, then its tables.

    Args:
        content: the summary of a stage. ``headline`` is a line; ``axes``, ``parameters``,
            ``directions``, ``trials``, ``ranking`` and ``ladder`` are tables; ``notes`` are lines.
    """
    _print_lines(content, "setup", "set-up")
    if isinstance(content.get("headline"), str):
        say(str(content["headline"]))
    for name in ("axes", "parameters", "directions", "trials", "ranking"):
        rows = [_flatten(row, name == "ranking") for row in _read_rows(content.get(name))]
        head = list(dict.fromkeys(column for row in rows for column in row))
        if len(head) > 1 and len(rows) <= LARGEST_TABLE:
            say(f"\n{name}")
            titles = [column.replace("_", " ") for column in head]
            print_table(titles, [[row.get(column) for column in head] for row in rows])
    if "ladder" in content:
        from bampipe.results.compare import CompareResult

        compared = CompareResult.model_validate(content)
        _print_ladder(compared.ladder)
        _print_model(compared.best)
    for row in (*_read_rows(content.get("axes")), *_read_rows(content.get("moved"))):
        if isinstance(row.get("sentence"), str):
            say(str(row["sentence"]))
    _print_trials(content)
    _print_lines(content, "failed_checks", "check failed")
    if content.get("notes"):
        say("")
    _print_lines(content, "notes", "note")


def _print_lines(content: Mapping[str, object], name: str, word: str) -> None:
    found = content.get(name)
    for line in found if isinstance(found, list) else ():
        say(f"{word}: {line}")


def _print_trials(content: Mapping[str, object]) -> None:
    """Print which trials were set aside, and the repairs and notes of others, a line each."""
    for name, word, reason in (
        ("set_aside", "set aside", "reason"),
        ("repaired", "note", "repairs"),
    ):
        rows = _read_rows(content.get(name))
        for row in rows[:MOST_TRIALS]:
            say(f"{word}: {row['trial_id']}: {row[reason]}")
        if len(rows) > MOST_TRIALS:
            say(f"{word}: {len(rows) - MOST_TRIALS} trials more; `bampipe ingest --json` lists all")


def _print_ladder(rungs: "Sequence[Rung]") -> None:
    """Print one row a model version: its held-out error over the noise floor, axis by axis."""
    axes = list(dict.fromkeys(axis for rung in rungs for axis in rung.held_out_rmse))
    rows = []
    for number, rung in enumerate(rungs):
        version = f"version {number}: " if number else ""  # as the tables below name it
        cells = [version + rung.model, rung.added or ""]
        for axis in axes:
            error, floor = rung.held_out_rmse.get(axis), rung.noise_floor.get(axis)
            cells += [format_cell(error), format_cell(error / floor) if error and floor else ""]
        rows.append(cells)
    units = rungs[0].unit
    heads = (head for axis in axes for head in (f"{axis}, {units.get(axis, '')}", "/ floor"))
    say("\nladder: error on held-out trials, and over its noise floor")
    print_table(["model", "added", *heads], rows)
    if any(rung.free_run or rung.drift for rung in rungs):
        # matplotlib is slow to import: only here
        from bampipe.report.sections.ladder import tabulate_runs

        for table in tabulate_runs(rungs, axes):
            print_block(table)


def print_block(table: Table) -> None:
    """Print a table of a report, with its caption above and its note below."""
    say(f"\n{table.caption}")
    rows = [list(map(strip_marks, row)) for row in table.rows]
    print_table([column.title for column in table.read_columns()], rows)
    if table.note:
        say(table.note)


def print_outcome(result: "Outcome") -> None:
    """Print the steps of a run and its gates, after the mistakes of the set-up."""
    for step in result.steps:
        _print_lines(step.summary, "setup", "set-up")
    rows = []
    for step in result.steps:
        took = f"{step.seconds:.1f} s" if step.state == "done" else ""
        headline = step.summary.get("headline")
        rows.append([step.step, step.state, took, headline if isinstance(headline, str) else ""])
    if rows:
        print_table(["step", "state", "time", ""], rows)
    for step in result.steps:
        _print_trials(step.summary)
        if step.step in ("ingest", "filter"):
            _print_lines(step.summary, "notes", "note")
        influence = step.summary.get("influence")
        worst = influence.get("worst_second") if isinstance(influence, dict) else None
        if worst and worst.get("sentence"):
            say(f"note: {worst['sentence']}")
    shown = [verdict for verdict in result.verdicts if verdict.state != "absent"]
    if shown:
        say("")
        cells = [[one.gate, one.model, one.key, one.state, one.message] for one in shown]
        print_table(["gate", "model", "", "verdict", ""], cells)
    if result.model and any(":" in step.step for step in result.steps):
        _print_model(result.model)


def print_advice(command: str, quiet: bool = False, json: bool = False) -> None:
    """Print the command to go on with, unless the output is quiet or JSON."""
    if not quiet and not json:
        say(f"\nnext: {command}")


def _print_model(model: str) -> None:
    say(f"\nmodel that counts: {model}; --model selects another")


UNDER_WAY: dict[str, str] = {}
"""By run: the step that has started and not ended, or ""."""


class Watcher:
    """Shows the events of a run on standard error: a bar on a terminal, else lines.

    Args:
        quiet: show nothing.
        several: name the run in each line.
    """

    def __init__(self, quiet: bool, several: bool = False) -> None:
        self.quiet = quiet
        self.several = several
        self.bars: Any = None
        self.tasks: dict[str, Any] = {}
        self.lines: dict[str, tuple[float, float, Event]] = {}
        self.lock, self.over = threading.Lock(), threading.Event()

    def __enter__(self) -> Self:
        if not self.quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            self.bars = Progress(
                # Names of sessions and trials are text: no markup of rich's.
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=30),
                TimeElapsedColumn(),
                TextColumn("{task.fields[message]}", markup=False),
                console=Console(stderr=True),
                transient=True,
            )
            self.bars.start()
        elif not self.quiet:

            def keep_writing() -> None:
                while not self.over.wait(1.0):
                    self.write_late_lines()

            threading.Thread(target=keep_writing, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        if self.bars is not None:
            self.bars.stop()

    def __call__(self, event: Event) -> None:
        """Show one event."""
        name = f"{event.run}: {event.step}" if self.several else event.step
        if event.kind in ("start", "done", "unchanged", "failed"):
            UNDER_WAY[event.run] = event.step if event.kind == "start" else ""
        if self.quiet:
            return
        if event.kind == "waiting":
            holder = event.message or "another run"
            note(f"bampipe: {holder} is at work in {event.run}; waiting for it")
        elif event.kind == "taken over":
            note(f"bampipe: {event.message} was killed in {event.run}; going on from there")
        elif event.kind == "compiling":
            note("bampipe: the numerical code is compiled now, once for this machine")
        elif self.bars is None:
            self._write(event, name)
        else:
            self._draw(event, name)

    def follow(self, run: str, step: str) -> Progress:
        """Return the progress callback of a step."""
        return lambda fraction, message: self(Event(run, step, "progress", fraction, message))

    def _write(self, event: Event, name: str) -> None:
        """A line where a step starts, and one every so often while it goes on."""
        with self.lock:
            now = time.monotonic()
            if event.kind == "start":
                note(f"{name} ({event.message})" if event.message else name)
            if event.kind in ("start", "progress"):
                started, written, _ = self.lines.get(name, (now, now, event))
                self.lines[name] = (started, written, event)
            else:
                self.lines.pop(name, None)
        self.write_late_lines()

    def write_late_lines(self) -> None:
        """Write a line on each step that has had none for some time."""
        with self.lock:
            for name, (started, written, event) in self.lines.items():
                now = time.monotonic()
                if now - written >= QUIET_S:
                    self.lines[name] = (started, now, event)
                    percent = f"{100.0 * event.fraction:.0f} %, {now - started:.0f} s"
                    said = event.message if event.kind == "progress" else ""
                    note(f"{name}: {percent}, {said}".removesuffix(", "))

    def _draw(self, event: Event, name: str) -> None:
        if event.kind in ("start", "progress"):
            if name not in self.tasks:
                self.tasks[name] = self.bars.add_task(name, total=1.0, message="")
            message = printable(event.message)
            self.bars.update(self.tasks[name], completed=event.fraction, message=message)
        elif name in self.tasks:
            self.bars.remove_task(self.tasks.pop(name))
