"""Events of a run, for display."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Event:
    """An event of a run, for display.

    Attributes:
        run: name of the run folder.
        step: a stage, or ``stage:model``.
        kind: "waiting", "taken over", "compiling", "start", "progress", "done", "unchanged" or
            "failed".
        fraction: how much of the step is done, 0 to 1.
        message: the work in progress, the reason of the step, the fault, or the holder of the run
            folder.
    """

    run: str
    step: str
    kind: str
    fraction: float = 0.0
    message: str = ""


Listener = Callable[[Event], None]


def unheard(event: Event) -> None:
    """A listener that shows nothing."""
