"""The one exception that a user's mistake may raise."""

from functools import partial


class InputError(Exception):
    """A mistake in what the user gave: shown as one line, exit code 2, no traceback.

    Args:
        what: what is wrong, in the user's terms.
        where: file, row, column or field, as far as known.
        remedy: what the user can do about it.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what = what
        self.where = where
        self.remedy = remedy
        super().__init__(what, where, remedy)

    def __reduce__(self) -> tuple[object, ...]:
        """Rebuild from keywords too, so that it comes whole out of a worker process."""
        return partial(type(self), where=self.where, remedy=self.remedy), (self.what,)

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        text = f"{text}; {self.remedy}" if self.remedy else text
        return " ".join(text.split())
