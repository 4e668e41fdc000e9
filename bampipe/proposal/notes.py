"""The comments of a proposal, which are printed once more for its reader, and TOML values."""

from __future__ import annotations

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
        columns: what no column could be found for, by its unit: one question a unit.
    """

    fill_in: list[str] = field(default_factory=list)
    check: list[str] = field(default_factory=list)
    columns: dict[str, list[str]] = field(default_factory=dict)

    @property
    def questions(self) -> list[str]:
        """What a person must fill in, each with where to look it up."""
        missing = [
            f"the column{'s' if len(names) > 1 else ''} of {join_names(names, len(names))}"
            f"{unit and f' in {unit}'}: {COLUMNS}"
            for unit, names in self.columns.items()
        ]
        return self.fill_in + missing

    def guess(self, text: str) -> str:
        """The comment that marks a guess; the same guess is listed once."""
        if text not in self.check:
            self.check.append(text)
        return f"  # guess: {text}"

    def ask_column(self, name: str, unit: str) -> str:
        """The comment on a column that could not be found."""
        self.columns.setdefault(unit, []).append(name)
        return f"  # fill in: the column of {name}{unit and f' in {unit}'}"

    def ask(self, text: str, where: str) -> str:
        """The comment that marks what a person must fill in, and where to look it up."""
        self.fill_in.append(f"{text}: {where}")
        return f"  # fill in: {text}"


def quoted(text: str) -> str:
    """``text`` as a TOML string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\t", "\\t")
    return f'"{escaped}"'


def entry(column: str, unit: str, more: str = "") -> str:
    """An inline table that names a column and its unit; ``more`` follows, with a comma before."""
    return f'{{ column = {quoted(column)}, unit = "{unit}"{more} }}'


def bare(unit: str) -> str:
    """A unit without the brackets in which some files have it."""
    return unit.strip("[]()")
