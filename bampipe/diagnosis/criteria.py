"""The numbers that decide a verdict: one record, passed to whatever judges."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.special import lambertw


@dataclass(frozen=True)
class Criteria:
    """What it takes for an effect to be called missing; each described in docs/method_selection.

    Attributes:
        probability: from which an effect is called missing, and below one minus which it is not
            mentioned.
        size: least share of the applied force of an axis, root mean square, that an effect must add
            beyond what the other parameters could take over: no load cell is more linear.
        replicates: replays of a fitted model, as in a parametric bootstrap.
        expected_effects: how many effects a model is expected to lack: the prior of each is this
            over their number.
        most_effects: beyond those of the model.
        bias_error: share by which the common bias of the replicates may be off, sample by sample.
        discrepancy: root mean square error of any model, as a share of the applied force.
        tails: degrees of freedom of Student's t distribution, as which errors are distributed.
        block_s: length of the stretches of time that are taken as independent, s: one of them alone
            must not decide.
        beam: sets that are pursued side by side.
    """

    probability: float = 0.9
    size: float = 0.001
    replicates: int = 12
    expected_effects: float = 1.0
    most_effects: int = 8
    bias_error: float = 0.2
    discrepancy: float = 0.003
    tails: float = 4.0
    block_s: float = 2.0
    beam: int = 10

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"{field.name} must be positive")

    @property
    def largest_p_value(self) -> float:
        """The p-value from which on `most_probable` is below ``probability``."""
        odds_against = (1.0 - self.probability) / self.probability
        return float(np.exp(lambertw(-min(odds_against, 1.0) / np.e, -1).real))


def most_probable(p_value: float) -> float:
    """The highest probability that an effect can have which chance imitates with a p-value.

    At even odds before (Sellke, Bayarri and Berger 2001, The American Statistician 55, 62).
    """
    p = min(max(p_value, 1e-300), 1.0 / np.e)
    return float(1.0 / (1.0 - np.e * p * np.log(p)))
