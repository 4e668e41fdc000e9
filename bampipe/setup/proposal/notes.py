"""The comments of a proposal, which are printed once more for its reader, and TOML values."""

import json
from dataclasses import dataclass, field

from bampipe.lists import join_names

UNKNOWN = "?"
"""Stands for a column that could not be found."""
COLUMNS = "see the headers of the logs, or ask who wrote the logger"
"""Where the name of a column is looked up."""
UNITS = "ask who wrote the logger, or see how far it moves; rad, deg, m and mm are usual"
"""Where the unit of a position is."""

_SPELLED = {
    "in": "inches", "m": "metres", "mm": "millimetres", "rad": "radians", "deg": "degrees",
    "rev": "turns", "s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds",
}  # fmt: skip


@dataclass
class Notes:
    """What a person has to look at, collected while the tables are put together.

    Attributes:
        fill_in: of what something only a person can know is asked, by question and where to look.
        check: guesses, a sentence each.
        columns: inputs and axes that have no column, by what is missing of them: one question each.
        units: columns that look like the positions of axes, by those: one question for their unit.
    """

    fill_in: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    check: list[str] = field(default_factory=list)
    columns: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)

    @property
    def questions(self) -> list[str]:
        """What a person must fill in, each with where to look it up."""
        unit = [f"{_unit_of(self.units)}. To find it: {UNITS}"] if self.units else []
        columns = (
            f"{_column_of(names, *kind)}. To find it: {COLUMNS}"
            for kind, names in self.columns.items()
        )
        asked = (
            f"{text.replace('{}', join_names(of))}. To find it: {where}"
            for (text, where), of in self.fill_in.items()
        )
        return [*asked, *unit, *columns]

    def guess(self, text: str) -> str:
        """The comment that marks a guess; the same guess is listed once."""
        if text not in self.check:
            self.check.append(text)
        return f"  # guess: {text}"

    def ask_column(self, name: str, unit: str, what: str = "") -> str:
        """The comment on a column that could not be found: of an input, or ``what`` of an axis."""
        self.columns.setdefault((what, unit), []).append(name)
        return f"  # fill in: {_column_of([name], what, unit)}"

    def ask_unit(self, column: str, axis: str) -> str:
        """The comment on a column that looks like the position of ``axis`` and has no unit."""
        self.units[axis] = column
        return f"  # fill in: {_unit_of({axis: column})}"

    def ask(self, text: str, where: str, of: str = "") -> str:
        """The comment that marks what a person must fill in, and where to look it up.

        What is asked ``of`` several, which {} stands for in the text, becomes one question.
        """
        self.fill_in.setdefault((text, where), []).append(of)
        return f"  # fill in: {text.replace('{}', of)}"


def _column_of(names: list[str], what: str, unit: str) -> str:
    s = "s" if len(names) > 1 else ""
    whose = join_names(names, len(names))
    return f"the column{s} of {what and f'the {what}{s} of '}{whose}{unit and f' in {unit}'}"


def _unit_of(units: dict[str, str]) -> str:
    look, s = ("look", "s") if len(units) > 1 else ("looks", "")
    columns, axes = join_names(units.values()), join_names(units)
    return f"the unit of {columns}, which {look} like the position{s} of {axes}"


def say_unit(name: str) -> str:
    """The name of a unit in a sentence."""
    return _SPELLED.get(name, name)


def quoted(text: str) -> str:
    """``text`` as a TOML string."""
    return json.dumps(text, ensure_ascii=False)


def entry(column: str, unit: str, more: str = "") -> str:
    """An inline table that names a column and its unit; ``more`` follows, with a comma before."""
    return f'{{ column = {quoted(column)}, unit = "{unit}"{more} }}'
