"""The comments of a proposal, which are printed once more for its reader, and TOML values."""

import json
from dataclasses import dataclass, field

from bampipe.lists import join_names
from bampipe.setup.sentences import SENTENCES

UNKNOWN = "?"
"""Stands for a column that could not be found."""


@dataclass
class Notes:
    """What a person has to look at, collected while the tables are put together.

    Attributes:
        fill_in: of what something only a person can know is asked, by question and where to look.
        check: guesses, a sentence each.
    """

    fill_in: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    check: list[str] = field(default_factory=list)

    @property
    def questions(self) -> list[str]:
        """What a person must fill in, each with where to look it up."""
        return [
            f"{text.replace('{}', join_names(of, len(of)))}. To find it: {where}"
            for (text, where), of in self.fill_in.items()
        ]

    def guess(self, text: str) -> str:
        """The comment that marks a guess; the same guess is listed once."""
        if text not in self.check:
            self.check.append(text)
        return f"  # guess: {text}"

    def ask_column(self, name: str, unit: str, question: str = "column") -> str:
        """The comment on a column that could not be found, of what has that ``name``."""
        return self.ask(question, name, unit=unit and f" in {unit}")

    def ask(self, question: str, of: str = "", **known: object) -> str:
        """The comment that marks what a person must fill in.

        Args:
            question: its name in ``sentences.toml``, which says where to look it up, too.
            of: the item that the question concerns; a question about several is asked once.
            known: the other fields of its text.
        """
        own = SENTENCES[question]
        text, where = (own[part].format(of="{}", **known) for part in ("ask", "where"))
        self.fill_in.setdefault((text, where), []).append(of)
        return f"  # fill in: {text.replace('{}', of)}"


def quoted(text: str) -> str:
    """``text`` as a TOML string."""
    return json.dumps(text, ensure_ascii=False)


def entry(column: str, unit: str, more: str = "") -> str:
    """An inline table that names a column and its unit; ``more`` follows, with a comma before."""
    return f'{{ column = {quoted(column)}, unit = "{unit}"{more} }}'
