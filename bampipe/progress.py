"""Progress reports of long work."""

from typing import Protocol


class Progress(Protocol):
    """A callback with which a stage reports its progress."""

    def __call__(self, fraction: float, message: str) -> None:
        """Report that ``fraction`` (0 to 1) is done; ``message`` names the work in progress."""


def silent(fraction: float, message: str) -> None:
    """A :class:`Progress` that shows nothing."""
