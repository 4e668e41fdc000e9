"""What the smoothing of the sign of a velocity adds to the uncertainty of parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bampipe.identification.estimates import Estimate
from bampipe.lists import join_names
from bampipe.physics import System, compile_model
from bampipe.physics.recipe import Recipe
from bampipe.results.rounding import significant

_NARROWER = 0.5
_MOST, _SHOWN = 0.5, 6
"""Share of the variance of a parameter from which on what the smoothing adds is said in words,
and how many are named."""


def with_smoothing(estimate: Estimate, recipe: Recipe) -> Estimate:
    """Return the estimate with how far it is from that without smoothing in its covariance.

    A machine with dry friction truly stands still, where the model creeps within the width of its
    smoothed sign. An estimate by the filter or by output error errs in proportion to that width:
    it is off by twice what half the width that it took moves it. A machine that does creep shows
    that by readings that the narrower sign comes less close to. What widths that are nearly as
    likely disagree on is as uncertain. Least squares leaves standstill out and takes the rest off
    as bias.

    Args:
        estimate: as published; recipe: its model as data.
    """
    if estimate.moved_by is None:
        return estimate
    narrower = compile_model(recipe.with_sign_widths(_NARROWER * estimate.width).model())
    off = estimate.moved_by(narrower) / (1.0 - _NARROWER)
    spread = np.zeros(len(off)) if estimate.spread is None else estimate.spread
    details = [
        {**entry, "smoothing_sd": size}
        for entry, size in zip(estimate.details, np.hypot(off, spread), strict=True)
    ]
    covariance = estimate.covariance + np.outer(off, off) + np.diag(spread**2)
    return replace(estimate, covariance=covariance, details=details)


def describe_smoothing(system: System, estimate: Estimate) -> tuple[str, ...]:
    """Sentences on a narrower sign, and on uncertainty that is for the most part of smoothing."""
    shares = [
        entry.get("smoothing_sd", 0.0) ** 2 / max(sd**2, np.finfo(float).tiny)
        for entry, sd in zip(estimate.details, estimate.sd, strict=True)
    ]
    names = [
        f"`{system.parameters[place].name}`"
        for place, share in zip(estimate.free, shares, strict=True)
        if share > _MOST
    ]
    said = []
    if estimate.width < 1.0:
        said.append(
            f"The filter smooths the sign of the velocity over {significant(estimate.width)} of the"
            " device's `sign_width`, which makes the readings likelier."
        )
    if names:
        said.append(
            f"Most of the uncertainty of {join_names(names, _SHOWN)} is that the sign of the"
            " velocity is smoothed, where a machine stands still."
        )
    return tuple(said)
