"""Candidates that act on what effects of the model leave."""

from __future__ import annotations

import pytest
from independent_runs import record_run

from bampipe.data.run_folder import RunFolder
from bampipe.discover.candidates import Scorer, candidate, candidate_model
from bampipe.discover.chance import fit_trials, system_of
from bampipe.discover.start import search_start
from bampipe.physics import registry
from bampipe.physics.recipe import Recipe
from bampipe.trials.measured import read_measured_trials

DAMPER = registry.device("magnetic_damper")
LAG, SATURATION = "channel_lag:current", "channel_saturation:current"


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """A damper whose coil lags and whose field saturates with the lagged current."""
    run, _ = record_run(tmp_path_factory.mktemp("coil"), "damper", 3, LAG, SATURATION)
    bare = system_of(Recipe(DAMPER.declaration, (), ()))
    return read_measured_trials(RunFolder(run.root), bare, every_input=True)


@pytest.mark.parametrize(("first", "second"), [(LAG, SATURATION), (SATURATION, LAG)])
def test_what_acts_on_what_an_effect_leaves_is_scored_with_it(trials, first, second):
    recipe = Recipe(DAMPER.declaration, (first,), ())
    evidence = fit_trials(trials, recipe, search_start(trials, recipe))
    scorer = Scorer(evidence)
    joint = scorer.score(candidate(candidate_model(DAMPER, second, (), recipe.effects)))
    noise = 1.0  # of the simulated load cell, N
    assert scorer.before.error[0] > 8.0 * noise
    assert joint.error[0] < 2.0 * noise
    alone = scorer.score(candidate(candidate_model(DAMPER, second)))
    assert alone.error[0] > 1.5 * joint.error[0]


def test_only_effects_that_meet_are_taken_together():
    def names(candidate_name, *present, device="slider"):
        model = candidate_model(registry.device(device), candidate_name, (), present)
        return [e.name for e in model.effects]

    assert names("load_dependent_friction:carriage", "actuator_lag:motor") == [
        "actuator_lag:motor",
        "load_dependent_friction:carriage",
    ]
    assert names("stribeck:carriage", "actuator_lag:motor") == ["stribeck:carriage"]
    assert names("stribeck:carriage", "force_bias:motor") == ["stribeck:carriage"]
    assert names("encoder_scale:yaw", "backlash:yaw", device="bam") == [
        "backlash:yaw",
        "encoder_scale:yaw",
    ]
    assert names("stribeck:yaw", "backlash:yaw", device="bam") == ["stribeck:yaw"]
