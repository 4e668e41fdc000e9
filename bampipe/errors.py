"""The one exception that a user's mistake may raise, and text that is safe to show."""

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Self


def printable(text: str) -> str:
    """Return ``text`` with what no screen or document should obey written out, such as ``\\x1b``.

    Names, columns and sentences come out of files that others wrote: control characters would
    move the cursor or colour the screen, marks of writing direction would show another order,
    and halves of surrogate pairs (bytes of a file name that are no UTF-8) cannot be encoded.
    Line breaks and tabulators stay.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


class InputError(Exception):
    """A mistake in the user's input: shown as one line, exit code 2, no traceback.

    Args:
        what: what is wrong, in the user's terms.
        where: file, row, column or field, as far as known.
        remedy: what the user can do about it.
        others: further mistakes in the same file.
    """

    def __init__(
        self, what: str, *, where: str = "", remedy: str = "", others: Sequence[Self] = ()
    ) -> None:
        self.what = what
        self.where = where
        self.remedy = remedy
        self.others = tuple(others)
        super().__init__(what, where, remedy)

    def __reduce__(self) -> tuple[object, ...]:
        """Rebuild from keywords too, so that it comes whole out of a worker process."""
        whole = partial(type(self), where=self.where, remedy=self.remedy, others=self.others)
        return whole, (self.what,)

    def lines(self) -> list[str]:
        """Return every mistake, a line each."""
        alone = InputError(self.what, where=self.where, remedy=self.remedy)
        return [str(alone), *(line for other in self.others for line in other.lines())]

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        text += f" (and {len(self.others)} more)" if self.others else ""
        if self.remedy:
            remedy = self.remedy
            asks = text.endswith("?")
            text += f" {remedy[:1].upper()}{remedy[1:]}" if asks else f"; {remedy}"
        return printable(" ".join(text.split()))


@contextmanager
def located(place: str, joint: str = ", ") -> Iterator[None]:
    """Name a place, such as a file, before what an `InputError` from within says of its own.

    It is named once.
    """
    try:
        yield
    except InputError as error:
        if not f"{error.where}:".startswith((f"{place}:", f"{place},")):
            error.where = joint.join(filter(None, (place, error.where)))
        raise


class MissingResultError(InputError):
    """A required result does not exist yet: a stage was requested too early."""


class NothingToDoError(InputError):
    """These results leave the requested stage nothing to do."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``, did you mean 'x'?`` for the closest of ``known``, or nothing if none is close."""
    lowered = {str(name).lower(): name for name in known}
    close = difflib.get_close_matches(word.lower(), lowered, n=1)
    return f", did you mean '{lowered[close[0]]}'?" if close else ""


def choose_from(word: str, known: Iterable[str]) -> str:
    """Return as a remedy the closest of ``known``, or all of them if none is close."""
    names = sorted(known)
    nearest = did_you_mean(word, names).removeprefix(", ")
    return nearest or (f"choose from {', '.join(names)}" if names else "")
