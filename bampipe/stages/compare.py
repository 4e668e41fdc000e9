"""Stage compare: the ladder of model versions on the same held-out trials."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.refusals import refusal
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model import ModelFile, read_model_file
from bampipe.progress import Progress
from bampipe.results.compare import CompareResult, Moved, Rung, Value
from bampipe.results.identify import IdentifyResult
from bampipe.results.rounding import round_with_sd
from bampipe.results.validate import ValidateResult
from bampipe.schema import STRICT, Positive

SUMMARY = "Held-out error of every model version, and which parameters moved"
INPUTS = ("models/*/model.toml", "models/*/identify.json", "models/*/validate.json")
OUTPUTS = ("compare.json",)


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        sigmas: a parameter has moved when it changed by more than this many standard deviations
            of the change.
    """

    sigmas: Positive = 3.0


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Put the validated models of a run side by side, parents before children."""
    models = {
        name: read_model_file(run.path(f"models/{name}/model.toml"))
        for name in run.models()
        if run.exists(ValidateResult.file(name))
    }
    if not models:
        raise refusal("none_validated", str(run.root), root=run.root)
    order = sorted(models, key=lambda n: (len(models[n].effects), n))
    ladder: dict[str, Rung] = {}
    parameters: dict[str, dict[str, Value]] = {}
    best = order[0]
    for name in order:
        ladder[name] = _rung(run, name, models, ladder)
        if ladder[name].confirmed and ladder[name].improves_on(ladder[best]):
            best = name
        for key, found in run.read(IdentifyResult, name).parameters.items():
            parameters.setdefault(key, {})[name] = Value.of(found)
    confirmed = [name for name in order if ladder[name].confirmed]
    moved = _find_moved(parameters, models, confirmed, config.sigmas)
    return CompareResult(
        best=best, ladder=tuple(ladder.values()), parameters=parameters, moved=moved
    ).write(out)


def _find_moved(
    parameters: Mapping[str, Mapping[str, Value]],
    models: Mapping[str, ModelFile],
    confirmed: Sequence[str],
    sigmas: float,
) -> tuple[Moved, ...]:
    """Return the parameters that a confirmed model changed by more than their uncertainty."""
    moved = []
    for model in confirmed:
        parent = models[model].parent
        for name, by_model in parameters.items():
            if parent not in by_model or model not in by_model:
                continue
            old, new = by_model[parent], by_model[model]
            sd, change = math.hypot(old.sd, new.sd), new.estimate - old.estimate
            if abs(change) > sigmas * sd:
                sentence = (
                    f"{name} moved from {round_with_sd(old.estimate, old.sd)} to"
                    f" {round_with_sd(new.estimate, new.sd)} {new.unit}: without what was"
                    " added it was biased."
                )
                of_model = {"parameter": name, "model": model, "parent": parent}
                moved.append(Moved.of(new, **of_model, change=change, sd=sd, sentence=sentence))
    return tuple(moved)


def _rung(
    run: RunFolder, name: str, models: Mapping[str, ModelFile], earlier: Mapping[str, Rung]
) -> Rung:
    validated = run.read(ValidateResult, name)
    axes, free = validated.axes, validated.free_run
    parent, effects = models[name].parent, models[name].effects
    had = models[parent].effects if parent in models else ()
    rung = Rung(
        model=name,
        parent=parent or None,
        added=", ".join(e for e in effects if e not in had) or None,
        effects=effects,
        held_out_rmse={axis: entry.held_out_rmse for axis, entry in axes.items()},
        noise_floor={axis: entry.noise_floor for axis, entry in axes.items()},
        standing={axis: entry.standing for axis, entry in axes.items()},
        confirmed=not parent,
        unit={axis: entry.unit for axis, entry in axes.items()},
        free_run_mode=free.mode if free else None,
        free_run_reason=free.reason if free else "`free_run` is off.",
        free_run=free.axes if free else {},
        drift=free.drift if free else {},
    )
    before = earlier.get(parent)
    if before is None or not before.confirmed:
        return rung
    return rung.model_copy(update={"confirmed": rung.improves_on(before)})
