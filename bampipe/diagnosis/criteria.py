"""The criteria of a verdict."""

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from scipy.special import lambertw

from bampipe.schema import STRICT, Positive

Fraction = Annotated[float, Field(gt=0, lt=1)]


@checked_dataclass(frozen=True, config=STRICT)
class Criteria:
    """The criteria for calling an effect missing; docs/method_selection.md describes each.

    Attributes:
        probability: probability P from which effects are called missing; below 1 - P, they are not
            mentioned.
        size: smallest share of the applied force of an axis (root mean square) that an effect must
            add beyond what other parameters could absorb.
        replicates: number of replicates of the fitted model, as in a parametric bootstrap.
        expected_effects: prior number of missing effects.
        most_effects: largest number of effects that a set adds to the model.
        bias_error: relative error of the biases that filters cause where friction reverses.
        discrepancy: root mean square error of any model, as a share of the applied force.
        tails: degrees of freedom of Student's t distribution of the errors.
        block_s: length of independent blocks of time, s; no single block decides a verdict.
        beam: number of sets of effects that are pursued side by side.
    """

    probability: Annotated[float, Field(gt=0.5, lt=1)] = 0.9
    size: Fraction = 0.001
    replicates: Annotated[int, Field(ge=4)] = 12
    expected_effects: Positive = 1.0
    most_effects: Annotated[int, Field(ge=1)] = 8
    bias_error: Positive = 0.2
    discrepancy: Positive = 0.003
    tails: Positive = 4.0
    block_s: Positive = 2.0
    beam: Annotated[int, Field(ge=1)] = 10

    @property
    def largest_p_value(self) -> float:
        """The p-value at which `cap_probability` equals ``probability``."""
        odds_against = (1.0 - self.probability) / self.probability
        return float(np.exp(lambertw(-odds_against / np.e, -1).real))


def cap_probability(p_value: float) -> float:
    """Return the highest probability of an effect whose gain has a given p-value.

    The prior odds are even (Sellke, Bayarri and Berger 2001, The American Statistician 55, 62).
    """
    p = min(max(p_value, 1e-300), 1.0 / np.e)
    return float(1.0 / (1.0 - np.e * p * np.log(p)))
