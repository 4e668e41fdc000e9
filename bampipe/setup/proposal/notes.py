"""The comments of a proposal, which are printed once more for its reader, and TOML values."""

import json
from dataclasses import dataclass, field

from bampipe.lists import join_names

UNKNOWN = "?"
"""Stands for a column that could not be found."""
COLUMNS = "see the headers of the logs, or who wrote the logger"
"""Where the name of a column is looked up."""


@dataclass
class Notes:
    """What a person has to look at, collected while the tables are put together.

    Attributes:
        fill_in: what only a person can know, a sentence each.
        check: guesses, a sentence each.
        columns: inputs and axes that have no column, by what is missing of them: one question each.
    """

    fill_in: list[str] = field(default_factory=list)
    check: list[str] = field(default_factory=list)
    columns: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    @property
    def questions(self) -> list[str]:
        """What a person must fill in, each with where to look it up."""
        return self.fill_in + [
            f"{_column_of(names, *kind)}: {COLUMNS}" for kind, names in self.columns.items()
        ]

    def guess(self, text: str) -> str:
        """The comment that marks a guess; the same guess is listed once."""
        if text not in self.check:
            self.check.append(text)
        return f"  # guess: {text}"

    def ask_column(self, name: str, unit: str, what: str = "") -> str:
        """The comment on a column that could not be found: of an input, or ``what`` of an axis."""
        self.columns.setdefault((what, unit), []).append(name)
        return f"  # fill in: {_column_of([name], what, unit)}"

    def ask(self, text: str, where: str) -> str:
        """The comment that marks what a person must fill in, and where to look it up."""
        self.fill_in.append(f"{text}: {where}")
        return f"  # fill in: {text}"


def _column_of(names: list[str], what: str, unit: str) -> str:
    s = "s" if len(names) > 1 else ""
    whose = join_names(names, len(names))
    return f"the column{s} of {what and f'the {what}{s} of '}{whose}{unit and f' in {unit}'}"


def quoted(text: str) -> str:
    """``text`` as a TOML string."""
    return json.dumps(text, ensure_ascii=False)


def entry(column: str, unit: str, more: str = "") -> str:
    """An inline table that names a column and its unit; ``more`` follows, with a comma before."""
    return f'{{ column = {quoted(column)}, unit = "{unit}"{more} }}'
