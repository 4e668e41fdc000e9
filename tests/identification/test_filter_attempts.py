"""Which run of the filter counts, from several starts or again around its answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bampipe.identification import filter_estimate
from bampipe.identification.filter_estimate import _repeat_until_settled
from bampipe.identification.filter_run import MotionLost, likelier


@dataclass(frozen=True)
class Run:
    """What the choice between runs reads of one: a parameter of unit deviation."""

    at: float
    log_likelihood: float
    restarts: int = 2
    repeats: int = 0
    first: tuple[Any, ...] = ()
    passes: tuple[Any, ...] = ("first",)
    covariance: np.ndarray = field(default_factory=lambda: np.eye(1))

    @property
    def theta(self) -> np.ndarray:
        return np.array([self.at])


MODEL: Any = SimpleNamespace(to_physical=lambda theta: (theta, np.ones(1)))


def settle(*runs: Run | None) -> Any:
    """What is published of a first run and of those that follow it; None is one that is lost."""
    following = iter(runs[1:])

    def run_from(*_: Any) -> Any:
        run = next(following)
        if run is None:
            raise MotionLost("lost")
        return run

    found: Any = runs[0]
    return _repeat_until_settled(found, MODEL, SimpleNamespace(), run_from)  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [-200.0, -1e-9, 1e-9, 200.0])
def test_a_settled_answer_counts_whatever_rounding_did_to_the_first(change: float) -> None:
    found = settle(Run(0.0, 1000.0), Run(8.0, 1000.0 + change), Run(8.2, 1000.0 + change))
    assert (found.at, found.repeats, found.first) == (8.2, 2, ("first",))


def test_of_answers_that_never_settle_the_first_of_the_likeliest_counts() -> None:
    far = [0.0, 5.0, -5.0, 9.0, -9.0]
    levels = [1000.0, 1020.0, 1080.0, 1100.0, 900.0]
    runs = [Run(at, level) for at, level in zip(far, levels, strict=True)]
    assert len(runs) == 1 + filter_estimate._REPEATS
    assert settle(*runs).at == -5.0
    assert settle(runs[0], runs[1], None).at == 0.0


def test_a_run_replaces_another_only_if_it_is_clearly_likelier() -> None:
    one, other, clear = Run(0.0, 1000.0), Run(1.0, 1029.0), Run(2.0, 1031.0)
    chosen: Any = likelier(one, other)  # type: ignore[arg-type]
    assert chosen.at == 0.0
    assert likelier(chosen, clear).at == 2.0  # type: ignore[arg-type, attr-defined]
