"""Effects on axes that leave each other alone are found in one round."""

from __future__ import annotations

import pytest
from sessions import bam, made

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
