"""Progress reports of long work."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction that is done, 0 to 1, and a message that names the work in progress."""


def silent(fraction: float, message: str) -> None:
    """A `Progress` that shows nothing."""
