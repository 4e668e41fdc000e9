"""Which effect a model lacks, or that it lacks none, or that the library has no name for it.

1. Every candidate is refitted with the model and scored on trials left out.
2. The same is done with replays of the fitted model, which lack nothing: the chance level.
3. The best candidate that beats chance is added, and so on until none does; later ones must also
   beat replays of the model with those before them. Candidates that come close to the best are
   distinguished by replaying each of them: the pattern of all their scores must look like the
   measured one. Those that pass alike are reported as one group. An earlier effect that a later
   one makes superfluous is dropped.
4. What is left is compared with the noise floor of the final model, found by replaying it, in the
   band of the session and in another one.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.bench import Bench
from bampipe.discover.candidates import list_candidates
from bampipe.discover.chance import Progress, workers
from bampipe.discover.findings import Diagnosis
from bampipe.discover.other_band import judge_in_other_band
from bampipe.discover.search import search
from bampipe.discover.sentences import axis_sentences
from bampipe.discover.settings import Settings
from bampipe.discover.verdict import conclude
from bampipe.physics.recipe import Recipe
from bampipe.physics.registry import effect_from
from bampipe.trials.measured import MeasuredTrials

Array = NDArray[np.float64]


def diagnose(
    trials: MeasuredTrials,
    recipe: Recipe,
    start: Array,
    settings: Settings | None = None,
    progress: Progress = lambda fraction, message: None,
    without: Collection[str] = (),
) -> Diagnosis:
    """Find what a model lacks.

    Args:
        trials: the measured trials, at least two of them fitted.
        recipe: the model.
        start: parameters to start its fit from, (n_p,).
        settings: how carefully to look.
        progress: called with a fraction and a message.
        without: effects that are not weighed, ``name[:target]``.

    Raises:
        ValueError: fewer than two trials.
    """
    settings = settings or Settings()
    if len(trials.motions) < 2:
        raise ValueError("a diagnosis needs at least two trials: one is held out")
    device, extra = recipe.model().device, [effect_from(e) for e in recipe.extra]
    candidates = list_candidates(device, (*recipe.effects, *without), extra)
    with workers(trials, settings.jobs) as pool:
        bench = Bench(trials, settings, pool, candidates)
        searched = search(bench, recipe, start, progress)
        found = conclude(searched, settings)
    progress(0.95, "holding the final model against its floor in another band")
    final = searched.found
    bands = judge_in_other_band(searched.trials, final.evidence, final.replayed, settings)
    # There replays creep: where ones that stand still are the floor, they say nothing.
    creeping = (axis.creeping_floor is None for axis in found.axes)
    bands = tuple(b if holds else None for b, holds in zip(bands, creeping, strict=True))
    found = _with_each_axis(found, "other_band", bands)
    return _with_each_axis(found, "sentence", axis_sentences(found, settings))


def _with_each_axis(found: Diagnosis, field: str, values: Sequence[object]) -> Diagnosis:
    axes = [a.model_copy(update={field: v}) for a, v in zip(found.axes, values, strict=True)]
    return replace(found, axes=tuple(axes))
