"""Progress of a run as events."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Event:
    """An event of the run of a folder called ``run``.

    Attributes:
        step: a stage, or ``stage:model``.
        kind: "waiting", "taken over", "compiling", "start", "progress", "done", "unchanged" or
            "failed".
        fraction: completed fraction of the step, 0 to 1.
        message: current work, reason of the step, fault, or holder of the run folder.
    """

    run: str
    step: str
    kind: str
    fraction: float = 0.0
    message: str = ""


Listener = Callable[[Event], None]


def ignore_event(event: Event) -> None:
    """A listener that shows nothing."""
