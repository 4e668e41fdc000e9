"""Candidates held against replays that truly stand still at reversals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bampipe.discover.settings import Settings
from bampipe.discover.stops import WIDTHS, StoppingReplays

GAINS = {"compliance": 100.0, "delay": 60.0, "thinning": 30.0}
"""Beyond chance on replays that creep."""
STILL = {"compliance": 30.0, "delay": 55.0, "thinning": 29.0}
"""The same on replays that stand still."""
LITTLE = {name: 0.9 * gain for name, gain in GAINS.items()}
"""The same on such replays of another width."""


def level_of(gains, p_values):
    return SimpleNamespace(
        excess=lambda name: np.array([gains[name]]),
        p_value=lambda name: p_values.get(name, 1e-6),
        ask=lambda scores, names: None,
        learn=lambda names: None,
        replicates=[SimpleNamespace(held_out_rmse=np.ones(1))],
    )


def replays(p_values=(), matter=True, width=WIDTHS[0]):
    """Replays of which those of one width imitate, and a list of the widths that were made."""
    made = []

    def level(*_, replayed):
        made.append(replayed)
        return level_of(STILL if replayed == width else LITTLE, dict(p_values))

    recipe = SimpleNamespace(with_sign_widths=lambda factor: factor)
    current = SimpleNamespace(
        recipe=recipe, evidence=None, replayed=None,
        scorer=SimpleNamespace(independent_samples=np.array([1000.0])),
    )  # fmt: skip
    bench = SimpleNamespace(
        settings=Settings(), level=level, standing_still_matters=lambda *known: matter
    )
    return StoppingReplays(bench, current), made


SIGNIFICANT = [(gain, name) for name, gain in GAINS.items()]
SCORES = {name: name for name in GAINS}


@pytest.mark.parametrize("width", WIDTHS)
def test_what_mostly_shows_on_such_replays_too_is_passed_over(width) -> None:
    found, made = replays(width=width)
    for _ in range(2):  # the model is the same: its replays are made once
        kept, doubted = found.first_beyond(SCORES, level_of(GAINS, {}), SIGNIFICANT)
        assert [name for _, name in kept] == ["delay", "thinning"]
        (p_value, gain) = doubted.pop("compliance")
        assert p_value == Settings().significance
        assert gain == pytest.approx(0.03)
        assert doubted == {}
    assert sorted(made) == sorted(WIDTHS)


def test_what_hardly_shows_on_replays_of_one_width_is_not_held_against_the_other() -> None:
    found, made = replays()
    scores, gains = {"delay": "delay"}, {"delay": 56.0}
    kept, _ = found.first_beyond(scores, level_of(gains, {}), [(56.0, "delay")])
    assert [name for _, name in kept] == ["delay"]
    assert made == [WIDTHS[0]]


def test_what_such_replays_have_by_chance_is_passed_over() -> None:
    found, _ = replays({"delay": 0.2})
    kept, doubted = found.first_beyond(SCORES, level_of(GAINS, {}), SIGNIFICANT)
    assert [name for _, name in kept] == ["thinning"]
    assert doubted["delay"][0] == 0.2


def test_where_standing_still_does_not_matter_nothing_is_replayed() -> None:
    found, made = replays(matter=False)
    assert found.first_beyond(SCORES, level_of(GAINS, {}), SIGNIFICANT) == (SIGNIFICANT, {})
    assert made == []
