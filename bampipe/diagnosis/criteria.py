"""The numbers that decide a verdict: one record, passed to whatever judges."""

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from scipy.special import lambertw

from bampipe.schema import STRICT, Positive

Fraction = Annotated[float, Field(gt=0, lt=1)]


@checked_dataclass(frozen=True, config=STRICT)
class Criteria:
    """What it takes for an effect to be called missing; each described in docs/method_selection.

    Attributes:
        probability: the probability from which an effect is called missing; one that has less than
            one minus that is not mentioned.
        size: the smallest share of the applied force of an axis, root mean square, that an effect
            must add to matter, beyond what other parameters could take over.
        replicates: number of replicates of the fitted model, as in a parametric bootstrap.
        expected_effects: number of effects that a model is expected to lack.
        most_effects: largest number of effects that a set adds to the model.
        bias_error: relative error of the bias that filters cause where friction reverses.
        discrepancy: error of any model, root mean square, as a share of the applied force.
        tails: degrees of freedom of Student's t distribution of the errors.
        block_s: length of stretches of time that count as independent, s: one must not decide.
        beam: number of sets of effects that are pursued side by side.
        doubt: scale of what is left on an axis, in units of noise and discrepancy, from which on it
            is something unknown for certain.
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
    doubt: Positive = 3.0

    @property
    def largest_p_value(self) -> float:
        """The p-value from which on `most_probable` is below ``probability``."""
        odds_against = (1.0 - self.probability) / self.probability
        return float(np.exp(lambertw(-odds_against / np.e, -1).real))


def cap_probability(p_value: float) -> float:
    """The highest probability that an effect can have which chance imitates with a p-value.

    At even odds before (Sellke, Bayarri and Berger 2001, The American Statistician 55, 62).
    """
    p = min(max(p_value, 1e-300), 1.0 / np.e)
    return float(1.0 / (1.0 - np.e * p * np.log(p)))
