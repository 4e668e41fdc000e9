"""What happens in a run, for whoever shows it."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Event:
    """Something that happened in a run, for whoever shows it.

    Attributes:
        run: name of the run folder.
        step: a stage, or ``stage:model``.
        kind: "waiting", "taken over", "compiling", "start", "progress", "done", "unchanged" or
            "failed".
        fraction: how much of the step is done, 0 to 1.
        message: what is under way, why the step runs, what went wrong, or who holds or held the
            run folder.
    """

    run: str
    step: str
    kind: str
    fraction: float = 0.0
    message: str = ""


Listener = Callable[[Event], None]


def unheard(event: Event) -> None:
    """A listener that shows nothing."""
