"""Which trials a fit may see, which are left out together, and which count in the verdict."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

HELD_OUT = -1
"""Group of the trials that the session holds out."""
MOST_GROUPS = 10
"""With more trials than this, they are left out in so many groups: the cost of leaving each out
alone grows with the square of their number."""


@dataclass(frozen=True)
class Folds:
    """How the trials of a session are held out.

    Attributes:
        groups: number of the group of each trial; those of a group are left out together, those
            in `HELD_OUT` are never fitted.
        fitted: whether a fit may see each trial.
        judged: whether each trial counts in the held-out error.
    """

    groups: tuple[int, ...]
    fitted: tuple[bool, ...]
    judged: tuple[bool, ...]

    @classmethod
    def of_groups(cls, groups: Sequence[int], fitted: Sequence[bool]) -> Folds:
        """Judge by the trials that the session holds out, else by all in turn."""
        held = [group == HELD_OUT for group in groups]
        return cls(tuple(groups), tuple(fitted), tuple(held) if any(held) else (True,) * len(held))

    @classmethod
    def of_trials(
        cls, names: Sequence[str], held_out: Collection[str], fitted: Collection[str]
    ) -> Folds:
        """Leave each trial out alone, or in `MOST_GROUPS` groups where there are more."""
        groups = [
            HELD_OUT if name in held_out else number % MOST_GROUPS
            for number, name in enumerate(names)
        ]
        return cls.of_groups(groups, [name in fitted for name in names])

    def subset(self, trials: Sequence[int]) -> Folds:
        """The same of some trials, given by number."""
        return Folds(
            tuple(self.groups[k] for k in trials),
            tuple(self.fitted[k] for k in trials),
            tuple(self.judged[k] for k in trials),
        )

    @property
    def fitted_trials(self) -> list[int]:
        """Numbers of the trials that a fit sees."""
        return [k for k, fits in enumerate(self.fitted) if fits]

    @property
    def nothing_held_out(self) -> bool:
        """Whether there is one group only, so that the error is that of the fit."""
        return len(set(self.groups)) == 1
