"""Force of each term of an identified model, by sample and as a binned curve."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bampipe.arrays import Array, Flags, Indices
from bampipe.diagnosis.shape import Variable, number_bins, share_between, variables
from bampipe.errors import InputError
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.results.identify import Covariance
from bampipe.results.rounding import NORMAL_95
from bampipe.results.terms import EffectText, ModelTerm, TermCurve, TermsResult
from bampipe.trials.comparison import ComparedTrial
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.noise_floor import draw_trials
from bampipe.trials.residuals import ModelOnTrial, rms

_BINS = 24
_FEWEST = 8
"""Smallest number of samples in a bin."""
_LEAST_SHARE = 0.02
"""Smallest force of a term, relative to the axis' error, for which a curve is meaningful."""
_STEP = 1e-4
"""Finite difference relative to a parameter's size."""


class _Part(NamedTuple):
    """Some parameters, by index; the term vanishes if all ``strengths`` are zero."""

    name: str
    text: EffectText
    parameters: tuple[int, ...]
    strengths: tuple[int, ...]


@dataclass(frozen=True)
class _Samples:
    """A model on the trials that are binned.

    Attributes:
        fitted: the model by trial; used: which of the thinned samples count, (K, n_q).
        error: of the model, by axis, (n_q,), N.m or N.
    """

    fitted: Sequence[ModelOnTrial]
    band: Band
    used: Flags
    error: Array

    def residual(self, p: Array) -> Array:
        """Return the unfiltered, thinned residual (K, n_q) with other parameters, (n_p,)."""
        found = (replace(one, p=p).residual for one in self.fitted)
        return np.concatenate([one[self.band.thinned_rows(len(one))] for one in found])


def describe_terms(
    system: System,
    trials: MeasuredTrials,
    compared: Sequence[ComparedTrial],
    p: Array,
    covariance: Covariance,
    model: str,
) -> TermsResult:
    """Return the equations of a model with its numbers, and the curve of each term.

    A curve is the force of the term, the residual of the model without it minus that of the full
    model, in bins of the variable that explains most of its variance. Nothing is low-pass filtered:
    measured forces cancel in the difference, and filtering only the term's force would distort the
    curve. Of a long session, a random selection of trials is binned (`draw_trials`).

    ``p`` (n_p,) and ``covariance`` are those published for the model of that name; ``compared`` are
    all trials.
    """
    error = rms([c.residual for c in compared], [c.used for c in compared])
    chosen = draw_trials([len(c.t) * trials.band.step for c in compared])
    fitted = [ModelOnTrial(system, p, trials.motions, k) for k in chosen]
    used = np.concatenate([compared[k].used for k in chosen])
    samples = _Samples(fitted, trials.band, used, error)
    from bampipe.physics.readable import model_equations

    values = system.by_name(p)
    try:
        equations = model_equations(system.model, values)
    except InputError:  # deriving them takes too long
        equations = ()
    known = {
        axis: [v for v in variables(fitted, trials.band, axis) if v.name not in ("trial", "time")]
        for axis in range(len(system.coordinates))
    }
    present = samples.residual(p)
    return TermsResult(
        model=model,
        equations=equations,
        terms=tuple(
            ModelTerm(
                name=part.name,
                text=part.text,
                parameters=tuple(system.parameters[i].name for i in part.parameters),
                curves=tuple(_curves(samples, p, present, covariance, part, known)),
            )
            for part in _parts(system)
        ),
    )


def _parts(system: System) -> Iterator[_Part]:
    """Yield the friction of each axis, then the effects."""
    numbers = {item.name: i for i, item in enumerate(system.parameters)}
    for axis in system.coordinates:
        own = [numbers[n] for n in (f"viscous.{axis}", f"coulomb.{axis}") if n in numbers]
        if own:
            text = EffectText(
                summary="Viscous and Coulomb friction",
                formulas=("torque = -viscous*qd - coulomb*sgn(qd)",),
                looks_like="residual against velocity: a step at zero and a slope",
                on_the_machine="",
                source="",
            )
            yield _Part(f"friction:{axis}", text, tuple(own), tuple(own))
    for bound in system.model.effects:
        own = [numbers[item.name] for item in bound.parameters]
        strengths = [numbers[item.name] for item in bound.parameters if item.strength]
        yield _Part(bound.name, EffectText.of(bound.effect), tuple(own), tuple(strengths))


def _curves(
    samples: _Samples,
    p: Array,
    present: Array,
    covariance: Covariance,
    part: _Part,
    known: dict[int, list[Variable]],
) -> Iterator[TermCurve]:
    if not part.strengths:
        return
    system, residual = samples.fitted[0].system, samples.residual
    without = p.copy()
    without[list(part.strengths)] = 0.0
    force = residual(without) - present
    names = [system.parameters[i].name for i in part.parameters]
    free = [i for i, name in zip(part.parameters, names, strict=True) if name in covariance.names]
    rows = [covariance.names.index(system.parameters[i].name) for i in free]
    spread = np.array(covariance.matrix)[np.ix_(rows, rows)] if rows else np.zeros((0, 0))
    slopes = []
    for i in free:
        moved = p.copy()
        step = _STEP * max(abs(p[i]), system.parameters[i].sd, 1e-12)
        moved[i] += step
        slopes.append((present - residual(moved)) / step)
    for axis, name in enumerate(system.coordinates):
        use = samples.used[:, axis]
        own = force[use, axis]
        if not own.size or np.sqrt(np.mean(own**2)) < _LEAST_SHARE * samples.error[axis]:
            continue
        own_states = ("", part.name.replace(":", "."))
        causes = [v for v in known[axis] if v.name.partition(" of ")[2] in own_states]
        binned = [number_bins(np.concatenate(v.values)[use], _BINS) for v in causes]
        shares = [share_between(own, which) for which in binned]
        best = int(np.argmax(shares))
        share, variable, which = shares[best], causes[best], binned[best]
        values = np.concatenate(variable.values)[use]
        filled = [b for b in range(which.max() + 1) if np.sum(which == b) >= _FEWEST]
        if len(filled) < 2:
            continue
        mean = _means(own, which, filled)
        slope = np.array([_means(one[use, axis], which, filled) for one in slopes])
        variance = np.einsum("ib,ij,jb->b", slope, spread, slope) if rows else 0.0 * mean
        half = NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))
        yield TermCurve(
            axis=name,
            unit=system.torque_units[axis],
            variable=variable.name,
            variable_unit=variable.unit,
            center=tuple(_means(values, which, filled)),
            mean=tuple(mean),
            low=tuple(mean - half),
            high=tuple(mean + half),
            variance_share=share,
        )


def _means(values: Array, which: Indices, bins: Sequence[int]) -> Array:
    return np.array([values[which == b].mean() for b in bins])
