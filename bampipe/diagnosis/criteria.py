"""The numbers that decide a verdict: one record, passed to whatever judges."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Criteria:
    """What it takes for an effect to be called missing; each described in docs/method_selection.

    Attributes:
        probability: from which an effect is called missing, and below one minus which it is not
            mentioned.
        size: least share of the applied force of an axis, root mean square, that an effect must add
            beyond what the other parameters could take over: no load cell is more linear.
        significance: chance of a false alarm in a session where nothing is missing, by replicates.
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
        doubt: scale of what is left on an axis, in units of noise and discrepancy, from which on it
            is something unknown for sure, which what takes less than it leaves may resemble.
    """

    probability: float = 0.9
    size: float = 0.001
    significance: float = 0.01
    replicates: int = 12
    expected_effects: float = 1.0
    most_effects: int = 8
    bias_error: float = 0.2
    discrepancy: float = 0.003
    tails: float = 4.0
    block_s: float = 2.0
    beam: int = 10
    doubt: float = 6.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"{field.name} must be positive")
