"""How long work says how far it is."""

from typing import Protocol


class Progress(Protocol):
    """Called by a stage to say how far it is."""

    def __call__(self, fraction: float, message: str) -> None:
        """Report that ``fraction`` (0 to 1) is done; ``message`` says what is under way."""


def silent(fraction: float, message: str) -> None:
    """A :class:`Progress` that shows nothing."""
