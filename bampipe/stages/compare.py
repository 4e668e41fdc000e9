"""Stage compare: the ladder of model versions on the same held-out trials."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model import ModelFile, read_model_file
from bampipe.errors import InputError
from bampipe.files import write_json
from bampipe.progress import Progress

NAME = "compare"
SUMMARY = "Held-out error of every model version, and which parameters moved"


@dataclass(frozen=True)
class Config:
    """What the stage can be told.

    Attributes:
        sigmas: a parameter has moved when it changed by more than this many standard deviations
            of the change.
    """

    sigmas: float = 3.0


def inputs(config: Config) -> tuple[str, ...]:
    """Return the paths the stage reads."""
    return ("models/*/model.toml", "models/*/identify.json", "models/*/validate.json")


def outputs(config: Config) -> tuple[str, ...]:
    """Return the paths the stage writes."""
    return ("compare.json",)


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Put the validated models of a run side by side, parents before children.

    Raises:
        InputError: no model has been validated, or the parent of one is missing.
    """
    if not config.sigmas > 0:
        raise InputError("must be positive", where="compare.sigmas")
    models: dict[str, ModelFile] = {}
    for path in run.glob("models/*/model.toml"):
        name = Path(path).parent.name
        if run.exists(f"models/{name}/validate.json"):
            models[name] = read_model_file(run.path(path))
    if not models:
        raise InputError(
            "no model has been validated yet",
            where=str(run.root),
            remedy=f"run `bampipe validate {run.root}` first",
        )
    order = sorted(models, key=lambda n: (len(models[n].effects), n))
    ladder = [_rung(run, name, models) for name in order]
    parameters: dict[str, dict[str, object]] = {}
    for name in order:
        found = run.read_json(f"models/{name}/identify.json")["parameters"]
        for key, entry in found.items():
            kept = {k: entry.get(k) for k in ("estimate", "sd", "unit")}
            parameters.setdefault(key, {})[name] = kept
    result: dict[str, object] = {
        "ladder": ladder,
        "parameters": parameters,
        "moved": _moved(parameters, models, order, config.sigmas),
    }
    write_json(out / "compare.json", result)
    return result


def _rung(run: RunFolder, name: str, models: Mapping[str, ModelFile]) -> dict[str, object]:
    validated = run.read_json(f"models/{name}/validate.json")
    axes = validated["axes"]
    parent, effects = models[name].parent, models[name].effects
    had = models[parent].effects if parent in models else ()
    added = [e for e in effects if e not in had]
    rung: dict[str, object] = {
        "model": name,
        "parent": parent or None,
        "added": ", ".join(added) or None,
        "effects": list(effects),
        "held_out_rmse": {a: entry["held_out_rmse"] for a, entry in axes.items()},
        "noise_floor": {a: entry.get("noise_floor") for a, entry in axes.items()},
        "unit": {a: entry["unit"] for a, entry in axes.items()},
    }
    free = validated.get("free_run", {})
    if "axes" in free:
        kept = ("mean_absolute", "rmse", "relative_error_percent", "unit")
        rung["free_run_mode"] = free["mode"]
        rung["free_run"] = {a: {k: e[k] for k in kept} for a, e in free["axes"].items()}
    return rung


def _moved(
    parameters: Mapping[str, Mapping[str, Any]],
    models: Mapping[str, ModelFile],
    order: list[str],
    sigmas: float,
) -> list[dict[str, object]]:
    """Parameters that changed from parent to child by more than their uncertainty."""
    moved = []
    for model in order:
        parent = models[model].parent
        for name, by_model in parameters.items():
            if parent not in by_model or model not in by_model:
                continue
            old, new = by_model[parent], by_model[model]
            sd = math.hypot(float(old["sd"]), float(new["sd"]))
            change = float(new["estimate"]) - float(old["estimate"])
            if abs(change) > sigmas * sd:
                moved.append(
                    {
                        "parameter": name,
                        "model": model,
                        "parent": parent,
                        "change": change,
                        "sd": sd,
                        "unit": new["unit"],
                        "sentence": (
                            f"{name} moved from {float(old['estimate']):.4g} to "
                            f"{float(new['estimate']):.4g} {new['unit']}: without the effect it "
                            f"was biased."
                        ),
                    }
                )
    return moved
