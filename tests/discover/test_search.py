"""What the search for a set of effects adds in a round, and what it is not worth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from sessions import bam, made

from bampipe.discover import search as searching
from bampipe.discover.bench import Bench
from bampipe.discover.candidates import list_candidates
from bampipe.discover.chance import system_of, workers
from bampipe.discover.search import search
from bampipe.discover.settings import Settings

HIDDEN = {
    "stribeck.yaw.force": 1.1,
    "stribeck.yaw.speed": 0.05,
    "quadratic_drag.extension.coefficient": 40.0,
}
EFFECTS = ("quadratic_drag:extension", "stribeck:yaw")


def weighed(monkeypatch, before, after, *, applied=100.0, floor=0.15, through_play=0.0):
    """Names of what beats chance where an error falls from ``before`` to ``after``.

    Args:
        applied: force; floor: of the replays; through_play: how much of it play makes of noise.
    """
    gain = 1000.0 * np.log(before / after) * np.ones(1)
    evidence = SimpleNamespace(applied_rms=np.array([applied]), folds=SimpleNamespace(groups=()))
    scorer = SimpleNamespace(base_error=np.array([before]), independent_samples=np.array([1000.0]))
    level = SimpleNamespace(
        ask=lambda scores, names: None, excess=lambda score: gain, p_value=lambda score: 1e-6,
        replicates=[SimpleNamespace(error=np.array([x * floor])) for x in (0.95, 1.0, 1.05)],
    )  # fmt: skip
    bench = SimpleNamespace(
        settings=Settings(),
        gaining=lambda scores, scorer: list(scores),
        trials=SimpleNamespace(sensors=None),
    )
    monkeypatch.setattr(searching, "Scorer", lambda evidence: scorer)
    monkeypatch.setattr(
        searching, "force_noise_through_offset", lambda *_: np.array([through_play**2])
    )
    found, _ = searching._weigh(bench, {"weak": None}, level, evidence)
    return [name for _, name in found]


@pytest.mark.parametrize(("applied", "named"), [(100.0, ["weak"]), (2000.0, [])])
def test_what_takes_off_less_than_a_sensor_is_linear_to_is_not_named(
    monkeypatch, applied, named
) -> None:
    """An error of 0.25 falls to 0.20, and so does by 0.15 what it takes off."""
    assert weighed(monkeypatch, 0.25, 0.20, applied=applied) == named


@pytest.mark.parametrize(("through_play", "named"), [(0.0, []), (0.05, []), (0.14, ["weak"])])
def test_at_the_floor_what_play_makes_of_noise_hides_no_effect(
    monkeypatch, through_play, named
) -> None:
    """An error of 1.1 floors falls by a tenth."""
    assert weighed(monkeypatch, 0.165, 0.150, through_play=through_play) == named


@pytest.mark.slow
def test_effects_on_two_axes_are_added_at_once_and_each_has_its_rung() -> None:
    session = made(bam(EFFECTS), HIDDEN, trials=3)
    recipe = bam()
    settings = Settings(replicates=4, jobs=1)
    names = [*EFFECTS, "quadratic_drag:yaw", "stribeck:extension", "presliding:pitch"]
    assert set(names) <= set(list_candidates(recipe.model().device, (), ()))
    rounds = []

    def note(_: float, message: str) -> None:
        if message.startswith("added"):
            rounds.append(message)

    with workers(session, 1) as pool:
        bench = Bench(session, settings, pool, tuple(names))
        found = search(bench, recipe, system_of(recipe).prior, note)
    assert set(found.selected) == set(EFFECTS)
    assert len(rounds) == 1
    assert [len(step.effects) for step in found.steps] == [0, 1, 2]
    by_rung = [[step.held_out_rmse[axis] for step in found.steps] for axis in ("yaw", "extension")]
    assert all(errors[-1] < 0.9 * errors[0] for errors in by_rung)
