"""Division of trials into those to fit, groups to leave out together, and those to judge."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Self

HELD_OUT = -1
"""Group number of trials that the session holds out."""
MOST_GROUPS = 10
"""Largest number of groups left out in turn: the cost grows with its square."""


@dataclass(frozen=True)
class Folds:
    """Division of a session's trials for fits and held-out errors.

    Attributes:
        groups: group number of each trial. The trials of a group are left out together; those in
            `HELD_OUT` are never fitted.
        fitted: whether a fit may see each trial.
        judged: whether each trial counts in the held-out error.
    """

    groups: tuple[int, ...]
    fitted: tuple[bool, ...]
    judged: tuple[bool, ...]

    @classmethod
    def of_trials(
        cls, names: Sequence[str], held_out: Collection[str], fitted: Collection[str]
    ) -> Self:
        """Give each trial a group of its own, or divide them into `MOST_GROUPS` groups.

        The trials that the session holds out judge the model; if there are none, all do.
        """
        held = [name in held_out for name in names]
        groups = (HELD_OUT if out else number % MOST_GROUPS for number, out in enumerate(held))
        judged = held if any(held) else [True] * len(held)
        return cls(tuple(groups), tuple(name in fitted for name in names), tuple(judged))

    def subset(self, trials: Sequence[int]) -> "Folds":
        """The division of some of the trials, given by number."""
        return Folds(
            tuple(self.groups[k] for k in trials),
            tuple(self.fitted[k] for k in trials),
            tuple(self.judged[k] for k in trials),
        )

    @property
    def fitted_trials(self) -> list[int]:
        """Numbers of the trials that a fit may see."""
        return [k for k, fits in enumerate(self.fitted) if fits]

    @property
    def nothing_held_out(self) -> bool:
        """Whether all trials are in one group, so that the held-out error is that of the fit."""
        return len(set(self.groups)) == 1
